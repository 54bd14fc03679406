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
            help="Dataset folder; several, repeated, train together.",
            show_default=str(DATA_FOLDER),
        ),
    ] = None,
    mix: Annotated[
        float | None,
        data_option(
            help="Share of an epoch's images that the first --data gives.", show_default="all images of all, once"
        ),
    ] = None,
    max_images: Annotated[
        int | None, data_option(help="Train on this many images with vehicles of each dataset only.")
    ] = None,
    exclude_types: Annotated[
        str | None, data_option(metavar=LIST_METAVAR, help="Vehicle types to ignore, as in pickup,bus.")
    ] = None,
    categories: Annotated[
        str | None,
        data_option(
            metavar=LIST_METAVAR,
            help="What to learn, as in vehicle,pedestrian; the others are background.",
            show_default="all that the data labels",
        ),
    ] = None,
    val_fraction: Annotated[
        float | None,
        data_option(help="Share of each recording's end to validate on.", show_default=RECIPE_DEFAULT),
    ] = None,
    recipe: Annotated[
        str | None,
        training(
            metavar="[auto|paper|laptop|scratch|FILE]",
            help="How to train; FILE: TOML; auto: paper on a GPU, laptop on a CPU.",
            show_default="auto",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        training(
            "--set",
            metavar="NAME=VALUE",
            help="Any value of the recipe, as in --set weight_decay=1e-4 --set augment.blur=0.2.",
        ),
    ] = None,
    epochs: Annotated[int | None, training(help="Passes over the images.", show_default=RECIPE_DEFAULT)] = None,
    init: Annotated[
        str | None,
        training(
            metavar="[auto|coco|imagenet|random|FILE]",
            help="First weights. coco and imagenet are downloaded when missing, FILE may be a run folder; auto: COCO "
            "weights if torchvision's cache has them, else the detector that comes with skope; for another network "
            "than theirs a backbone trained on ImageNet if cached, else random.",
            show_default=RECIPE_DEFAULT,
        ),
    ] = None,
    backbone: Annotated[
        str | None,
        training(
            choices=("resnet50", "resnet18", "mobilenet_v3_large"),
            help="What makes the feature maps; the widths that suit it are values of the recipe, as in --set "
            "network.pyramid_width=64.",
            show_default="the recipe's or the first weights'",
        ),
    ] = None,
    batch_size: Annotated[int | None, training(help="Images a step.", show_default=RECIPE_DEFAULT)] = None,
    min_size: Annotated[
        int | None,
        training(
            help="Short side of the image in the network, pixels.", show_default="the recipe's or the first weights'"
        ),
    ] = None,
    supervise: Annotated[
        str | None,
        training(
            choices=("visible", "all"), help="Keypoints to learn; all: hidden ones too.", show_default=RECIPE_DEFAULT
        ),
    ] = None,
    seed: Annotated[int | None, training(help="Seed of weights, order, changes and samples.", show_default="0")] = None,
    out: Annotated[Path, output(metavar=DIR_METAVAR, help="Run folder for checkpoints.")] = RUN_FOLDER,
    resume: Annotated[
        bool,
        output(
            "--resume", help="Go on with the run in --out without saying its options again; with --epochs for longer."
        ),
    ] = False,
    keep: Annotated[int, output(help="Checkpoints of epochs to keep, beside the best one.")] = 1,
    save_minutes: Annotated[float, output(help="Minutes between saves of the training state within an epoch.")] = 10,
    device: Annotated[str, machine(metavar="[auto|cpu|cuda|cuda:N]", help="Where to compute.")] = "auto",
    workers: Annotated[int | None, machine(help="Processes that load images; changes no result.")] = None,
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
        option(choices=("torchscript", "onnx", "compact", "state_dict"), help="Form; onnx needs the extra `onnx`."),
    ] = "torchscript",
    out: Annotated[
        Path | None, option(metavar=FILE_METAVAR, help="File to write.", show_default="beside the checkpoint")
    ] = None,
    data: Annotated[
        Path | None,
        option(
            metavar=DIR_METAVAR, help="Round compact weights so that on this dataset the layers' outputs change least."
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
