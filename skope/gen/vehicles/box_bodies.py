"""Closed cargo bodies with liveries: boxes with doors or a roller shutter, refrigerated ones, curtain sides."""

from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box
from skope.gen.vehicles import parts
from skope.gen.vehicles.body_axes import LEFT_AXIS
from skope.gen.vehicles.cargo import Cargo, CargoSpace
from skope.gen.vehicles.liveries import MARKER, TONES, draw_graphics, draw_upper_markers
from skope.gen.vehicles.lofted_surfaces import BOTTOM, ROWS, SIDE, WRAP, Plan, Surface
from skope.gen.vehicles.panels import rectangle_outline
from skope.gen.vehicles.solids import prism
from skope.gen.vehicles.upright_shells import Tower

_INSET: Final = 0.11
"""Width of the frame around the doors, metres."""
_SHUTTER: Final = 0.4
"""Share of boxes whose rear is a roller shutter."""


def box_body(space: CargoSpace) -> Cargo:
    """A box of smooth panels; with a cooling unit if the style says so."""
    rng, out = space.rng(), Cargo()
    shell, end = _shell(space, "livery")
    high = space.shape.height
    sill, top = space.floor + 0.12, high - 0.16
    draw_graphics(shell, (space.end + 0.2, space.ahead - 0.2), (sill + 0.05, top), rng)
    for x in np.linspace(space.ahead - 0.04, space.end + 0.04, 2):
        shell.draw(rectangle_outline(x - 0.035, x + 0.035, sill, top + 0.04), SIDE, "rail", layer=3, facing=LEFT_AXIS)
    _rear(shell, space, end, shutter=rng.uniform() < _SHUTTER)
    out.parts.append(shell.half)
    if space.style.cooled:
        low = high - 1.25
        out.parts.append(
            parts.block((space.ahead - 0.02, -0.75, low), (space.ahead + 0.42, 0.75, high - 0.12), "#e4e4e2", 0.07)
        )
        corners = (space.ahead + 0.405, 0.0, low + 0.15), (space.ahead + 0.43, 0.55, low + 0.7)
        out.parts.append(box(*corners, "grille"))
    _mark(out, shell, space, end)
    return out


def curtain_body(space: CargoSpace) -> Cargo:
    """A frame with curtains of tarpaulin along the sides: straps with buckles, and folds between the posts."""
    rng, out = space.rng(), Cargo()
    shell, end = _shell(space, "livery")
    sill, top = space.floor + 0.12, space.shape.height - 0.16
    folds = np.arange(space.end + 0.35, space.ahead - 0.25, 0.46).tolist()
    for x in folds:
        # A fold: a lighter and a darker line side by side, as light falls along it.
        wide = float(rng.uniform(0.03, 0.07))
        shell.draw(rectangle_outline(x, x + wide, sill, top), SIDE, "tarpaulin" if wide > 0.06 else "rail", layer=1)
    draw_graphics(shell, (space.end + 0.2, space.ahead - 0.2), (sill + 0.22, top - 0.05), rng)
    for x in folds:
        shell.draw(rectangle_outline(x - 0.02, x + 0.02, sill, sill + 0.34), SIDE, "trim", layer=8, facing=LEFT_AXIS)
        shell.draw(
            rectangle_outline(x - 0.035, x + 0.035, sill + 0.1, sill + 0.17), SIDE, "chrome", layer=10, facing=LEFT_AXIS
        )
    for x in (space.ahead - 0.05, space.end + 0.05):
        shell.draw(rectangle_outline(x - 0.05, x + 0.05, sill, top + 0.04), SIDE, "rail", layer=3, facing=LEFT_AXIS)
    _rear(shell, space, end, shutter=False)
    out.parts.append(shell.half)
    _mark(out, shell, space, end)
    return out


