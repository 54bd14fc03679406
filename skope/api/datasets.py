"""Generate datasets, open them, and use them with PyTorch."""

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
    """Open a dataset of `skope gen`.

    Args:
        path: The dataset's folder.

    Returns:
        The dataset. Iterating over it yields `LabelledImage`s: record, camera and annotations of an image, and its
        pixels on request. `dataset.read("train")` returns all records of a split.

    Raises:
        UserError: There is no finished dataset in the folder.
    """
    return folder.open_dataset(Path(path))


def torch_dataset(path: str | Path, split: str = "train", *, supervise: str = "visible") -> "DetectionDataset":
    """Return a split for `torch.utils.data.DataLoader` and torchvision's detection models.

    Args:
        path: The dataset's folder.
        split: One of `open_dataset(path).splits`.
        supervise: "visible" for visible keypoints, "all" to include hidden ones.

    Returns:
        A `torch.utils.data.Dataset` of pairs: pixels (3, H, W) float32 from 0 to 1, and a dict of `boxes` (N, 4) xyxy
        in pixels, `labels` (N,), `keypoints` (N, 33, 3) x, y, v, and `ignored_boxes` (M, 4), which are neither
        vehicles nor background. Vehicles have label 1. Other road users, if labelled, have labels from 2 in the order
        of the file's `categories`; all their keypoints have v = 0.

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
    """Generate annotated images, or resume a stopped call. The same arguments give the same bytes.

    Args:
        out: Dataset folder: a new one, or that of a stopped call with the same arguments.
        preset: Preset: "demo", "paper", "full", "extra", "varied", "world", "nights" or "conditions".
        sites: Names of camera sites that replace those of the preset (`skope gen sites` lists them).
        site: One name instead of `sites`, or a site file of your own road and camera.
        frames: Number of images per site.
        recordings: Number of recordings per site. The images are divided among them; each has its own weather, hour and
            traffic.
        interval: Time between the frames of a recording, seconds.
        size: Width and height of the images, for example (1280, 720) or "1280x720".
        weather: Weather of the recordings: "clear", "cloudy", "overcast", "rain", "after_rain", "fog", "snow".
        time_of_day: Hours of the recordings: "noon", "low_sun", "dawn", "dusk", "night".
        conditions: Conditions of light and camera (docs/rendering.md): a number, or the two ends of a range.
        depth: Whether depth files are written.
        seed: Seed of everything that is random.
        workers: Number of processes; None: one per core.
        quiet: Print no progress.
        options: Other options of `skope gen`, named with underscores, for example `shape_jitter=True`.

    Returns:
        The finished dataset.

    Raises:
        UserError: An argument is wrong or unknown, or the folder holds another dataset.
    """
    with suppress(ImportError):
        # Importing torch crashes if Mesa's compiler (LLVM) was loaded before torchvision's.
        import torchvision  # noqa: F401

    from skope.gen.cli.options import HOUR_CHOICES, WEATHER_CHOICES, DatasetOptions, WorkerOptions
    from skope.gen.pipeline.generate import generate_dataset
    from skope.terminal.console import Console

    known = {one.name for one in fields(DatasetOptions)} - {"settings"}
    for name in options:
        if name not in known:
            raise UserError(f"{name}: unknown option of `skope gen`; expected one of {', '.join(sorted(known))}")
    if isinstance(sites, str):
        raise UserError(f"sites: expected a list of names such as [{sites!r}], got one string")
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
    """Return names separated by commas, as text for a command-line option; None without names.

    Raises UserError for an unknown name. `argument` is used only in its message.
    """
    if given is None:
        return None
    names = [given] if isinstance(given, str) else list(given)
    for name in names:
        one_of(argument, name, tuple(known))
    return ",".join(names)


def _range(name: str, value: float | tuple[float, float]) -> str:
    """Return the value or range of a condition as text for `--set`, for example "-1.0..1.0".

    Raises UserError if the value is neither a number nor two numbers.
    """
    ends = (value,) if isinstance(value, int | float) else tuple(value)
    if len(ends) not in (1, 2) or not all(isinstance(end, int | float) for end in ends):
        raise UserError(f"conditions: {name}: expected a number or the two ends of a range, got {value!r}")
    return "..".join(repr(float(end)) for end in ends)
