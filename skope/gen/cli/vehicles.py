"""`skope gen vehicles`: the fleet's models listed, checked and drawn."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skope.errors import UserError
from skope.files.output_folders import replaceable_output
from skope.files.safe_names import name as check_name
from skope.gen.cli.options import RendererOption
from skope.schema import VEHICLE_TYPES
from skope.terminal.command_options import DIR_METAVAR, VEHICLE_SHEETS, Commands, option
from skope.terminal.console import Console, counted, text_table

if TYPE_CHECKING:
    from skope.gen.vehicles.fleet import FleetEntry
    from skope.gen.vehicles.model import Vehicle

app = Commands(help="List, check, draw, add and remove vehicle models.", no_args_is_help=True)

NameArgument = Annotated[str | None, typer.Argument(metavar="MODEL", help="One model instead of all.")]


@app.command("list")
def list_models(console: Console) -> None:
    """List the models: type, length x width x height, wheelbase, triangles, share of the traffic."""
    from skope.gen.vehicles.fleet import fleet
    from skope.gen.vehicles.model import straight_lwh

    total = sum(entry.share for entry in fleet().values())
    models, damaged = _readable(_names())
    rows = []
    for name, vehicle in models.items():
        entry = fleet().get(name)
        rows.append(
            [
                name,
                vehicle.vehicle_type,
                " x ".join(f"{metres:.2f}" for metres in straight_lwh(vehicle)),
                f"{vehicle.shape.wheelbase:.2f}",
                sum(len(part.triangles) for part in vehicle.parts),
                f"{entry.share / total:.1%}" if entry else "added",
                ", ".join(_notes(entry)) if entry else "",
            ]
        )
    head = ["model", "type", "L x W x H, m", "wheelbase, m", "triangles", "share", ""]
    for line in text_table(head, rows, "lllrrrl"):
        console.result(line)
    if damaged:
        raise UserError("; ".join(damaged))


def _notes(entry: "FleetEntry") -> list[str]:
    """Return the sites where a model of the fleet drives, if not everywhere."""
    notes = {"presets world, conditions": entry.further, "held out for test sites": entry.held_out}
    return [note for note, holds in notes.items() if holds]


@app.command()
def check(console: Console, name: NameArgument = None) -> None:
    """Check keypoints, symmetry, dimensions, wheels, surfaces, parts and sidecars; exit code 1 with findings."""
    from skope.gen.inspect.vehicle_models import findings

    count = 0
    models, damaged = _readable(_names(name))
    for model, vehicle in models.items():
        for finding in findings(vehicle):
            count += not finding.harmless
            console.result(f"{model}: {finding}")
    for text in damaged:
        console.result(text)
    count, total = count + len(damaged), len(models) + len(damaged)
    console.result(f"{counted(total, 'model')}, {count or 'no'} findings")
    if count:
        raise typer.Exit(1)


@app.command()
def show(
    console: Console,
    name: NameArgument = None,
    out: Annotated[Path, option(metavar=DIR_METAVAR, help="Folder for the sheets.")] = VEHICLE_SHEETS,
    renderer: RendererOption = "auto",
) -> None:
    """Draw contact sheets: front, rear, side, top and three quarters, plain and with numbered keypoints."""
    from skope.gen.inspect.vehicle_models import sheet
    from skope.gen.render.choose_renderer import choose_renderer
    from skope.gen.vehicles import user_models
    from skope.pictures import draw

    engine, driver, why = choose_renderer(renderer)
    console.say(why)
    models = {model: _loaded(model) for model in _names(name)}
    files = [user_models.models_folder() / model / "vehicle.json" for model in user_models.model_names()]
    with replaceable_output(
        out, "skope gen vehicles show", "the fleet", inputs=files, options={"renderer": driver}
    ) as drawn:
        for model, vehicle in console.bar(models.items(), total=len(models), unit="model", label="drawing"):
            draw.write(drawn / f"{model}.png", sheet(vehicle, engine))
    console.result(f"wrote {counted(len(models), 'sheet')} to {out}")


@app.command()
def add(
    model: Annotated[
        Path, typer.Argument(metavar="FILE", help="A .glb, .gltf or .obj file with 33 markers (see docs/vehicles.md).")
    ],
    console: Console,
    name: Annotated[
        str | None, option(metavar="NAME", help="Name of the model.", show_default="the name of the file")
    ] = None,
    vehicle_type: Annotated[
        str,
        option("--type", choices=VEHICLE_TYPES, help="Its vehicle_type in annotations."),
    ] = "other",
    wheels: Annotated[
        str | None,
        option(
            metavar="CORNER=OBJECT,..",
            help="Objects of the wheels; the corners are front_right, front_left, rear_right and rear_left.",
        ),
    ] = None,
    up: Annotated[str | None, option(metavar="AXIS", help="The file's axis that points up, such as +y.")] = None,
    forward: Annotated[
        str | None, option(metavar="AXIS", help="The file's axis that points forward, such as -z.")
    ] = None,
    scale: Annotated[float, option(help="Metres per unit of the file.")] = 1.0,
    mass: Annotated[float | None, option(help="Mass, kilograms.", show_default="as dense as a car")] = None,
) -> None:
    """Add a vehicle model from a file with markers. Use it with `skope gen --vehicles NAME`."""
    from skope.gen.inspect.vehicle_models import findings
    from skope.gen.vehicles.fleet import fleet
    from skope.gen.vehicles.marked_models import read_marked
    from skope.gen.vehicles.user_models import check_mass, save_model, vehicle_of_model

    called = model.stem if name is None else name
    if not re.fullmatch(r"\w[\w-]*", called, re.ASCII) or called in fleet():
        raise UserError(f"--name {called}: expected letters, digits, - (not at first) and _, and no model of the fleet")
    check_name("--name", called)
    if not 0 < scale < math.inf:
        raise UserError(f"--scale: expected a positive number, got {scale}")
    if mass is not None:
        check_mass("--mass", mass)
    marked = read_marked(model, wheels=_corners(wheels), up=up, forward=forward, scale=scale)
    vehicle = vehicle_of_model(marked, called, vehicle_type, mass)
    found = list(findings(vehicle))
    for finding in found:
        console.result(f"{'note' if finding.harmless else 'error'}: {finding}")
    if any(not finding.harmless for finding in found):
        raise UserError(f"{model}: not added; mend the errors above")
    length, width, height = vehicle.size_lwh
    path = save_model(vehicle)
    console.result(
        f"wrote {path}: {length:.2f} x {width:.2f} x {height:.2f} m; next: skope gen vehicles show {called}, "
        f"skope gen --vehicles {called}"
    )


@app.command()
def remove(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A model of `skope gen vehicles add`.")],
    console: Console,
) -> None:
    """Remove an added model. Datasets with it stay complete, but cannot be resumed or extended."""
    from skope.gen.vehicles import user_models
    from skope.gen.vehicles.fleet import fleet

    if model in fleet():
        raise UserError(f"{model}: is a model of the fleet, which stays; only models that were added can be removed")
    console.result(f"removed {user_models.remove_model(model)}")


def _corners(text: str | None) -> dict[str, str] | None:
    """ "front_right=A,..." as a mapping."""
    if text is None:
        return None
    pairs = [part.split("=", 1) for part in text.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise UserError(f"--wheels: expected CORNER=OBJECT,..., got {text!r}")
    return {pair[0]: pair[1] for pair in pairs}


def _names(name: str | None = None) -> tuple[str, ...]:
    """Return all models of the fleet and added ones, or the one with that name."""
    from skope.errors import one_of
    from skope.gen.vehicles.fleet import fleet
    from skope.gen.vehicles.user_models import model_names

    everything = tuple(dict.fromkeys((*fleet(), *model_names())))
    return everything if name is None else (one_of("model", name, everything),)


def _loaded(model: str) -> "Vehicle":
    from skope.gen.vehicles.fleet import fleet
    from skope.gen.vehicles.user_models import load_model

    return fleet()[model].vehicle if model in fleet() else load_model(model)


def _readable(models: tuple[str, ...]) -> tuple[dict[str, "Vehicle"], list[str]]:
    """Return vehicles by name, and messages about damaged ones."""
    vehicles, damaged = {}, []
    for model in models:
        try:
            vehicles[model] = _loaded(model)
        except UserError as error:
            damaged.append(str(error))
    return vehicles, damaged