def _shell(space: CargoSpace, material: str) -> tuple[Surface, float]:
    """The box, with rails along its upper and lower edges, and marker lamps on these; W of the middle of its rear."""
    tower = Tower(
        Plan(space.half, space.ahead, space.end, 0.0, 0.0, 0.05, 0.035),
        space.floor,
        space.shape.height,
        [(0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.012)],
        edge=0.05,
        crown=0.015,
        ridge=0.5,
        stations=3,
        levels=2,
    )
    shell, w, _ = tower.surface(material)
    shell.draw(rectangle_outline(-1, 99, 0, space.floor + 0.09), WRAP, "rail")
    shell.draw(rectangle_outline(-1, 99, space.shape.height - 0.12, space.shape.height - 0.06), WRAP, "rail")
    z = space.floor + 0.035
    for x in np.arange(space.end + 0.5, space.ahead - 0.4, 1.1).tolist():
        shell.draw(rectangle_outline(x - 0.03, x + 0.03, z, z + 0.03), SIDE, MARKER, layer=4)
    return shell, float(w[-1])


def _rear(shell: Surface, space: CargoSpace, end: float, *, shutter: bool) -> None:
    """Two doors with bolts and hinges, or the slats of a shutter."""
    edge, sill, top = end - space.half + _INSET, space.floor + 0.12, space.shape.height - 0.16
    shell.line([(end + 0.1, sill), (edge, sill), (edge, top), (end + 0.1, top)], WRAP, width=0.02)
    if shutter:
        for z in np.arange(sill + 0.12, top - 0.05, 0.16).tolist():
            shell.line([(edge, z), (end + 0.1, z)], WRAP, width=0.012)
        shell.draw(rectangle_outline(end - 0.3, end + 0.1, sill + 0.06, sill + 0.1), WRAP, "trim", layer=2)
    else:
        shell.line([(end, sill), (end, top)], WRAP, width=0.016)
        for share in (0.28, 0.6):
            bolt = rectangle_outline(end - share - 0.012, end - share + 0.012, sill + 0.05, top - 0.05)
            shell.draw(bolt, WRAP, "chrome", layer=5)
            shell.draw(
                rectangle_outline(end - share - 0.03, end - share + 0.2, sill + 0.55, sill + 0.6), WRAP, "rail", layer=7
            )
        for z in np.linspace(sill + 0.3, top - 0.3, 4):
            shell.draw(rectangle_outline(edge, edge + 0.1, z, z + 0.05), WRAP, "rail", layer=2)
    # Marker lamps, and the red and yellow plates of long and heavy lorries.
    draw_upper_markers(shell, space.half, top + 0.05, end)
    shell.draw(rectangle_outline(edge + 0.05, edge + 0.6, sill + 0.1, sill + 0.22), WRAP, TONES[6], layer=4)
    shell.draw(rectangle_outline(edge + 0.07, edge + 0.58, sill + 0.12, sill + 0.2), WRAP, TONES[0], layer=6)


def _mark(out: Cargo, shell: Surface, space: CargoSpace, end: float) -> None:
    corner, high = end - space.half, space.shape.height
    out.mark(
        shell.place((corner, high - 0.065), WRAP)[0],
        shell.place((corner + _INSET, high - 0.16), WRAP)[0],
        shell.place((corner, BOTTOM), ROWS)[0],
    )


def luton_body(space: CargoSpace) -> Cargo:
    """A box whose upper part reaches forward over the cab, with a shutter or doors."""
    rng, out = space.rng(), Cargo()
    shell, end = _shell(space, "livery")
    sill, top = space.floor + 0.12, space.shape.height - 0.16
    draw_graphics(shell, (space.end + 0.2, space.ahead - 0.15), (sill + 0.05, top), rng)
    for x in (space.ahead - 0.04, space.end + 0.04):
        shell.draw(rectangle_outline(x - 0.035, x + 0.035, sill, top + 0.04), SIDE, "rail", layer=3, facing=LEFT_AXIS)
    _rear(shell, space, end, shutter=rng.uniform() < 0.6)
    out.parts += [shell.half, peak(space, "livery")]
    _mark(out, shell, space, end)
    return out


def peak(space: CargoSpace, material: str) -> Mesh:
    """The part of the box that reaches over the cab, to over the windscreen."""
    low, high = space.cab_height + 0.07, space.shape.height - 0.065
    start, front = space.ahead - 0.02, space.ahead + 0.62 * space.shape.cab_length
    outline = [
        (front, low + 0.28),
        (front - 0.12, low),
        (start, low),
        (start, high),
        (front - 0.4, high),
        (front - 0.1, high - 0.3),
    ]
    return prism(outline, space.half - 0.006, material)
