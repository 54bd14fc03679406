"""`skope gen`: make datasets, check, convert and join them."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from skope.errors import UserError
from skope.gen.cli import inspect, sites, vehicles
from skope.gen.cli.options import DatasetOptions, RendererOption, WorkerOptions, machine, output
from skope.terminal.command_options import (
    DATA_FOLDER,
    DIR_METAVAR,
    FILE_METAVAR,
    LIST_METAVAR,
    Commands,
    option,
)
from skope.terminal.console import Console, counted

if TYPE_CHECKING:
    from skope.gen.pipeline.config import DatasetRequest


WRITTEN_FORMATS = ("folder", "shards", "coco", "cvat", "kitti", "mot", "skope3d", "yolo")
READ_FORMATS = ("coco", "cvat", "skope3d")


def convert(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH", help="Sources, and last the new folder.")],
    console: Console,
    to: Annotated[str | None, option(choices=WRITTEN_FORMATS, help="Format to write.", show_default="folder")] = None,
    source: Annotated[
        str | None, option("--from", choices=READ_FORMATS, help="Format to read.", show_default="a dataset folder")
    ] = None,
    map_file: Annotated[
        Path | None,
        option(
            "--map", metavar=FILE_METAVAR, help="JSON file that maps the keypoints of --from skope3d to scheme skope33."
        ),
    ] = None,
    images: Annotated[
        Path | None,
        option(
            metavar=DIR_METAVAR,
            help="Folder of the images of --from coco or cvat.",
            show_default="beside the annotations",
        ),
    ] = None,
    keypoints: Annotated[
        str | None, option(metavar=LIST_METAVAR, help="Names of the keypoints of --to yolo.", show_default="all")
    ] = None,
    split: Annotated[str | None, option(metavar="NAME", help="Split of all images.")] = None,
    stored_pixels: Annotated[
        bool,
        option("--stored-pixels", help="Labels of --from coco or cvat are in stored pixels, before EXIF rotation."),
    ] = False,
) -> None:
    """Convert a dataset to another format, or files of another format to a dataset (docs/formats.md)."""
    from skope.gen.formats.convert import ConversionOptions
    from skope.gen.formats.convert import convert_dataset as write

    *sources, out = paths
    if not sources:
        raise UserError(f"{out}: expected a source and the new folder")
    options = ConversionOptions(
        map=map_file,
        images=images,
        split=split,
        stored_pixels=stored_pixels,
        keypoints=tuple(keypoints.split(",")) if keypoints else (),
    )
    write(sources, out, read_as=source, write_as=to, options=options, console=console)
    console.result(f"wrote {out}" + (f"; next: {_check_command(out)}" if to in (None, "folder", "shards") else ""))


def merge(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH", help="Datasets, and last the new folder.")],
    console: Console,
    vehicles_alone: Annotated[
        bool, option("--vehicles-alone", help="Omit labels of people on foot and on two wheels.")
    ] = False,
) -> None:
    """Merge datasets. Ids are renumbered; sites, splits and licences are kept."""
    from skope.gen.formats.merge import merge as join

    *sources, out = paths
    join(sources, out, console, vehicles_alone=vehicles_alone)
    console.result(f"wrote {out}; next: {_check_command(out)}")


def _check_command(out: Path) -> str:
    return shlex.join(["skope", "gen", "check", str(out)])


app = Commands(help="Generate annotated roadside images.", invoke_without_command=True)
app.add_typer(vehicles.app, name="vehicles")
for command in (
    *(sites.sites, convert, merge),
    *(inspect.check, inspect.stats, inspect.show, inspect.report, inspect.view, inspect.video),
):
    app.command()(command)

LONG_RECORDING: Final = 150
"""Number of frames of a recording above which the command warns that they share one light. Presets have up to 105."""

OutOption = Annotated[Path, output(metavar=DIR_METAVAR, help="Dataset folder.")]


@app.callback()
def gen(
    dataset: DatasetOptions,
    workers: WorkerOptions,
    console: Console,
    out: OutOption = DATA_FOLDER,
    dry_run: Annotated[
        bool, machine("--dry-run", help="Print the number of images, disk space and run time; write nothing.")
    ] = False,
) -> None:
    """Generate a dataset: simulate traffic past roadside cameras; write images, depth and labels."""
    from skope.gen.pipeline.dataset_store import Store
    from skope.gen.pipeline.estimate import estimate
    from skope.gen.pipeline.generate import generate_dataset

    request, why = dataset.request()
    start_pool, worker_text = workers.pool_factory()
    expected = estimate(request, Store(out), workers.count()).line
    _announce(console, request, f"{worker_text}, {why}")
    if dry_run:
        console.result(expected)
        return
    console.say(expected)
    made = generate_dataset(request, out, start_pool, console)
    learnt = any(plan.site.split == "train" for plan in request.plans())
    command = f"skope train{_data(out)} --epochs 10" if learnt else f"skope eval{_data(out)}"
    _next(console, out, "wrote" if made else "", command)


@app.command()
def simulate(dataset: DatasetOptions, workers: WorkerOptions, console: Console, out: OutOption = DATA_FOLDER) -> None:
    """Simulate the recordings only. `skope gen render` draws them, also on a machine without SUMO and pybullet."""
    from skope.gen.pipeline.generate import simulate_dataset

    request, _ = dataset.request()
    start_pool, worker_text = workers.pool_factory()
    _announce(console, request, worker_text)
    made = simulate_dataset(request, out, start_pool, console)
    _next(console, out, "wrote the recordings of" if made else "", f"skope gen render {shlex.quote(str(out))}")


@app.command()
def render(
    workers: WorkerOptions,
    console: Console,
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="Output folder of `skope gen simulate`.")
    ] = DATA_FOLDER,
    renderer: RendererOption = "auto",
) -> None:
    """Render and annotate the recordings of a folder."""
    from skope.gen.pipeline.generate import render_dataset

    start_pool, _ = workers.pool_factory()
    made = render_dataset(dataset, renderer, start_pool, console)
    _next(console, dataset, "wrote" if made else "", f"skope train{_data(dataset)} --epochs 10")


def _announce(console: Console, request: "DatasetRequest", worker_text: str) -> None:
    user_site, parameters = request.user_site, request.parameters
    for line in user_site.messages if user_site else ():
        console.say(line)
    plans = request.plans()
    source = str(user_site.path) if user_site else f"preset {parameters.preset}"
    places = f"{counted(len(parameters.sites), 'site')} in {counted(len(plans), 'recording')}"
    images = f"{counted(request.images, 'image')} of {parameters.size}"
    console.say(f"{source}: {images} from {places}, seed {parameters.seed}, {worker_text}")
    longest = max(plan.frames for plan in plans)
    if longest > LONG_RECORDING and not (user_site and user_site.road.photograph):
        console.say(f"{longest} frames in a row have one weather and light: --recordings shares them out to several")


def _data(out: Path) -> str:
    return "" if out == DATA_FOLDER else f" --data {shlex.quote(str(out))}"


def _next(console: Console, out: Path, wrote: str, command: str) -> None:
    console.result(f"{f'{wrote} {out}' if wrote else f'{out} is complete already'}; next: {command}")
