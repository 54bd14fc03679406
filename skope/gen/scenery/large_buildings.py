"""Large buildings around the origin with their fronts towards +y: office towers, halls, barns, silos."""

from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, lathe, merged
from skope.gen.scenery import roof
from skope.gen.scenery.quads import Solid
from skope.gen.towns.town_style import BuildingKind

_WALL_AXES: Final = (
    ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
)
"""Axes of front, back, right and left wall: x along the wall, y up, z outwards."""
SIGN_MATERIALS: Final = ("fascia_red", "fascia_blue", "fascia_green", "sign_yellow", "fascia_black")


def _wall_origins(half: tuple[float, float]) -> tuple[tuple[tuple[float, float, float], float], ...]:
    """Return origin and width of the four walls of a rectangle, in the order of `_WALL_AXES`."""
    x, y = half
    return ((x, y, 0.0), 2 * x), ((-x, -y, 0.0), 2 * x), ((x, -y, 0.0), 2 * y), ((-x, y, 0.0), 2 * y)


def tower(kind: BuildingKind, half: tuple[float, float], detail: int, rng: np.random.Generator) -> Solid:
    """Return storeys of glass between floors and piers, above a glazed ground floor; plant on the roof."""
    storeys, wall = int(rng.integers(kind.storeys[0], kind.storeys[1] + 1)), str(rng.choice(kind.walls))
    style = rng.choice(["bands", "piers", "grid"])
    top = kind.ground + kind.storey * storeys
    out = Solid()
    for (origin, width), axes in zip(_wall_origins(half), _WALL_AXES, strict=True):
        out.add(_office_front(kind, wall, str(style), width, storeys, detail).placed(origin, axes))
    x, y = half
    out.pane("felt", (-x, x), (-y, y), top)
    for low, high in (
        ((-x, y - 0.3), (x, y)),
        ((-x, -y), (x, -y + 0.3)),
        ((-x, -y + 0.3), (-x + 0.3, y - 0.3)),
        ((x - 0.3, -y + 0.3), (x, y - 0.3)),
    ):
        out.box(wall, (*low, top), (*high, top + 1.0), without="-z")
    out.box("cladding_grey", (-0.5 * x, -0.5 * y, top), (0.3 * x, 0.4 * y, top + 3.2), without="-z")
    for k in range(3):
        out.box(
            "zinc", (0.45 * x, (0.25 * k - 0.5) * y, top), (0.7 * x, (0.25 * k - 0.35) * y, top + 1.4), without="-z"
        )
    return out


def _office_front(kind: BuildingKind, wall: str, style: str, width: float, storeys: int, detail: int) -> Solid:
    out = Solid()
    if detail == 0:
        out.pane(wall, (0.0, width), (0.0, kind.ground + kind.storey * storeys), 0.0)
        out.pane("shop_window", (0.6, width - 0.6), (0.5, kind.ground - 1.0), 0.1)
        for storey in range(storeys):
            low = kind.ground + kind.storey * storey
            out.pane("window", (0.6, width - 0.6), (low + 0.8, low + kind.storey - 0.35), 0.1)
        for x in np.linspace(0.6, width - 1.2, max(2, round(width / (3.0 if style == "grid" else 6.0))))[1:-1]:
            out.pane(wall, (x, x + 0.6), (0.0, kind.ground + kind.storey * storeys), 0.2)
        return out
    sill, lintel = (0.15, 0.4) if style == "piers" else (0.95, 0.35)
    bay = 3.0 if style == "grid" else 1.5 if style == "piers" else 6.0
    out.pane("shop_window", (0.0, width), (0.5, kind.ground - 1.0), 0.0)
    out.pane(wall, (0.0, width), (0.0, 0.5), 0.0)
    out.box(wall, (0.0, kind.ground - 1.0, 0.0), (width, kind.ground, 0.25), without="-z")
    for storey in range(storeys):
        low = kind.ground + kind.storey * storey
        out.box(wall, (0.0, low, 0.0), (width, low + sill, 0.12), without="-z -x +x")
        out.pane("window", (0.0, width), (low + sill, low + kind.storey - lintel), 0.0)
        out.box(wall, (0.0, low + kind.storey - lintel, 0.0), (width, low + kind.storey, 0.12), without="-z -x +x")
    count = max(2, round(width / bay))
    pier = 0.7 if style == "grid" else 0.22
    for x in np.linspace(pier / 2, width - pier / 2, count + 1):
        out.box(
            wall, (x - pier / 2, 0.0, 0.0), (x + pier / 2, kind.ground + kind.storey * storeys, 0.3), without="-z -y"
        )
    if detail == 2:
        for x in np.linspace(0.0, width, max(2, round(width / 1.5)) + 1)[1:-1]:
            out.box(
                "frame_dark",
                (x - 0.03, 0.5, 0.0),
                (x + 0.03, kind.ground + kind.storey * storeys, 0.06),
                without="-z -y",
            )
        for x in np.arange(2.0, width - 3.0, 9.0):
            out.box("frame_dark", (x, kind.ground - 1.3, 0.0), (x + 2.6, kind.ground - 1.15, 1.4), without="-z")
    return out


