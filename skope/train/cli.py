"""`skope train`: flags, and the choice of recipe and run folder."""

from pathlib import Path
from typing import Annotated, Any

import typer

from skope.console import Console, QuietOption, VersionOption
from skope.errors import UserError

DATA = Path("data/skope")
RUN = Path("runs/skope")

app = typer.Typer(help="Train the detector: Keypoint R-CNN with 33 keypoints.")


@app.callback(invoke_without_command=True)
def run(
    data: Annotated[Path | None, typer.Option(help=f"Dataset folder.  [default: {DATA}]")] = None,
    out: Annotated[Path, typer.Option(help="Run folder for checkpoints.")] = RUN,
    recipe: Annotated[
        str | None, typer.Option(help="paper, laptop, scratch, or auto: paper on a GPU, laptop on a CPU.  [auto]")
    ] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the images.  [default: the recipe's]")] = None,
    init: Annotated[
        str | None,
        typer.Option(
            help="First weights: coco, imagenet (both downloaded when missing), random, or auto: COCO weights if "
            "torchvision's cache has them, else random.  [default: the recipe's]"
        ),
    ] = None,
    batch_size: Annotated[int | None, typer.Option(help="Images a step.  [default: the recipe's]")] = None,
    max_images: Annotated[int | None, typer.Option(help="Train on this many images with vehicles only.")] = None,
    min_size: Annotated[
        int | None, typer.Option(help="Short side of the image in the network, pixels.  [default: the recipe's]")
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    seed: Annotated[int | None, typer.Option(help="Seed of weights, order, flips and samples.  [default: 0]")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes that load images; changes no result.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out after its last epoch.")] = False,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Train on split `train` of a dataset folder, with a checkpoint after each epoch (one a minute at most)."""
    for name, value in (("epochs", epochs), ("batch-size", batch_size), ("max-images", max_images)):
        if value is not None and value < 1:
            raise UserError(f"--{name}: expected at least 1, got {value}")
    for name, value in (("seed", seed), ("workers", workers)):
        if value is not None and value < 0:
            raise UserError(f"--{name}: expected a number from 0, got {value}")

    from skope.detector import choose_device
    from skope.train import plan
    from skope.train.loop import train

    console = Console(quiet)
    where = choose_device(device)
    flags: dict[str, Any] = {
        "recipe": recipe,
        "epochs": epochs,
        "init": init,
        "batch_size": batch_size,
        "max_images": max_images,
        "min_size": min_size,
        "seed": seed,
    }
    on_gpu = where.type == "cuda"
    if resume:
        config = plan.again(out, data, flags)
    else:
        bfloat16 = not on_gpu and plan.multiplies_bfloat16()
        config = plan.new(data or DATA, flags, gpu=on_gpu, bfloat16=bfloat16)
    if workers is None:
        workers = plan.loading_workers(gpu=on_gpu)
    try:
        checkpoint = train(config, out, device=where, workers=workers, resume=resume, console=console)
    except KeyboardInterrupt:
        typer.echo(f"skope: stopped; {plan.how_to_go_on(out)}", err=True)
        raise typer.Exit(130) from None
    console.result(f"wrote {checkpoint}; next: {plan.next_command(out, Path(config.data), RUN, DATA)}")
