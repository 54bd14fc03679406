"""Kerbs, retaining walls and parapets along lines in space."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, quads
from skope.gen.towns.land_use import Layout
from skope.gen.towns.regions import GRID, polygons
from skope.types import Array

WALL: Final = 0.4
"""Height from which a step between carriageway and ground is a retaining wall, metres."""
_KERB_PIECE_M: Final = 2.0
"""Length of the pieces that kerbs on slopes are made of, metres."""


def kerbs(layout: Layout) -> Iterator[Mesh]:
    """Kerbs and retaining walls between the carriageway and the ground beside it, with parapets on high ones."""
    ground = layout.ground
    decks = unary_union([deck.buffer(layout.deck_edge, join_style="mitre") for deck in layout.graph.decks])
    for ring in rings(shapely.set_precision(layout.graph.ground_road, GRID)):
        line = ring if ground.flat else np.array(shapely.segmentize(LineString(ring), _KERB_PIECE_M).coords)
        low, high = ground.road(line), ground.beside(line) + layout.style.kerb
        under = shapely.intersects(decks, shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1)))
        for chosen, material in ((high - low <= WALL, "kerb"), (high - low > WALL, "concrete")):
            strip = chosen[:-1] if material == "kerb" else ~(high - low <= WALL)[:-1]
            if not strip.any() or (material == "kerb" and (high - low)[chosen].max() < 1e-6):
                continue
            top = high.copy()
            if material == "concrete":
                covered = np.zeros(len(line), dtype=bool)
                covered[:-1] |= under
                covered[1:] |= under
                top[covered] -= 0.5
            yield _strip(line, low, top, strip, material)
            if material == "concrete":
                yield from _parapets_along(line, high, strip & ~under)


def _strip(line: Array, low: Array, high: Array, chosen: NDArray[np.bool_], material: str) -> Mesh:
    """Vertical quadrilaterals along a line (N, 2), between two heights at each point, facing its right-hand side."""
    start, end = np.column_stack([line[:-1], low[:-1]]), np.column_stack([line[1:], low[1:]])
    over_end, over_start = np.column_stack([line[1:], high[1:]]), np.column_stack([line[:-1], high[:-1]])
    corners = np.stack([start, end, over_end, over_start], axis=1)
    proper = chosen & (np.hypot(*(line[1:] - line[:-1]).T) > 1e-6)
    return quads(corners[proper], material)


def _parapets_along(line: Array, base: Array, chosen: NDArray[np.bool_]) -> Iterator[Mesh]:
    """A low wall behind a line's left-hand side, with a rail on it."""
    for first, last in runs_of_true(chosen):
        path, z = LineString(line[first : last + 1]), base[first : last + 1]
        if path.length < 1.0:
            continue
        yield from parapet(np.array(path.coords), z, 0.3)


def parapet(line: Array, base: Array, thickness: float) -> Iterator[Mesh]:
    """A wall of 0.8 m from a line (N, 2) to its left, at heights (N,), with a steel rail on top."""
    back = np.array(LineString(line).offset_curve(thickness, join_style="mitre").coords)
    if len(back) != len(line):  # a bend so sharp that its inner side lost a corner
        back = line + thickness * left_of(line)
    for a, b, material, top, bottom in ((line, back, "concrete", 0.8, -0.05),):
        high, low = base + top, base + bottom
        yield _strip(a, low, high, np.ones(len(a) - 1, bool), material)
        yield _strip(b[::-1], low[::-1], high[::-1], np.ones(len(a) - 1, bool), material)
        lid = np.stack(
            [
                np.column_stack([a[:-1], high[:-1]]),
                np.column_stack([a[1:], high[1:]]),
                np.column_stack([b[1:], high[1:]]),
                np.column_stack([b[:-1], high[:-1]]),
            ],
            axis=1,
        )
        yield quads(lid, "dressing")
        for end, step in ((0, 1), (-1, -1)):
            pair = np.array([b[end], a[end]])[::step]
            yield _strip(pair, np.full(2, low[end]), np.full(2, high[end]), np.ones(1, bool), material)
    middle = (line + back) / 2
    for side in (1.0, -1.0):
        rail = middle + 0.03 * side * left_of(middle)
        path = rail if side < 0 else rail[::-1]
        z = (base if side < 0 else base[::-1]) + 1.0
        yield _strip(path, z, z + 0.07, np.ones(len(path) - 1, bool), "zinc")


def left_of(line: Array) -> Array:
    """(N, 2) unit vectors to the left of a line at its points."""
    forward = np.gradient(line, axis=0)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    return np.stack([-forward[:, 1], forward[:, 0]], axis=1)


def runs_of_true(chosen: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and one past the last index of each run of True."""
    edges = np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]]))
    yield from zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True)


def rings(shape: Any) -> Iterator[Array]:
    """Rings (N, 2) of a region, with the region's inside on their right."""
    for polygon in polygons(shape):
        turned = shapely.geometry.polygon.orient(polygon, sign=-1.0)
        for ring in (turned.exterior, *turned.interiors):
            yield np.array(ring.coords)
