"""`skope gen`: make datasets and check them."""

from pathlib import Path
from typing import Annotated

import typer

from skope.console import Console, QuietOption, VersionOption
from skope.gen import sites_cli, vehicles_cli

app = typer.Typer(help="Generate annotated roadside images.", invoke_without_command=True)
app.add_typer(vehicles_cli.app, name="vehicles")
app.command()(sites_cli.sites)


@app.callback()
def gen(
    ctx: typer.Context,
    preset: Annotated[str, typer.Option(help="Which dataset to make (see the README).")] = "demo",
    out: Annotated[Path, typer.Option(help="Dataset folder.")] = Path("data/skope"),
    seed: Annotated[int, typer.Option(help="Same seed, same dataset.")] = 0,
    workers: Annotated[int | None, typer.Option(help="Worker processes; by default one per core.")] = None,
    renderer: Annotated[str, typer.Option(help="gl, pybullet, or auto: gl where OpenGL can be had.")] = "auto",
    sites: Annotated[str | None, typer.Option(help="Comma-separated sites instead of the preset's.")] = None,
    own: Annotated[
        Path | None, typer.Option("--site", help="A site file: your own road and camera instead of --sites.")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Frames per site.")] = None,
    interval: Annotated[float | None, typer.Option(help="Seconds between frames.")] = None,
    size: Annotated[str | None, typer.Option(help="Image size, WIDTHxHEIGHT.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view, degrees.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A condition as NAME=VALUE or NAME=LOW..HIGH (see the README); repeatable."),
    ] = None,
    vehicles: Annotated[
        str | None, typer.Option(help="Comma-separated models of `skope gen vehicles add` that drive by too.")
    ] = None,
    shape_jitter: Annotated[
        bool, typer.Option(help="Give every vehicle a shape of its own, near its model's.")
    ] = False,
    camera_jitter: Annotated[
        bool, typer.Option(help="Hang and turn each recording's camera a little differently.")
    ] = False,
    localizer: Annotated[str, typer.Option(help="rigid, or trilateration as in the paper.")] = "rigid",
    occlusion_rule: Annotated[
        str, typer.Option(help="others: ignore what something else hides; paper: remove what is half hidden.")
    ] = "others",
    min_visible: Annotated[float, typer.Option(help="Ignore vehicles of which a smaller share is seen.")] = 0.15,
    min_box: Annotated[float, typer.Option(help="Ignore boxes whose shorter edge is under this, pixels.")] = 12.0,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Drive SUMO traffic through a pybullet world past roadside cameras; write images, depth and labels."""
    if ctx.invoked_subcommand is not None:
        return
    from skope.errors import UserError
    from skope.gen.annotate import Rules
    from skope.gen.conditions import parse_settings
    from skope.gen.own.site import read_site
    from skope.gen.plan import from_preset
    from skope.gen.produce import check_workers, default_workers, produce
    from skope.gen.render import choose_renderer
    from skope.gen.vehicles.added import load

    if own and (sites or fov is not None):
        raise UserError(f"--site: {own} says where the camera is and what it sees: leave --sites and --fov out")
    chosen, driver, why = choose_renderer(renderer)
    rules = Rules(occlusion=occlusion_rule, localizer=localizer, min_visible=min_visible, min_box=min_box)
    parameters = from_preset(
        preset,
        seed=seed,
        renderer=chosen,
        driver=driver,
        rules=rules,
        sites=tuple(sites.split(",")) if sites else None,
        frames=frames,
        interval_s=interval,
        size=size,
        fov_deg=fov,
        settings=parse_settings(settings or []),
        vehicles={name: load(name).digest for name in vehicles.split(",")} if vehicles else {},
        shape_jitter=shape_jitter,
        own=read_site(own) if own else None,
        camera_jitter=camera_jitter,
    )
    console = Console(quiet)
    for line in parameters.own.said if parameters.own else ():
        console.say(line)
    count = check_workers(default_workers() if workers is None else workers)
    source = str(own) if own else f"preset {preset}"
    places = "1 site" if own else f"{len(parameters.sites)} sites"
    console.say(
        f"{source}: {parameters.images} images of {parameters.size} from {places}, seed {seed}, {count} workers, {why}"
    )
    made = produce(parameters, out, count, console)
    done = f"wrote {out}" if made else f"{out} is complete already"
    elsewhere = "" if out == Path("data/skope") else f" --data {out}"
    console.result(f"{done}; next: skope train{elsewhere} --epochs 10")


@app.command()
def check(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder.")] = Path("data/skope"),
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Check a dataset: schema, ids, files, re-projection, visibility against depth; exit code 1 with findings."""
    from skope.dataset import open_dataset
    from skope.gen.check import check as find

    console = Console(quiet)
    count = 0
    for finding in find(open_dataset(dataset)):
        count += 1
        console.result(finding)
    console.result(f"{dataset}: {count or 'no'} finding{'' if count == 1 else 's'}")
    if count:
        raise typer.Exit(1)


@app.command()
def stats(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder.")] = Path("data/skope"),
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Say what a dataset holds: vehicles, distances, sizes, occlusion, visible keypoints and types, split by split."""
    from skope.dataset import open_dataset
    from skope.gen.stats import split_stats, table

    console, folder = Console(quiet), open_dataset(dataset)
    for line in table({split: split_stats(folder, split) for split in folder.splits}):
        console.result(line)


@app.command()
def doctor(
    pictures: Annotated[Path | None, typer.Option(help="Folder for a test image of each renderer.")] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Say what is installed, what of it works, and what to do about the rest; exit code 1 when something does not."""
    from skope.gen.doctor import examine

    console = Console(quiet)
    broken = []
    for finding in examine(pictures):
        if not finding.works:
            broken.append(finding.part)
        console.result(f"{'ok ' if finding.works else 'NOT'} {finding.part:<18} {finding.text}")
    console.result(f"not working: {', '.join(broken)}" if broken else "everything works; next: skope gen")
    if broken:
        raise typer.Exit(1)
