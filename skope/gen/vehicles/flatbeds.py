"""Platforms with a wall behind the cab and low or no sides, their loads, and their loading crane."""

from collections.abc import Callable
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box, merged
from skope.gen.vehicles.lofted_surfaces import SIDE_AXES, TOP_AXES, WRAP_AXES, Plan
from skope.gen.vehicles.lorry_parts import Cargo, CargoSpace
from skope.gen.vehicles.panels import MARKER_MATERIAL, PANEL_LIMITS, draw_on_left, rectangle_outline
from skope.gen.vehicles.parts import block
from skope.gen.vehicles.solids import Tower, barrel, beam, pipe, prism

WOOD_COLORS: Final = ("#b98d55", "#a87c48", "#c79f69")
DECK_COLOR: Final = "#7d6a4e"
STRAP_COLOR: Final = "#d9641e"


def flatbed_body(space: CargoSpace) -> Cargo:
    """Return a platform with a load, with or without low sides. Both are random, seeded by the vehicle's length."""
    rng = space.rng()
    kinds = list(PLATFORM_LOADS)
    weights = np.array([PLATFORM_LOADS[kind][0] for kind in kinds])
    kind = kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]
    return _platform(space, rng, kind, sides=bool(rng.uniform() < 0.45))


def crane_body(space: CargoSpace) -> Cargo:
    """Return a platform with sides, and a folded loading crane between it and the cab."""
    rng = space.rng()
    out = _platform(space, rng, ("bricks", "timber", "pipes", "")[int(rng.integers(4))], sides=True, ahead=0.95)
    x, z, top = space.ahead - 0.45, space.floor, space.shape.height
    tone = ("#e3bd1c", "#c8342b", "#e07b18", "#d9dad8")[int(rng.integers(4))]
    add = out.parts.append
    add(box((x - 0.35, 0.0, z - 0.35), (x + 0.35, space.half - 0.06, z + 0.12), "trim"))
    add(box((x - 0.2, space.half - 0.3, 0.5), (x + 0.2, space.half - 0.1, z - 0.3), "trim"))
    add(box((x - 0.22, 0.0, z + 0.1), (x + 0.22, 0.24, z + 0.75), tone))
    add(box((x - 0.16, 0.0, z + 0.7), (x + 0.1, 0.16, top), tone))
    # Booms, folded across the vehicle; half of each here.
    add(box((x - 0.2, 0.0, top - 0.3), (x + 0.14, space.half - 0.14, top - 0.06), tone))
    add(box((x - 0.34, 0.0, top - 0.62), (x - 0.14, space.half - 0.3, top - 0.42), tone))
    add(pipe((x + 0.16, 0.0, top - 0.45), (x + 0.16, space.half - 0.35, top - 0.42), 0.06, "chrome"))
    add(block((x - 0.3, space.half - 0.5, top - 0.95), (x - 0.08, space.half - 0.28, top - 0.4), "trim", 0.04))
    return out


def dropside_body(space: CargoSpace) -> Cargo:
    """Return a platform with low sides, as on light vehicles."""
    rng = space.rng()
    return _platform(space, rng, ("", "", "bricks", "timber", "tarpaulin")[int(rng.integers(5))], sides=True)


def _platform(space: CargoSpace, rng: np.random.Generator, load: str, *, sides: bool, ahead: float = 0.0) -> Cargo:
    out = Cargo()
    low, front = space.floor, space.ahead - ahead
    heavy = space.half > 1.15
    high = low + (0.4 if heavy else 0.36) if sides else low + 0.16
    deck = low + 0.12
    tower = Tower(
        Plan(space.half, front, space.end, 0.0, 0.0, 0.05, 0.035), low, high, edge=0.02, crown=0.0,
        hollow=deck if sides else None, stations=3, levels=2,
    )  # fmt: skip
    shell, w, _ = tower.surface("livery" if sides else "rail")
    end = float(w[-1])
    shell.draw(rectangle_outline(-1, 99, 0, low + 0.09), WRAP_AXES, "trim")
    if sides:
        for x in np.linspace(front - 0.05, space.end + 0.05, 4 if heavy else 3):
            draw_on_left(shell, (x - 0.04, x + 0.04, low + 0.05, high), "rail", layer=2)
        for z in np.arange(low + 0.16, high - 0.03, 0.08).tolist():
            shell.line([(space.end + 0.1, z), (front - 0.1, z)], SIDE_AXES, width=0.012, facing=PANEL_LIMITS.left_axis)
        shell.paint([(-99, -9), (99, -9), (99, 9), (-99, 9)], TOP_AXES, "bed", levels=(2.1, 3.0))
    else:
        shell.paint([(-99, -9), (99, -9), (99, 9), (-99, 9)], TOP_AXES, DECK_COLOR, levels=(2.0, 3.0))
        for x in np.arange(space.end + 0.6, front - 0.3, 1.2).tolist():
            shell.draw(
                rectangle_outline(x - 0.03, x + 0.03, low + 0.1, low + 0.13), SIDE_AXES, MARKER_MATERIAL, layer=2
            )
    out.parts.append(shell.half)
    wall = min(deck + (1.45 if heavy else 0.85), space.shape.height - 0.25)
    out.parts += _headboard(front, space.half, deck - 0.03, wall)
    if load:
        room = (space.end + 0.35, front - 0.3), space.half - 0.12, deck, wall - 0.05
        out.parts += PLATFORM_LOADS[load][1](*room, rng)
    corner = end - space.half
    top = high - 0.02
    out.mark(
        shell.place((corner, top), WRAP_AXES)[0],
        shell.place((corner + 0.11, top - 0.06), WRAP_AXES)[0],
        shell.place((corner, low + 0.002), WRAP_AXES)[0],
    )
    return out


