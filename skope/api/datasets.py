"""Datasets: generated, opened, and as PyTorch takes them."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from skope.dataset import folder
from skope.dataset.folder import Dataset
from skope.errors import UserError, one_of
from skope.records import check_number

if TYPE_CHECKING:
    from skope.train.training_samples import DetectionDataset


def open_dataset(path: str | Path) -> Dataset:
    """Open a dataset that `skope gen` made.

    Args:
        path: The dataset's folder.

    Returns:
        The dataset. Iterating over it gives `LabelledImage`s: an image's record, its camera, its annotations, and its
        pixels when they are asked for. `dataset.read("train")` gives all records of a split at once.

    Raises:
        UserError: There is no finished dataset in the folder.
    """
    return folder.open_dataset(Path(path))


def torch_dataset(path: str | Path, split: str = "train", *, supervise: str = "visible") -> "DetectionDataset":
    """The images of a split as torchvision's detection models take them, for `torch.utils.data.DataLoader`.

    Args:
        path: The dataset's folder.
        split: One of `open_dataset(path).splits`.
        supervise: "visible" for the keypoints that can be seen, "all" for hidden ones too.

    Returns:
        A `torch.utils.data.Dataset` of pairs: pixels (3, H, W) float32 from 0 to 1, and a dict of `boxes` (N, 4) xyxy
        in pixels, `labels` (N,), `keypoints` (N, 33, 3) x, y, v, and `ignored_boxes` (M, 4), which count neither as
        vehicles nor as background. Vehicles have label 1; where the dataset labels other road users, these follow with
        labels from 2, in the order of the file's `categories`, and keypoints that are all v = 0.

    Raises:
        UserError: There is no such dataset or split.
    """
    from skope.train.training_samples import DetectionDataset

    return DetectionDataset(open_dataset(path), split, supervise)


def generate(
    out: str | Path,
    *,
    preset: str = "demo",
    sites: Sequence[str] | None = None,
    site: str | Path | None = None,
    frames: int | None = None,
    recordings: int | None = None,
    interval: float | None = None,
    size: str | tuple[int, int] | None = None,
    weather: str | Sequence[str] | None = None,
    time_of_day: str | Sequence[str] | None = None,
    conditions: Mapping[str, float | tuple[float, float]] | None = None,
    depth: bool = True,
    seed: int = 0,
    workers: int | None = None,
    quiet: bool = True,
    **options: bool | int | float | str | None,
) -> Dataset:
    """Generate annotated images, or go on where a stopped call was; the same arguments give the same bytes.

    Args:
        out: The dataset's folder; a new one, or one that the same call began.
        preset: What kind of dataset: "demo", "paper", "full", "extra", "varied", "world", "nights" or "conditions".
        sites: Names of camera sites in place of the preset's (`skope gen sites` lists them).
        site: One name in place of `sites`, or a site file of your own road and camera.
        frames: Images for each site.
        recordings: Recordings that a site's images are shared out to, each with its own weather, hour and traffic.
        interval: Seconds between a recording's frames.
        size: Width and height of the images, as in (1280, 720) or "1280x720".
        weather: Weathers of the recordings: "clear", "cloudy", "overcast", "rain", "after_rain", "fog", "snow".
        time_of_day: Hours of the recordings: "noon", "low_sun", "dawn", "dusk", "night".
        conditions: Conditions of light and camera (docs/rendering.md), a number or the ends of a range each.
        depth: Whether depth files are written.
        seed: What everything that is random follows from.
        workers: Processes; None: one for each core.
        quiet: Print nothing on the way.
        options: Any other option of `skope gen` by its name with underscores, as in `shape_jitter=True`.

    Returns:
        The finished dataset.

    Raises:
        UserError: An argument is wrong or unknown, or the folder holds other work.
    """
    with suppress(ImportError):
        # A program that goes on with torch crashes where Mesa's compiler (LLVM) was loaded before torchvision's.
        import torchvision  # noqa: F401

    from skope.gen.cli.options import HOUR_CHOICES, WEATHER_CHOICES, DatasetOptions, WorkerOptions
    from skope.gen.pipeline.generate import generate_dataset
    from skope.terminal.console import Console

    known = {one.name for one in fields(DatasetOptions)} - {"settings"}
    for name in options:
        if name not in known:
            raise UserError(f"{name}: no option of `skope gen`; there are {', '.join(sorted(known))}")
    if isinstance(sites, str):
        raise UserError(f"sites: expected several names, as in [{sites!r}], got a text")
    check_number("seed", seed, 0, math.inf)
    asked = DatasetOptions(
        preset=preset,
        sites=None if sites is None else ",".join(sites),
        site=None if site is None else str(site),
        frames=frames,
        recordings=recordings,
        interval=interval,
        size=size if size is None or isinstance(size, str) else "{}x{}".format(*size),
        weather=_names("weather", weather, WEATHER_CHOICES),
        time_of_day=_names("time_of_day", time_of_day, HOUR_CHOICES),
        settings=[f"{name}={_range(name, value)}" for name, value in (conditions or {}).items()] or None,
        depth=depth,
        seed=seed,
        **options,  # type: ignore[arg-type]
    )
    request, _ = asked.request()
    start_pool, _ = WorkerOptions(workers=workers).pool_factory()
    generate_dataset(request, Path(out), start_pool, Console(quiet=quiet))
    return open_dataset(out)


def _names(argument: str, given: str | Sequence[str] | None, known: Sequence[str]) -> str | None:
    """Names as the command line takes them. Raises UserError for one that is not known."""
    if given is None:
        return None
    names = [given] if isinstance(given, str) else list(given)
    for name in names:
        one_of(argument, name, tuple(known))
    return ",".join(names)


def _range(name: str, value: float | tuple[float, float]) -> str:
    """A condition as the command line takes it. Raises UserError for what is neither a number nor two."""
    ends = (value,) if isinstance(value, int | float) else tuple(value)
    if len(ends) not in (1, 2) or not all(isinstance(end, int | float) for end in ends):
        raise UserError(f"conditions: {name}: expected a number or the two ends of a range, got {value!r}")
    return "..".join(repr(float(end)) for end in ends)