def hall(kind: BuildingKind, half: tuple[float, float], near: bool, rng: np.random.Generator) -> Solid:
    """Return a sheet-metal hall on a plinth.

    A shop has a glazed entrance with its sign, a warehouse has gates and high windows.
    """
    wall, (x, y), top = str(rng.choice(kind.walls)), half, kind.ground
    out = Solid()
    for i, ((origin, width), axes) in enumerate(zip(_wall_origins(half), _WALL_AXES, strict=True)):
        part = Solid()
        part.pane(wall, (0.0, width), (0.0, top), 0.0)
        part.box("concrete", (0.0, 0.0, 0.0), (width, 0.7, 0.06), without="-z -y")
        part.box("frame_dark" if kind.shop else "dressing", (0.0, top - 0.35, 0.0), (width, top, 0.08), without="-z")
        if kind.shop and i == 0:
            part.add(_entrance(width, top, rng))
        elif not kind.shop and i in (0, 2):
            part.pane("window", (1.5, width - 1.5), (top - 2.0, top - 1.0), 0.04)
            for at in np.arange(4.0, width - 6.0, 7.5):
                part.box("frame_dark", (at - 0.15, 0.7, 0.0), (at + 4.15, 4.75, 0.1), without="-z")
                part.pane("cladding_white", (at, at + 4.0), (0.7, 4.6), 0.11)
                part.box("iron", (at - 0.1, 0.4, 0.0), (at + 4.1, 0.7, 0.3), without="-z")
        elif near:
            part.box("door_blue", (3.0, 0.1, 0.0), (4.1, 2.2, 0.05), without="-z")
        out.add(part.placed(origin, axes))
    out.pane("felt", (-x, x), (-y, y), top)
    out.box(wall, (-x, y - 0.3, top), (x, y, top + 0.6), without="-z")
    for at in rng.uniform(-0.8, 0.7, (5, 2)) * [x, 0.8 * y]:
        out.box("zinc", (*at, top), (at[0] + 2.2, at[1] + 1.6, top + 1.3), without="-z")
    return out


