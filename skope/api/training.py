"""Training a detector on datasets, as `skope train` does."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from skope.errors import UserError, one_of
from skope.records import check_number

_MOST_ALLOWED = 10**9


def train_detector(
    data: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    recipe: str | Path = "auto",
    settings: Mapping[str, Any] | None = None,
    epochs: int | None = None,
    init: str | Path | None = None,
    backbone: str | None = None,
    batch_size: int | None = None,
    min_size: int | None = None,
    supervise: Literal["visible", "all"] | None = None,
    categories: Sequence[str] = (),
    max_images: int | None = None,
    seed: int = 0,
    device: str = "auto",
    workers: int | None = None,
    quiet: bool = True,
) -> Path:
    """Train a detector, or go on where a stopped call was.

    Args:
        data: Dataset folder; of several all images are learnt from.
        out: The run folder for checkpoints: a new one, or one that the same call began.
        recipe: How to train: "auto", "paper", "laptop", "scratch", or a TOML file.
        settings: Any value of the recipe by its name, as in {"augment.blur": 0.2}.
        epochs: Passes over the images; None: as the recipe says. So it is with those below.
        init: First weights: "auto", "coco", "imagenet", "random", or a checkpoint or run.
        backbone: What makes the feature maps: "resnet50", "resnet18" or "mobilenet_v3_large".
        batch_size: Images a step.
        min_size: Short side of the image in the network, pixels.
        supervise: Keypoints to learn: "visible", or "all" for hidden ones too.
        categories: What to learn, as in ("vehicle", "pedestrian"); empty: all that the data labels.
        max_images: Train on so many images with vehicles of each dataset only; None: on all.
        seed: Seed of weights, order, changes and samples.
        device: Where to compute: "auto" (a GPU where there is one), "cpu", "cuda" or "cuda:1".
        workers: Processes that load images; None: as many as suit the device. Changes no result.
        quiet: Print nothing on the way.

    Returns:
        The last checkpoint, for `load_detector`.

    Raises:
        UserError: An argument is wrong, a dataset holds nothing to learn from, or the folder holds another run.
    """
    from skope.detector.device import choose_device, has_bfloat16
    from skope.terminal.console import Console
    from skope.train import configure
    from skope.train.loop import CheckpointPolicy, train

    for name, number in (("epochs", epochs), ("batch_size", batch_size), ("max_images", max_images)):
        if number is not None:
            check_number(name, number, 1, _MOST_ALLOWED)
    check_number("seed", seed, 0, _MOST_ALLOWED)
    if supervise is not None:
        one_of("supervise", supervise, ("visible", "all"))
    folders = [Path(data)] if isinstance(data, str | Path) else [Path(one) for one in data]
    if not folders:
        raise UserError("data: expected one or more dataset folders, got none")
    where, run = choose_device(device), Path(out)
    on_gpu = where.type == "cuda"
    flags: dict[str, Any] = {
        "recipe": str(recipe),
        "set": tuple(f"{name}={value}" for name, value in (settings or {}).items()),
        "epochs": epochs,
        "init": None if init is None else str(init),
        "backbone": backbone,
        "batch_size": batch_size,
        "max_images": max_images,
        "min_size": min_size,
        "supervise": supervise,
        "exclude_types": (),
        "categories": tuple(categories),
        "val_fraction": None,
        "mix": None,
        "seed": seed,
    }
    bfloat16 = not on_gpu and has_bfloat16(where)
    config, resume = configure.new_or_same(run, folders, flags, gpu=on_gpu, bfloat16=bfloat16)
    loading = configure.loading_workers(gpu=on_gpu) if workers is None else workers
    return train(
        config,
        run,
        device=where,
        workers=loading,
        resume=resume,
        console=Console(quiet=quiet),
        saving=CheckpointPolicy(),
    )
