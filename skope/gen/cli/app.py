"""`skope gen`: make datasets and check them."""

import shlex
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skope.console import Console, QuietOption, VersionOption, goes_on
from skope.gen.cli import convert as formats_cli
from skope.gen.cli import inspect, sites, vehicles
from skope.gen.cli.options import asks_for_a_dataset
from skope.gen.cli.workers import AddressOption, EngineOption, WorkersOption, hired
from skope.outputs import look

if TYPE_CHECKING:
    from skope.gen.pipeline.config import Parameters

app = typer.Typer(help="Generate annotated roadside images.", invoke_without_command=True)
app.add_typer(vehicles.app, name="vehicles")
app.command()(sites.sites)
app.command()(formats_cli.convert)
app.command()(formats_cli.merge)
for command in (inspect.check, inspect.stats, inspect.show, inspect.report, inspect.video):
    app.command()(command)

DEFAULT = Path("data/skope")
OutOption = Annotated[Path, typer.Option(help="Dataset folder.")]


@app.callback()
@asks_for_a_dataset
def gen(
    ctx: typer.Context,
    asked: "Callable[[], tuple[Parameters, str]]",
    out: OutOption = DEFAULT,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    address: AddressOption = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Drive SUMO traffic through a pybullet world past roadside cameras; write images, depth and labels."""
    if goes_on(ctx):
        return
    from skope.gen.pipeline.generate import produce

    console, (parameters, why) = Console(quiet), asked()
    hire, who = hired(engine, workers, address)
    _announce(console, parameters, f"{who}, {why}")
    made = produce(parameters, out, hire, console)
    _next(console, out, "wrote" if made else "", f"skope train{_data(out)} --epochs 10")


@app.command()
@asks_for_a_dataset
def simulate(
    asked: "Callable[[], tuple[Parameters, str]]",
    out: OutOption = DEFAULT,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    address: AddressOption = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Make the recordings only; `skope gen render` draws them, here or on a machine without SUMO and pybullet."""
    from skope.gen.pipeline.generate import simulate_only

    console, (parameters, _) = Console(quiet), asked()
    hire, who = hired(engine, workers, address)
    _announce(console, parameters, who)
    made = simulate_only(parameters, out, hire, console)
    _next(console, out, "wrote the recordings of" if made else "", f"skope gen render {shlex.quote(str(out))}")


@app.command()
def render(
    dataset: Annotated[Path, typer.Argument(help="Folder that `skope gen simulate` made.")] = DEFAULT,
    renderer: Annotated[str, typer.Option(help="gl, pybullet, or auto: gl where OpenGL can be had.")] = "auto",
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    address: AddressOption = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Draw and annotate the recordings of a folder."""
    from skope.gen.pipeline.generate import render_only

    console = Console(quiet)
    hire, _ = hired(engine, workers, address)
    made = render_only(dataset, renderer, hire, console)
    _next(console, dataset, "wrote" if made else "", f"skope train{_data(dataset)} --epochs 10")


def _announce(console: Console, parameters: "Parameters", who: str) -> None:
    own = parameters.own
    for line in own.said if own else ():
        console.say(line)
    source, places = (
        (str(own.path), "1 site") if own else (f"preset {parameters.preset}", f"{len(parameters.sites)} sites")
    )
    console.say(
        f"{source}: {parameters.images} images of {parameters.size} from {places}, seed {parameters.seed}, {who}"
    )


def _data(out: Path) -> str:
    return "" if out == DEFAULT else f" --data {shlex.quote(str(out))}"


def _next(console: Console, out: Path, wrote: str, command: str) -> None:
    console.result(f"{f'{wrote} {out}' if wrote else f'{out} is complete already'}; next: {command}")


@app.command()
def doctor(
    pictures: Annotated[Path | None, typer.Option(help="Folder for a test image of each renderer.")] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Say what is installed, what of it works, and what to do about the rest; exit code 1 when something does not."""
    from skope.gen.inspect.doctor import examine

    console = Console(quiet)
    broken = []
    shown = look(pictures, "skope gen doctor", "the renderers", flag="--pictures") if pictures else nullcontext()
    with shown as drawn:
        for finding in examine(drawn):
            if not finding.works:
                broken.append(finding.part)
            console.result(f"{'ok ' if finding.works else 'NOT'} {finding.part:<18} {finding.text}")
    if pictures:
        console.result(f"wrote what the renderers drew to {pictures}")
    console.result(f"not working: {', '.join(broken)}" if broken else "everything works; next: skope gen")
    if broken:
        raise typer.Exit(1)
