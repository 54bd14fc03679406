"""`skope gen check`, `stats`, `show`, `report` and `video`: what is in a dataset, and what a site looks like."""

import shlex
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skope.console import Console, QuietOption, VersionOption
from skope.gen.cli.workers import WorkersOption, hired
from skope.outputs import look

if TYPE_CHECKING:
    from skope.dataset import Dataset

DatasetArgument = Annotated[Path, typer.Argument(help="Dataset folder.")]
DEFAULT = Path("data/skope")
SHOWN = Path("runs/show")
REPORTED = Path("runs/gallery")


def _named(folder: Path, dataset: Path) -> Path:
    """A folder for what is made of a dataset, called as the dataset is."""
    return folder / dataset.resolve().name


def _look(dataset: "Dataset", command: str, out: Path, **how: Any) -> AbstractContextManager[Path]:
    """`skope.outputs.look` at a dataset."""
    return look(out, f"skope gen {command}", dataset.root, inputs=dataset.sources, **how)


def check(
    dataset: DatasetArgument = DEFAULT,
    repair: Annotated[bool, typer.Option("--repair", help="Make what is broken again.")] = False,
    against: Annotated[Path | None, typer.Option(help="Another dataset: say how the two differ instead.")] = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Check a dataset: files and their bytes, schema, ids, masks, re-projection, depth; exit code 1 with findings."""
    from skope.dataset import open_dataset
    from skope.gen.inspect.check import check as find
    from skope.gen.inspect.diff import differences
    from skope.gen.inspect.repair import repair as mend

    console, folder = Console(quiet), open_dataset(dataset)
    findings = [] if against else list(find(folder))
    found = list(differences(folder, open_dataset(against))) if against else list(map(str, findings))
    for line in found:
        console.result(line)
    one, what = len(found) == 1, "difference" if against else "finding"
    console.result(f"{dataset}: {len(found) or 'no'} {what}{'' if one else 's'}{f' from {against}' if against else ''}")
    if findings and repair:
        hire, _ = hired("local", workers, None)
        mend(folder, findings, hire, console)
        console.result(f"repaired {dataset}; next: skope gen check {shlex.quote(str(dataset))}")
    elif found:
        raise typer.Exit(1)


def stats(
    dataset: DatasetArgument = DEFAULT,
    plots: Annotated[Path | None, typer.Option(help="Folder for plots (PNG).")] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Say what a dataset holds: vehicles, distances, sizes, occlusion, visible keypoints and types, split by split."""
    from skope.dataset import open_dataset
    from skope.gen.inspect.stats import plot, split_stats, table

    console, folder = Console(quiet), open_dataset(dataset)
    for line in table({split: split_stats(folder, folder.read(split)) for split in folder.splits}):
        console.result(line)
    if plots:
        with _look(folder, "stats", plots, flag="--plots") as drawn:
            path = plot(folder, drawn)
        console.result(f"wrote {plots / path.name}")


def show(
    dataset: DatasetArgument = DEFAULT,
    image: Annotated[int | None, typer.Option(help="Draw the image with this id.")] = None,
    site: Annotated[str | None, typer.Option(help="A sheet of this site instead of one for each split.")] = None,
    keypoints: Annotated[bool, typer.Option("--keypoints", help="Boxes, keypoints and skeletons.")] = False,
    boxes_3d: Annotated[bool, typer.Option("--boxes-3d", help="3D boxes.")] = False,
    mask: Annotated[bool, typer.Option("--mask", help="Visible pixels.")] = False,
    depth: Annotated[bool, typer.Option("--depth", help="Depth, by colour.")] = False,
    occlusion: Annotated[bool, typer.Option("--occlusion", help="Hidden shares and reasons to ignore.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the pictures.", show_default="runs/show/ and the dataset's name")
    ] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Draw labels on images: keypoints by default, and anything else of them."""
    from skope.dataset import open_dataset
    from skope.gen.inspect.overlays import LAYERS, one_image, sheets

    flags = (keypoints, boxes_3d, mask, depth, occlusion)
    layers = [name for name, wanted in zip(LAYERS, flags, strict=True) if wanted] or ["keypoints"]
    console, folder = Console(quiet), open_dataset(dataset)
    out = out or _named(SHOWN, dataset)
    with _look(folder, "show", out, options={"layers": layers}) as drawn:
        paths = [one_image(folder, image, layers, drawn)] if image is not None else sheets(folder, site, layers, drawn)
    for path in paths:
        console.result(f"wrote {out / path.name}")


def report(
    dataset: DatasetArgument = DEFAULT,
    images: Annotated[int, typer.Option(help="At most so many images, spread over splits, sites and recordings.")] = 48,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page.", show_default="runs/gallery/ and the dataset's name")
    ] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """One page to look at a dataset: its card, numbers and plots, and images with layers to switch and to filter by."""
    from skope.dataset import open_dataset
    from skope.gen.inspect.report import write_report

    console, folder = Console(quiet), open_dataset(dataset)
    out = out or _named(REPORTED, dataset)
    with _look(folder, "report", out) as drawn:
        page = write_report(folder, images, drawn / "index.html", console)
    console.result(f"wrote {out / page.name}")


def video(
    site: Annotated[str, typer.Argument(help="A site of `skope gen sites`, or a site file.")],
    fps: Annotated[float, typer.Option(help="Frames a second: 5, 8, 10, 12.5, 20, 25, 40 or 50.")] = 25.0,
    seconds: Annotated[float, typer.Option(help="Length.")] = 30.0,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT.")] = "1280x720",
    fov: Annotated[float, typer.Option(help="Horizontal field of view, degrees.")] = 80.0,
    weather: Annotated[str | None, typer.Option(help="Instead of the site's.")] = None,
    time_of_day: Annotated[str | None, typer.Option(help="noon, low_sun, dawn, dusk or night.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same footage.")] = 0,
    overlay: Annotated[bool, typer.Option("--overlay", help="Write a second video with the labels drawn.")] = False,
    renderer: Annotated[str, typer.Option(help="gl, pybullet, or auto: gl where OpenGL can be had.")] = "auto",
    out: Annotated[Path, typer.Option(help="Folder for the video and its annotation file.")] = Path("runs/video"),
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Make footage of a site, with labels of every frame."""
    from skope.files import sha256_of
    from skope.gen.labels.annotate import Rules
    from skope.gen.pipeline.config import from_preset
    from skope.gen.pipeline.footage import plan_of, write_footage
    from skope.gen.render.choose import choose_renderer
    from skope.gen.scene.conditions import ranges
    from skope.gen.simulation.simulate import versions
    from skope.gen.site_files.site_file import read_site

    chosen, driver, _ = choose_renderer(renderer)
    own = read_site(Path(site)) if site.endswith(".toml") else None
    parameters = from_preset(
        "demo",
        seed=seed,
        renderer=chosen,
        driver=driver,
        rules=Rules(),
        frames=1,
        own=own,
        sites=None if own else (site,),
        size=None if own else size,
        fov_deg=None if own else fov,
    )
    plan = plan_of(parameters.plans()[0], fps, seconds, f"{own.path}: camera.size" if own else "--size")
    here = replace(
        plan.site,
        weather=weather or plan.site.weather,
        time_of_day=time_of_day or plan.site.time_of_day,
        conditions={} if weather or time_of_day else plan.site.conditions,
    )
    ranges(here.weather, here.time_of_day)  # knows their names
    console = Console(quiet)
    options = {
        "site": sha256_of(own.path) if own else site,
        "fps": fps,
        "seconds": seconds,
        "size": parameters.size,
        "fov": parameters.fov_deg,
        "weather": here.weather,
        "time_of_day": here.time_of_day,
        "seed": seed,
        "renderer": driver,
        "versions": versions(),
    }
    made = write_footage(replace(plan, site=here), chosen, out, options=options, with_overlay=overlay, console=console)
    for path in (made.video, made.labels, made.overlay):
        if path:
            console.result(f"wrote {path}")
