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
    """Train a detector, or resume a stopped call.

    Args:
        data: Dataset folder, or several. All their images are used.
        out: Run folder for checkpoints: a new one, or that of a stopped call with the same arguments.
        recipe: Training recipe: "auto", "paper", "laptop", "scratch", or a TOML file.
        settings: Values of the recipe by name, for example {"augment.blur": 0.2}.
        epochs: Number of epochs; None: as in the recipe. The same holds for the arguments below.
        init: Initial weights: "auto", "coco", "imagenet", "random", or a checkpoint or run.
        backbone: Network of the feature maps: "resnet50", "resnet18" or "mobilenet_v3_large".
        batch_size: Images per step.
        min_size: Short side of the image in the network, pixels.
        supervise: Keypoints to train on: "visible", or "all" to include hidden ones.
        categories: Classes to train, for example ("vehicle", "pedestrian"); empty: all classes of the data.
        max_images: Maximum number of images with vehicles per dataset; None: all.
        seed: Seed of weights, image order, augmentation and sampling.
        device: Device: "auto" (a GPU if there is one), "cpu", "cuda" or "cuda:1".
        workers: Number of loading processes; None: suitable for the device. It does not change the result.
        quiet: Print no progress.

    Returns:
        The last checkpoint, for `load_detector`.

    Raises:
        UserError: An argument is wrong, a dataset has no usable image, or the folder holds another run.
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