def _entrance(width: float, top: float, rng: np.random.Generator) -> Solid:
    out = Solid()
    middle, half = width * rng.uniform(0.35, 0.65), 7.0
    color = str(rng.choice(SIGN_MATERIALS))
    out.box(color, (middle - half - 1.0, 0.0, 0.0), (middle + half + 1.0, top + 1.6, 0.7), without="-z")
    out.pane("shop_window", (middle - half, middle + half), (0.2, 3.6), 0.72)
    for x in np.linspace(middle - half, middle + half, 8):
        out.box("frame_dark", (x - 0.05, 0.2, 0.7), (x + 0.05, 3.6, 0.78), without="-z")
    out.box("frame_dark", (middle - half - 0.4, 3.6, 0.7), (middle + half + 0.4, 3.9, 2.6), without="-z")
    letters = int(rng.integers(5, 9))
    for k in range(letters):
        x = middle + (k - letters / 2) * 1.35
        out.pane("lettering", (x, x + 0.28), (top - 1.3, top + 0.5), 0.73)
        if rng.random() < 0.8:
            out.pane("lettering", (x + 0.28, x + 1.0), (top + 0.25, top + 0.5), 0.73)
        if rng.random() < 0.7:
            out.pane("lettering", (x + 0.28, x + 0.9), (top - 0.5, top - 0.25), 0.73)
        if rng.random() < 0.6:
            out.pane("lettering", (x + 0.28, x + 1.0), (top - 1.3, top - 1.05), 0.73)
    for low, high in ((1.0, middle - half - 2.0), (middle + half + 2.0, width - 1.0)):
        if high - low > 4.0:
            out.pane("shop_window", (low, high), (0.9, 2.9), 0.05)
            out.box("frame_dark", (low, 2.9, 0.0), (high, 3.1, 0.25), without="-z")
    return out


def barn(kind: BuildingKind, half: tuple[float, float], rng: np.random.Generator) -> Solid:
    """Return boards under a steep roof, with a gate in the gable and in the long side."""
    wall, covering = str(rng.choice(kind.walls)), str(rng.choice(kind.roofs))
    eaves = kind.ground * rng.uniform(0.85, 1.1)
    out = roof.gabled(half, eaves, rng.uniform(0.62, 0.9) * half[1], 0.4, covering, wall)
    for i, ((origin, width), axes) in enumerate(zip(_wall_origins(half), _WALL_AXES, strict=True)):
        part = Solid()
        part.pane(wall, (0.0, width), (0.0, eaves), 0.0)
        part.box("stone", (0.0, -0.4, 0.0), (width, 0.5, 0.08), without="-z -y")
        gate, high = (width / 2, 0.8 * eaves) if i != 1 else (width / 3, 0.7 * eaves)
        part.box(
            "frame" if wall == "cladding_red" else "timber",
            (gate - 2.1, 0.0, 0.0),
            (gate + 2.1, high, 0.1),
            without="-z -y",
        )
        part.pane("timber" if wall != "timber" else "shutter_brown", (gate - 1.9, gate + 1.9), (0.1, high - 0.2), 0.11)
        for at in np.arange(2.0, width - 1.5, 4.2):
            if abs(at - gate) > 2.8:
                part.box("frame", (at - 0.5, 2.0, 0.0), (at + 0.5, 3.0, 0.05), without="-z")
                part.pane("window", (at - 0.42, at + 0.42), (2.08, 2.92), 0.06)
        out.add(part.placed(origin, axes))
    return out


def silo(kind: BuildingKind, radius: float, near: bool, rng: np.random.Generator) -> Mesh:
    """Return a round tower with a dome and hoops."""
    wall, high = str(rng.choice(kind.walls)), kind.ground * rng.uniform(0.8, 1.15)
    profile = [(-0.4, radius), (high, radius), (high + 0.5 * radius, 0.75 * radius), (high + 0.75 * radius, 0.0)]
    parts = [lathe(profile, [wall, "zinc", "zinc"], 18, "z")]
    for z in np.arange(1.0, high, 1.3) if near else ():
        hoop = [(z, radius), (z, radius + 0.04), (z + 0.1, radius + 0.04), (z + 0.1, radius)]
        parts.append(lathe(hoop, ["zinc"] * 3, 18, "z"))
    ladder = Solid()
    ladder.box("iron", (-0.25, radius + 0.02, 0.5), (-0.2, radius + 0.3, high), without="-z")
    ladder.box("iron", (0.2, radius + 0.02, 0.5), (0.25, radius + 0.3, high), without="-z")
    return merged([*parts, ladder.mesh()])