def _headboard(front: float, half: float, low: float, high: float) -> list[Mesh]:
    posts = [box((front - 0.1, y - 0.05, low), (front - 0.02, y + 0.05, high), "rail") for y in (0.4, half - 0.07)]
    slats = [
        box((front - 0.085, 0.0, z), (front - 0.035, half - 0.03, z + 0.13), "rail")
        for z in np.linspace(low + 0.05, high - 0.14, 5).tolist()
    ]
    return [*posts, *slats]


def _timber(along: tuple[float, float], half: float, low: float, high: float, rng: np.random.Generator) -> list[Mesh]:
    """Return strapped packs of boards on battens."""
    out, z = [], low
    start, end = along[0] + rng.uniform(0, 0.3), along[1] - rng.uniform(0, 0.8)
    while z + 0.5 < high:
        tall, wide = float(rng.uniform(0.35, 0.5)), half - float(rng.uniform(0.0, 0.15))
        battens = [((x - 0.05, 0.0, z), (x + 0.05, wide, z + 0.08)) for x in (start + 0.4, end - 0.4)]
        out += [box(*corners, WOOD_COLORS[1]) for corners in battens]
        rows = 4
        for k in range(rows):
            base = z + 0.08 + k * (tall - 0.08) / rows
            out.append(
                box((start, 0.0, base), (end, wide - 0.015 * (k % 2), base + (tall - 0.08) / rows), WOOD_COLORS[k % 3])
            )
        z += tall
        if rng.uniform() < 0.45:
            break
    return [*out, *_straps((start + 0.5, end - 0.5), half + 0.01, low, z)]


def _straps(along: tuple[float, float], half: float, low: float, high: float) -> list[Mesh]:
    return [
        merged(
            [
                box((x, half - 0.02, low), (x + 0.05, half + 0.005, high + 0.012), STRAP_COLOR),
                box((x, 0.0, high - 0.005), (x + 0.05, half, high + 0.012), STRAP_COLOR),
            ]
        )
        for x in np.linspace(*along, 3).tolist()
    ]


def _bricks(along: tuple[float, float], half: float, low: float, high: float, rng: np.random.Generator) -> list[Mesh]:
    """Return pallets of blocks, in rows."""
    out = []
    tone = ("#a2563c", "#9a9a96", "#c7b08a", "#8d4a36")[int(rng.integers(4))]
    for x in np.arange(along[0], along[1] - 1.1, 1.22).tolist():
        if rng.uniform() < 0.15:
            continue
        tall = min(float(rng.choice([0.75, 0.95, 1.1])), high - low - 0.15)
        out.append(box((x, 0.06, low), (x + 1.1, half - 0.02, low + 0.13), WOOD_COLORS[0]))
        rows = max(3, round(tall / 0.2))
        for k in range(rows):
            z = low + 0.13 + k * tall / rows
            inset = 0.012 * (k % 2)
            out.append(box((x + inset, 0.05 + inset, z), (x + 1.1 - inset, half - inset, z + tall / rows), tone))
    return out


