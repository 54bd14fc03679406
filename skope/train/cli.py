"""`skope train`: flags, and the choice of recipe and run folder."""

from pathlib import Path
from typing import Annotated, Any

import typer

from skope.console import Console, QuietOption, VersionOption, goes_on
from skope.errors import UserError

DATA = Path("data/skope")
RUN = Path("runs/skope")

app = typer.Typer(help="Train the detector: Keypoint R-CNN with 33 keypoints.")


@app.callback(invoke_without_command=True)
def run(
    context: typer.Context,
    data: Annotated[
        list[Path] | None, typer.Option(help=f"Dataset folder; several train together.  [default: {DATA}]")
    ] = None,
    mix: Annotated[
        float | None,
        typer.Option(help="Share of an epoch's images that the first --data gives.  [default: all images once]"),
    ] = None,
    out: Annotated[Path, typer.Option(help="Run folder for checkpoints.")] = RUN,
    recipe: Annotated[
        str | None,
        typer.Option(help="paper, laptop, scratch, a TOML file, or auto: paper on a GPU, laptop on a CPU.  [auto]"),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any value of the recipe, as in --set weight_decay=1e-4 --set augment.blur=0.2."),
    ] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the images.  [default: the recipe's]")] = None,
    init: Annotated[
        str | None,
        typer.Option(
            help="First weights: coco, imagenet (both downloaded when missing), random, a file or run folder, or auto: "
            "COCO weights if torchvision's cache has them, else random.  [default: the recipe's]"
        ),
    ] = None,
    batch_size: Annotated[int | None, typer.Option(help="Images a step.  [default: the recipe's]")] = None,
    max_images: Annotated[
        int | None, typer.Option(help="Train on this many images with vehicles of each dataset only.")
    ] = None,
    min_size: Annotated[
        int | None, typer.Option(help="Short side of the image in the network, pixels.  [default: the recipe's]")
    ] = None,
    supervise: Annotated[
        str | None, typer.Option(help="Keypoints to learn: visible, or all (hidden ones too).  [default: the recipe's]")
    ] = None,
    exclude_types: Annotated[
        str | None, typer.Option(help="Vehicle types to ignore, with commas, as in pickup,bus.")
    ] = None,
    val_fraction: Annotated[
        float | None, typer.Option(help="Share of each recording's end to validate on.  [default: the recipe's]")
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    seed: Annotated[int | None, typer.Option(help="Seed of weights, order, changes and samples.  [default: 0]")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes that load images; changes no result.")] = None,
    keep: Annotated[int, typer.Option(help="Checkpoints of epochs to keep, beside the best one.")] = 1,
    save_minutes: Annotated[float, typer.Option(help="Save the state so often within an epoch.")] = 10,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out where it was saved.")] = False,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Train on split `train` of a dataset folder, with a checkpoint after each epoch (one a minute at most)."""
    if goes_on(context):
        return
    for name, value in (("epochs", epochs), ("batch-size", batch_size), ("max-images", max_images), ("keep", keep)):
        if value is not None and value < 1:
            raise UserError(f"--{name}: expected at least 1, got {value}")
    for name, number in (("seed", seed), ("workers", workers), ("save-minutes", save_minutes)):
        if number is not None and number < 0:
            raise UserError(f"--{name}: expected a number from 0, got {number}")

    from skope.detector import choose_device
    from skope.train import configure
    from skope.train.loop import Saving, train

    console = Console(quiet)
    where = choose_device(device)
    flags: dict[str, Any] = {
        "recipe": recipe,
        "set": tuple(settings or ()),
        "epochs": epochs,
        "init": init,
        "batch_size": batch_size,
        "max_images": max_images,
        "min_size": min_size,
        "supervise": supervise,
        "exclude_types": tuple(exclude_types.split(",")) if exclude_types else (),
        "val_fraction": val_fraction,
        "mix": mix,
        "seed": seed,
    }
    on_gpu = where.type == "cuda"
    if resume:
        config = configure.again(out, data or (), flags)
    else:
        bfloat16 = not on_gpu and configure.multiplies_bfloat16()
        config = configure.new(data or (DATA,), flags, gpu=on_gpu, bfloat16=bfloat16)
    if workers is None:
        workers = configure.loading_workers(gpu=on_gpu)
    saving = Saving(keep=keep, state_interval_s=60 * save_minutes)
    try:
        checkpoint = train(config, out, device=where, workers=workers, resume=resume, console=console, saving=saving)
    except KeyboardInterrupt:
        typer.echo(f"skope: stopped; {configure.how_to_go_on(out)}", err=True)
        raise typer.Exit(130) from None
    console.result(f"wrote {checkpoint}; next: {configure.next_command(out, Path(config.data[0]), RUN, DATA)}")


@app.command()
def export(
    checkpoint: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or a checkpoint file.")] = RUN,
    to: Annotated[
        str, typer.Option(help="compact (integers, 35 MB), torchscript or onnx (the extra `onnx`).")
    ] = "torchscript",
    out: Annotated[Path | None, typer.Option(help="File to write.  [default: beside the checkpoint]")] = None,
    quiet: QuietOption = False,
) -> None:
    """Write a checkpoint in another form.

    compact: a seventh of the bytes, for every command that takes a checkpoint. torchscript and onnx run without skope:
    image in (3, H, W, 0 to 1), boxes, scores and keypoints out.
    """
    from skope.train.export import export as write

    path = write(checkpoint, to, out, console=Console(quiet))
    Console(quiet).result(f"wrote {path}")
