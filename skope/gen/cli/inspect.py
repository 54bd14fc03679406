"""`skope gen check`, `stats`, `show`, `report`, `view`, `video`: what is in a dataset, and what a site looks like."""

import shlex
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skope.files.output_folders import replaceable_output
from skope.gen.cli.options import HOUR_CHOICES, WEATHER_CHOICES, RendererOption, WorkerOptions, camera, output, traffic
from skope.terminal.command_options import (
    DATA_FOLDER,
    DIR_METAVAR,
    GALLERY_FOLDER,
    LIST_METAVAR,
    SHEETS_FOLDER,
    SIZE_METAVAR,
    VIDEO_FOLDER,
    JsonOption,
    PortOption,
    option,
    panel,
    separated,
)
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.dataset.folder import Dataset

layer = panel("What to draw")

DatasetArgument = Annotated[Path, typer.Argument(metavar="DATASET", help="Dataset folder.")]


def _named(folder: Path, dataset: Path) -> Path:
    """Return the output folder for a dataset, with the name of the dataset."""
    return folder / dataset.resolve().name


def _look(dataset: "Dataset", command: str, out: Path, **how: Any) -> AbstractContextManager[Path]:
    """Open the output folder or file `out` of a command on a dataset, as `replaceable_output` does."""
    return replaceable_output(out, f"skope gen {command}", dataset.root, inputs=dataset.sources, **how)


