"""`skope train`: flags, and the choice of recipe and run folder."""

from pathlib import Path
from typing import Annotated, Any

import typer

from skope.errors import UserError
from skope.terminal.command_options import (
    DATA_FOLDER,
    DIR_METAVAR,
    FILE_METAVAR,
    LIST_METAVAR,
    RUN_FOLDER,
    Commands,
    option,
    panel,
)
from skope.terminal.console import Console

RECIPE_DEFAULT = "the recipe's"

app = Commands(help="Train the detector: Keypoint R-CNN with 33 keypoints.")
data_option, training, output, machine = map(panel, ("Data", "Training", "Output", "Machine"))


@app.callback(invoke_without_command=True)
def run(
    console: Console,
    data: Annotated[
        list[Path] | None,
        data_option(
            metavar=DIR_METAVAR,
            help="Dataset folder; repeat it to train on several.",
            show_default=str(DATA_FOLDER),
        ),
    ] = None,
    mix: Annotated[
        float | None,
        data_option(help="Fraction of an epoch's images from the first --data.", show_default="all images once"),
    ] = None,
    max_images: Annotated[int | None, data_option(help="Maximum number of images with vehicles per dataset.")] = None,
    exclude_types: Annotated[
        str | None, data_option(metavar=LIST_METAVAR, help="Vehicle types to ignore, for example pickup,bus.")
    ] = None,
    categories: Annotated[
        str | None,
        data_option(
            metavar=LIST_METAVAR,
            help="Classes to train, for example vehicle,pedestrian; others are background.",
            show_default="all classes of the data",
        ),
    ] = None,
    val_fraction: Annotated[
        float | None,
        data_option(help="Fraction of the training frames to hold out for validation.", show_default=RECIPE_DEFAULT),
    ] = None,
    recipe: Annotated[
        str | None,
        training(
            metavar="[auto|paper|laptop|scratch|FILE]",
            help="Training recipe: a name or a TOML file. auto: paper on a GPU, laptop on a CPU.",
            show_default="auto",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        training(
            "--set",
            metavar="NAME=VALUE",
            help="Value of the recipe, for example --set weight_decay=1e-4 --set augment.blur=0.2.",
        ),
    ] = None,
    epochs: Annotated[int | None, training(help="Number of epochs.", show_default=RECIPE_DEFAULT)] = None,
    init: Annotated[
        str | None,
        training(
            metavar="[auto|coco|imagenet|random|FILE]",
            help="Initial weights. coco, imagenet: downloaded if missing. FILE: a checkpoint or run folder. auto: COCO "
            "weights if torchvision's cache has them, else the shipped detector; for another network a cached "
            "ImageNet backbone, else random weights.",
            show_default=RECIPE_DEFAULT,
        ),
    ] = None,
    backbone: Annotated[
        str | None,
        training(
            choices=("resnet50", "resnet18", "mobilenet_v3_large"),
            help="Backbone network. Its widths are values of the recipe, for example --set network.pyramid_width=64.",
            show_default="from the recipe or the initial weights",
        ),
    ] = None,
    batch_size: Annotated[int | None, training(help="Images per step.", show_default=RECIPE_DEFAULT)] = None,
    min_size: Annotated[
        int | None,
        training(
            help="Short side of the image in the network, pixels.",
            show_default="from the recipe or the initial weights",
        ),
    ] = None,
    supervise: Annotated[
        str | None,
        training(
            choices=("visible", "all"),
            help="Keypoints to train on. all: also hidden ones.",
            show_default=RECIPE_DEFAULT,
        ),
    ] = None,
    seed: Annotated[
        int | None, training(help="Seed of weights, image order, augmentation and sampling.", show_default="0")
    ] = None,
    out: Annotated[Path, output(metavar=DIR_METAVAR, help="Run folder for checkpoints.")] = RUN_FOLDER,
    resume: Annotated[
        bool,
        output("--resume", help="Resume the run in --out with its saved options. Add --epochs to extend it."),
    ] = False,
    keep: Annotated[int, output(help="Number of epoch checkpoints to keep, in addition to the best one.")] = 1,
    save_minutes: Annotated[float, output(help="Minutes between saves of the training state within an epoch.")] = 10,
    device: Annotated[str, machine(metavar="[auto|cpu|cuda|cuda:N]", help="Device.")] = "auto",
    workers: Annotated[int | None, machine(help="Number of loading processes. It does not change the result.")] = None,
) -> None:
    """Train on split `train` of a dataset folder, with a checkpoint after each epoch (one a minute at most).

    The same command resumes a stopped run.
    """
    for name, value in (("epochs", epochs), ("batch-size", batch_size), ("max-images", max_images), ("keep", keep)):
        if value is not None and value < 1:
            raise UserError(f"--{name}: expected at least 1, got {value}")
    for name, number in (("seed", seed), ("workers", workers), ("save-minutes", save_minutes)):
        if number is not None and number < 0:
            raise UserError(f"--{name}: expected a number from 0, got {number}")

    from skope.dataset.folder import open_dataset
    from skope.detector.device import choose_device, has_bfloat16
    from skope.train import configure
    from skope.train.loop import CheckpointPolicy, train

    where = choose_device(device)
    flags: dict[str, Any] = {
        "recipe": recipe,
        "set": tuple(settings or ()),
        "epochs": epochs,
        "init": init,
        "backbone": backbone,
        "batch_size": batch_size,
        "max_images": max_images,
        "min_size": min_size,
        "supervise": supervise,
        "exclude_types": tuple(exclude_types.split(",")) if exclude_types else (),
        "categories": tuple(categories.split(",")) if categories else (),
        "val_fraction": val_fraction,
        "mix": mix,
        "seed": seed,
    }
    on_gpu = where.type == "cuda"
    if resume:
        config = configure.again(out, data or (), flags)
    else:
        bfloat16 = not on_gpu and has_bfloat16(where)
        config, resume = configure.new_or_same(out, data or (DATA_FOLDER,), flags, gpu=on_gpu, bfloat16=bfloat16)
    if workers is None:
        workers = configure.loading_workers(gpu=on_gpu)
    saving = CheckpointPolicy(keep=keep, state_interval_s=60 * save_minutes)
    try:
        checkpoint = train(config, out, device=where, workers=workers, resume=resume, console=console, saving=saving)
    except KeyboardInterrupt:
        typer.echo(f"skope: stopped; {configure.how_to_go_on(out)}", err=True)
        raise typer.Exit(130) from None
    learnt = open_dataset(Path(config.data[0]))
    console.result(
        f"wrote {checkpoint}; next: {configure.next_command(out, learnt.root, learnt.splits, RUN_FOLDER, DATA_FOLDER)}"
    )


@app.command()
def export(
    console: Console,
    checkpoint: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or a checkpoint file.")] = RUN_FOLDER,
    to: Annotated[
        str,
        option(choices=("torchscript", "onnx", "compact", "state_dict"), help="Format; onnx needs the extra `onnx`."),
    ] = "torchscript",
    out: Annotated[
        Path | None, option(metavar=FILE_METAVAR, help="File to write.", show_default="beside the checkpoint")
    ] = None,
    data: Annotated[
        Path | None,
        option(
            metavar=DIR_METAVAR,
            help="Dataset for rounding compact weights with the smallest change of the layer outputs.",
        ),
    ] = None,
) -> None:
    """Write a checkpoint in another form.

    compact: a seventh of the bytes, for every command that takes a checkpoint. torchscript and onnx run without skope:
    image in (3, H, W, 0 to 1), boxes, scores and keypoints out. state_dict: tensors for torchvision's own model, with
    the lines of Python that build it.
    """
    from skope.train.export import export as write

    path = write(checkpoint, to, out, data=data, console=console)
    console.result(f"wrote {path}")