def _pipes(along: tuple[float, float], half: float, low: float, high: float, rng: np.random.Generator) -> list[Mesh]:
    """Return pipes or logs, stacked between posts."""
    logs = rng.uniform() < 0.5
    radius = float(rng.uniform(0.12, 0.24))
    tone, face = (
        ("#6b4e37", "#c9a26b")
        if logs
        else (("#d9d3c0", "#555555"), ("#8d9297", "#333333"), ("#2b5aa0", "#222222"))[int(rng.integers(3))]
    )
    out, layers = [], int(rng.integers(2, 4))
    for layer in range(layers):
        z = low + radius + layer * 1.75 * radius
        if z + radius > high:
            break
        shift = radius * (layer % 2)
        for y in np.arange(shift + (radius if not layer % 2 else 0.0), half - 0.1 - radius + 1e-6, 2 * radius).tolist():
            wobble = float(rng.uniform(-0.06, 0.06)) if logs else 0.0
            a, b = (along[0] + 0.15 + wobble, y, z), (along[1] - 0.2 + wobble, y, z)
            out += [
                pipe(a, b, radius * 0.98, tone),
                pipe((a[0] - 0.006, y, z), (a[0] + 0.05, y, z), radius * 0.72, face),
            ]
    for x in np.linspace(along[0] + 0.6, along[1] - 0.6, 3).tolist():
        out.append(
            box(
                (x - 0.05, half - 0.06, low - 0.04),
                (x + 0.05, half + 0.03, min(low + 0.2 + 2 * radius * layers, high)),
                "rail",
            )
        )
    return out


def _machine(along: tuple[float, float], half: float, low: float, high: float, rng: np.random.Generator) -> list[Mesh]:
    """Return a small digger on tracks with its arm folded towards the rear."""
    tone = ("#e2a21c", "#d9641e", "#e8e4d8", "#3d7a46")[int(rng.integers(4))]
    x, wide = along[1] - 1.6, min(half - 0.1, 0.85)
    track = [(x - 0.85, 0.0, 0.0), (x - 0.6, 0.0, 0.36), (x + 0.6, 0.0, 0.36), (x + 0.85, 0.0, 0.0)]
    outline = [(a, low + 0.04 + b) for a, _, b in track] + [(x + 0.7, low), (x - 0.7, low)]
    top = min(high - low, 1.75)
    cab = [(x - 0.1, low + 0.75), (x + 0.75, low + 0.75), (x + 0.6, low + top), (x, low + top)]
    reach = max(along[0] + 0.3, x - 2.6)
    return [
        prism(outline, wide, "under", inner=wide - 0.3),
        box((x - 0.6, 0.0, low + 0.2), (x + 0.6, wide - 0.3, low + 0.4), "trim"),
        prism(
            [(x - 0.8, low + 0.4), (x - 0.85, low + 0.85), (x + 0.8, low + 0.85), (x + 0.8, low + 0.4)],
            wide - 0.05,
            tone,
        ),
        prism(cab, 0.5, "glass"),
        box((x - 0.02, 0.0, low + top - 0.02), (x + 0.62, 0.53, low + top + 0.05), tone),
        beam((x - 0.7, 0.0, low + 0.7), (x - 1.4, 0.0, low + top - 0.3), 0.12, 0.1, tone),
        beam((x - 1.35, 0.0, low + top - 0.25), (reach, 0.0, low + 0.45), 0.1, 0.08, tone),
        prism(
            [(reach - 0.25, low + 0.5), (reach + 0.3, low + 0.5), (reach + 0.2, low + 0.03), (reach - 0.1, low + 0.03)],
            0.35,
            "trim",
        ),
    ]


def _tarpaulin(
    along: tuple[float, float], half: float, low: float, high: float, rng: np.random.Generator
) -> list[Mesh]:
    """Return a load under a lashed tarpaulin."""
    tone = ("tarpaulin", "#2f6b43", "#5f6468", "#b8b4a4")[int(rng.integers(4))]
    xs = np.linspace(along[0] + 0.05, along[1] - 0.1, 8)
    tall = 0.5 * (high - low) * rng.uniform(0.75, 1.0, len(xs))
    tall[[0, -1]] *= 0.7
    sections = [(xs[0] - 0.05, low + tall[0], 0.0, 0.0)]
    sections += [(x, low + t, half - 0.04, t) for x, t in zip(xs, tall, strict=True)]
    sections.append((xs[-1] + 0.05, low + tall[-1], 0.0, 0.0))
    return [barrel(sections, tone, square=5.0)]


PLATFORM_LOADS: Final[dict[str, tuple[float, Callable[..., list[Mesh]]]]] = {
    "": (0.25, lambda *_: []),
    "timber": (0.2, _timber),
    "bricks": (0.2, _bricks),
    "pipes": (0.2, _pipes),
    "machine": (0.12, _machine),
    "tarpaulin": (0.12, _tarpaulin),
}
"""Share of platforms with each load, and its builder. Its arguments are x from and to, half the width, and the
height from and to."""