def check(
    console: Console,
    dataset: DatasetArgument = DATA_FOLDER,
    repair: Annotated[bool, option("--repair", help="Generate broken files again.")] = False,
    against: Annotated[Path | None, option(metavar=DIR_METAVAR, help="Compare with this dataset instead.")] = None,
    workers: Annotated[
        int | None, option(help="Number of worker processes for --repair.", show_default="one per core")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check a dataset: files and their bytes, schema, ids, masks, re-projection, depth; exit code 1 with findings."""
    from skope.dataset.folder import open_dataset
    from skope.gen.inspect.check import check as find
    from skope.gen.inspect.check import repair as mend
    from skope.gen.inspect.diff import differences

    folder = open_dataset(dataset)
    findings = [] if against else list(find(folder))
    found = list(differences(folder, open_dataset(against))) if against else list(map(str, findings))
    if not json:
        for line in found:
            console.result(line)
        noun = f"{'difference' if against else 'finding'}{'' if len(found) == 1 else 's'}"
        console.result(f"{dataset}: {len(found) or 'no'} {noun}{f' from {against}' if against else ''}")
    if repaired := bool(findings and repair):
        start_pool, _ = WorkerOptions(workers=workers).pool_factory()
        mend(folder, findings, start_pool, replace(console, quiet=console.quiet or json))
    if json:
        results = (
            {"against": str(against), "differences": found} if against else {"findings": list(map(asdict, findings))}
        )
        console.document({"dataset": str(dataset), **results, "repaired": repaired})
    elif repaired:
        console.result(f"repaired {dataset}; next: skope gen check {shlex.quote(str(dataset))}")
    if found and not repaired:
        raise typer.Exit(1)


def stats(
    console: Console,
    dataset: DatasetArgument = DATA_FOLDER,
    plots: Annotated[Path | None, option(metavar=DIR_METAVAR, help="Folder for plots (PNG).")] = None,
    json: JsonOption = False,
) -> None:
    """Print statistics of a dataset: vehicles, distances, sizes, occlusion, visible keypoints and types, by split."""
    from skope.dataset.folder import open_dataset
    from skope.gen.inspect.stats import plot, split_stats, stats_table

    folder, drawn = open_dataset(dataset), None
    splits = {split: split_stats(folder, folder.read(split)) for split in folder.splits}
    if not json:
        for line in stats_table(splits):
            console.result(line)
    if plots:
        with _look(folder, "stats", plots, flag="--plots") as temporary:
            drawn = str(plots / plot(folder, temporary).name)
    if json:
        statistics = {split: numbers.to_dict() for split, numbers in splits.items()}
        console.document({"dataset": str(dataset), "splits": statistics, "plots": drawn})
    elif drawn:
        console.result(f"wrote {drawn}")


def show(
    console: Console,
    dataset: DatasetArgument = DATA_FOLDER,
    image: Annotated[int | None, option(help="Draw the image with this id.")] = None,
    sites: Annotated[
        str | None,
        option(metavar=LIST_METAVAR, help="One sheet for each of these sites, instead of one per split."),
    ] = None,
    keypoints: Annotated[bool, layer("--keypoints", help="Boxes, keypoints and skeletons.")] = False,
    boxes_3d: Annotated[bool, layer("--boxes-3d", help="3D boxes.")] = False,
    mask: Annotated[bool, layer("--mask", help="Visible pixels.")] = False,
    depth: Annotated[bool, layer("--depth", help="Depth, by colour.")] = False,
    occlusion: Annotated[bool, layer("--occlusion", help="Hidden fractions and reasons to ignore.")] = False,
    out: Annotated[
        Path | None,
        option(
            metavar=DIR_METAVAR,
            help="Folder for the images.",
            show_default=f"{SHEETS_FOLDER}/ and the dataset's name",
        ),
    ] = None,
) -> None:
    """Draw labels on images: keypoints by default, other layers on request."""
    from skope.dataset.folder import open_dataset
    from skope.gen.inspect.overlays import LAYER_NAMES, sheets, write_overlay

    flags = (keypoints, boxes_3d, mask, depth, occlusion)
    layers = [name for name, wanted in zip(LAYER_NAMES, flags, strict=True) if wanted] or ["keypoints"]
    folder = open_dataset(dataset)
    out = out or _named(SHEETS_FOLDER, dataset)
    with _look(folder, "show", out, options={"layers": layers}) as drawn:
        if image is not None:
            paths = [write_overlay(folder, image, layers, drawn)]
        else:
            names = sites.split(",") if sites is not None else [None]
            paths = [path for name in names for path in sheets(folder, name, layers, drawn)]
    for path in paths:
        console.result(f"wrote {out / path.name}")


def report(
    console: Console,
    dataset: DatasetArgument = DATA_FOLDER,
    max_images: Annotated[
        int,
        option(least=1, help="Maximum number of images, spread over splits, sites and recordings."),
    ] = 48,
    out: Annotated[
        Path | None,
        option(
            metavar=DIR_METAVAR, help="Folder for the page.", show_default=f"{GALLERY_FOLDER}/ and the dataset's name"
        ),
    ] = None,
) -> None:
    """Write a page about a dataset: card, statistics, plots, and images with layers and filters."""
    from skope.dataset.folder import open_dataset
    from skope.gen.inspect.report import write_dataset_report

    folder = open_dataset(dataset)
    out = out or _named(GALLERY_FOLDER, dataset)
    with _look(folder, "report", out) as drawn:
        page = write_dataset_report(folder, max_images, drawn / "index.html", console)
    console.result(f"wrote {out / page.name}")


def view(
    console: Console,
    dataset: DatasetArgument = DATA_FOLDER,
    split: Annotated[
        list[str] | None,
        option(
            metavar=LIST_METAVAR,
            help="Split to show; repeat it or separate several by commas.",
            show_default="all of them",
        ),
    ] = None,
    port: PortOption = None,
) -> None:
    """Show all images of a dataset in the browser, with layers and filters. Ctrl-C stops it."""
    from skope.dataset.folder import open_dataset
    from skope.gen.inspect.overlays import dataset_collection
    from skope.viewer.server import serve

    serve(dataset_collection(open_dataset(dataset), separated(split), console), port, console)


def video(
    site: Annotated[str, typer.Argument(metavar="SITE", help="A site of `skope gen sites`, or a site file.")],
    console: Console,
    seconds: Annotated[float, traffic(help="Duration, seconds.")] = 30.0,
    fps: Annotated[float, traffic(help="Frames per second: 5, 8, 10, 12.5, 20, 25, 40 or 50.")] = 25.0,
    seed: Annotated[int, traffic(help="Seed; the same seed gives the same footage.")] = 0,
    size: Annotated[str, camera(metavar=SIZE_METAVAR, help="Image size.")] = "1280x720",
    fov: Annotated[float, camera(help="Horizontal field of view, degrees.")] = 80.0,
    weather: Annotated[
        str | None,
        camera(
            choices=WEATHER_CHOICES,
            help="Weather.",
            show_default="the site's",
        ),
    ] = None,
    time_of_day: Annotated[
        str | None, camera(choices=HOUR_CHOICES, help="Time of day.", show_default="the site's")
    ] = None,
    road_users: Annotated[
        bool, traffic("--road-users", help="Also label people on foot and on two wheels, and generate more of them.")
    ] = False,
    overlay: Annotated[bool, output("--overlay", help="Write a second video with the labels drawn.")] = False,
    out: Annotated[
        Path, output(metavar=DIR_METAVAR, help="Folder for the video and its annotation file.")
    ] = VIDEO_FOLDER,
    renderer: RendererOption = "auto",
) -> None:
    """Generate a video of a site, with labels for every frame."""
    from skope.files.atomic import sha256_of
    from skope.gen.generation_site import own_site
    from skope.gen.labels.ignore_rules import Rules
    from skope.gen.pipeline.config import from_preset
    from skope.gen.pipeline.write_footage import plan_of, write_footage
    from skope.gen.render.choose_renderer import choose_renderer
    from skope.gen.scene.conditions import ranges
    from skope.gen.scene.package_versions import versions

    chosen, driver, _ = choose_renderer(renderer)
    user_site = own_site("SITE", site)
    request = from_preset(
        "demo",
        seed=seed,
        renderer=chosen,
        driver=driver,
        rules=Rules(),
        frames=1,
        user_site=user_site,
        sites=None if user_site else (site,),
        size=None if user_site else size,
        fov_deg=None if user_site else fov,
        road_users=road_users,
    )
    plan = plan_of(request.plans()[0], fps, seconds, f"{user_site.path}: camera.size" if user_site else "--size")
    here = replace(
        plan.site,
        weather=weather or plan.site.weather,
        time_of_day=time_of_day or plan.site.time_of_day,
        conditions={} if weather or time_of_day else plan.site.conditions,
    )
    ranges(here.weather, here.time_of_day)  # knows their names
    options = {
        "site": sha256_of(user_site.path) if user_site else site,
        "fps": fps,
        "seconds": seconds,
        "size": request.parameters.size,
        "fov": request.parameters.fov_deg,
        "weather": here.weather,
        "time_of_day": here.time_of_day,
        "seed": seed,
        "renderer": driver,
        "versions": versions(),
        **({"road_users": True} if road_users else {}),
    }
    made = write_footage(replace(plan, site=here), chosen, out, options=options, with_overlay=overlay, console=console)
    for path in (made.video, made.labels, made.overlay):
        if path:
            console.result(f"wrote {path}")
