"""`skope gen vehicles`: the fleet's models listed and drawn."""

from pathlib import Path
from typing import Annotated

import typer

from skope.console import Console, QuietOption, VersionOption

app = typer.Typer(help="List and draw the vehicle models.", no_args_is_help=True)


@app.command("list")
def list_models(quiet: QuietOption = False, version: VersionOption = False) -> None:
    """A table of the models: type, length x width x height, wheelbase, triangles, share of the traffic."""
    from skope.gen.vehicles import fleet

    console = Console(quiet)
    console.result(f"{'model':<12} {'type':<12} {'L x W x H, m':<19} {'wheelbase':>9} {'triangles':>9} {'share':>6}")
    total = sum(entry.share for entry in fleet().values())
    for name, entry in fleet().items():
        vehicle = entry.vehicle
        size = " x ".join(f"{metres:.2f}" for metres in vehicle.size_lwh)
        triangles = len(vehicle.mesh.triangles) + 4 * len(vehicle.wheel.triangles)
        console.result(
            f"{name:<12} {vehicle.vehicle_type:<12} {size:<19} {vehicle.shape.wheelbase:9.2f} {triangles:9d} "
            f"{entry.share / total:6.1%}"
        )


@app.command()
def show(
    name: Annotated[str | None, typer.Argument(help="One model instead of all.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the sheets.")] = Path("runs/vehicles"),
    renderer: Annotated[str, typer.Option(help="gl, pybullet, or auto: gl where OpenGL can be had.")] = "auto",
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Draw contact sheets: front, rear, side, top and three quarters, plain and with numbered keypoints."""
    from skope import draw
    from skope.errors import one_of
    from skope.gen.render import choose_renderer
    from skope.gen.vehicles import fleet
    from skope.gen.vehicles.show import sheet

    console = Console(quiet)
    models = tuple(fleet()) if name is None else (one_of("model", name, tuple(fleet())),)
    engine, _, why = choose_renderer(renderer)
    console.say(why)
    for model in console.bar(models, total=len(models), unit="model", label="drawing"):
        draw.write(out / f"{model}.png", sheet(fleet()[model].vehicle, engine))
    console.result(f"wrote {len(models)} sheet{'' if len(models) == 1 else 's'} to {out}")
