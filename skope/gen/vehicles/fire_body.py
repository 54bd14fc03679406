"""Fire engines: shutters along the sides, a ladder on the roof, reflecting bands, lamps of their own."""

from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box
from skope.gen.vehicles.body_axes import LEFT_AXIS
from skope.gen.vehicles.cargo import Cargo, CargoSpace
from skope.gen.vehicles.lofted_surfaces import BOTTOM, SIDE, WRAP, Plan, Surface
from skope.gen.vehicles.panels import rectangle_outline
from skope.gen.vehicles.parts import arch_lip
from skope.gen.vehicles.upright_shells import Tower, arch

_LADDER: Final = 0.3
"""Height of the ladder over the roof, metres."""


def fire_body(space: CargoSpace) -> Cargo:
    """A fire engine's body: shutters along the sides, a ladder on the roof, reflecting bands, lamps of its own."""
    out = Cargo()
    floor, high = space.floor, space.shape.height - _LADDER
    well = space.shape.track / 2 - space.shape.wheel_width * 1.7
    tower = Tower(
        Plan(space.half - 0.01, space.ahead + 0.02, space.end + 0.02, 0.0, 0.0, 0.06, 0.05), floor, high, edge=0.06,
        crown=0.02, well=well, stations=9, levels=3,
    )  # fmt: skip
    shell, w, _ = tower.surface("paint")
    lining, rim = shell.carve_well(arch(space.rear_axle, space.shape), well)
    out.parts += [lining, arch_lip(rim, (space.rear_axle, space.shape.wheel_radius), "trim", shell.side)]
    end = float(w[-1])
    sill, edge = max(floor + 0.12, space.shape.wheel_radius * 2.2), end - space.half + 0.3
    _draw_shutters(shell, space, (sill, high - 0.3), end)
    out.parts += [shell.half, *_roof(space, high)]
    corner = end - space.half
    out.mark(
        shell.place((corner, high - 0.085), WRAP)[0],
        shell.place((edge, sill), WRAP)[0],
        shell.corner(BOTTOM, rear=True),
    )
    return out


def _draw_shutters(shell: Surface, space: CargoSpace, up: tuple[float, float], end: float) -> None:
    """Draw three shutters along the side and one behind, between two heights, a band below, lamps above.

    `end` is W of the middle of the rear.
    """
    (sill, top), edge = up, end - space.half + 0.3
    start, stop = space.end + 0.35, space.ahead - 0.2
    count = 3
    for k in range(count):
        a, b = (start + (stop - start) * (k + share) / count for share in (0.03, 0.97))
        shell.paint(rectangle_outline(a, b, sill, top), SIDE, "cladding_grey", facing=LEFT_AXIS)
        for z in np.arange(sill + 0.07, top, 0.09).tolist():
            shell.line([(a, z), (b, z)], SIDE, "rail", width=0.012, facing=LEFT_AXIS)
        shell.draw(rectangle_outline(a, b, sill, sill + 0.05), SIDE, "trim", layer=3, facing=LEFT_AXIS)
    band = rectangle_outline(space.end + 0.1, space.ahead - 0.05, sill - 0.2, sill - 0.06)
    shell.draw(band, SIDE, "#d8c41c", layer=3, facing=LEFT_AXIS)
    shell.paint(rectangle_outline(edge, end + 0.1, sill, top), WRAP, "cladding_grey")
    for z in np.arange(sill + 0.07, top, 0.09).tolist():
        shell.line([(edge, z), (end + 0.1, z)], WRAP, "rail", width=0.012)
    for z, lamp in ((top + 0.1, "brake_light"), (top - 0.06, "indicator_left")):
        shell.draw(rectangle_outline(edge - 0.22, edge - 0.06, z, z + 0.11), WRAP, lamp, layer=3)


def _roof(space: CargoSpace, high: float) -> list[Mesh]:
    """A ladder over a roof `high` over the road, boxes beside it, blue lamps over the cab and behind."""
    out: list[Mesh] = []
    add = out.append
    top = space.shape.height
    for z in (high + 0.08, top - 0.07):
        add(box((space.end + 0.2, 0.3, z), (space.ahead + 0.9, 0.36, z + 0.07), "chrome"))
    for x in np.arange(space.end + 0.35, space.ahead + 0.8, 0.35).tolist():
        add(box((x, 0.0, top - 0.06), (x + 0.04, 0.31, top - 0.02), "chrome"))
    add(box((space.end + 0.6, 0.55, high - 0.04), (space.ahead - 0.6, space.half - 0.2, high + 0.2), "rail"))
    bar = space.ahead + 0.45 * space.shape.cab_length
    add(
        box(
            (bar - 0.15, 0.42, space.cab_height - 0.08),
            (bar + 0.15, space.half - 0.25, space.cab_height + 0.12),
            "#1b52d8",
        )
    )
    add(
        box(
            (space.end + 0.1, space.half - 0.35, high - 0.04),
            (space.end + 0.3, space.half - 0.15, high + 0.12),
            "#1b52d8",
        )
    )
    return out
