"""Enclosures of plots: walls, picket fences, railings and hedges at the front, timber fences at the rear."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from shapely import LineString
from shapely.ops import unary_union

from skope.gen.mesh import Mesh
from skope.gen.scenery.houses import House, car_parks, covered, forecourts, garden_paths
from skope.gen.scenery.quads import Solid
from skope.gen.scenery.trees import bush, hedge
from skope.gen.towns.land_use import LAND_USE, Layout
from skope.gen.towns.regions import is_free, polygons, rectangle_polygon
from skope.gen.towns.road_graph import places_along, right_of
from skope.gen.towns.town_style import drawn_name


@dataclass(frozen=True)
class GardenLimits:
    """Shrubs and enclosed ground before cameras."""

    shrub_tries: int = 18
    """Number of attempts to place groups of shrubs on open ground before each camera."""
    open_ground_m: float = 46.0
    """Distance from a camera within which open ground is enclosed, metres."""


GARDEN_LIMITS: Final = GardenLimits()


def gardens(layout: Layout, houses: list[House], pits: Any, rng: np.random.Generator) -> Iterator[Mesh]:
    """Yield boundaries and bushes of all plots with a garden."""
    built = unary_union(
        [covered(houses), *garden_paths(houses), *car_parks(houses), forecourts(houses), layout.islands]
    )
    paved = [layout.sidewalk.buffer(layout.style.plaza + 0.05), layout.beside_lanes("shoulder").buffer(0.3)]
    street = unary_union([layout.graph.road.buffer(LAND_USE.kerb_m + 0.05), *paved])
    taken = unary_union([covered(houses).buffer(0.25), street])
    for part in _open_ground(layout, unary_union([built.buffer(0.6), street, pits]), rng):
        yield layout.draped(part)
    for part in _scattered_shrubs(layout, unary_union([built.buffer(0.8), street.buffer(0.9), pits]), rng):
        yield layout.draped(part)
    seen = unary_union([taken, layout.around_cameras])
    shapely.prepare(taken)
    shapely.prepare(seen)
    for house in houses:
        for part in _garden(layout, house, taken, seen, rng):
            yield layout.draped(part)


def _garden(layout: Layout, house: House, taken: Any, seen: Any, rng: np.random.Generator) -> Iterator[Mesh]:
    if house.terraced or house.setback == 0.0 or not house.kind.garden:
        return
    x, y = house.size[0] / 2, house.size[1] / 2
    front, kind = y + house.setback - 0.25, drawn_name(layout.style.fences, rng)
    for a, b in ((-x - 1.3, -0.95), (0.95, x + 0.15)):
        if _fits(taken, house, (a, front), (b, front)):
            middle = house.to_world(np.array([(a + b) / 2, front]))
            yield _boundary(kind, b - a, house.near, rng).moved([*middle, 0.0], house.heading)
    for side in (-x - 1.3, x + 3.0):
        low, high = -y - 11.0, -y + 2.0
        if house.kind.drive and _fits(seen, house, (side, low), (side, high)):
            middle = house.to_world(np.array([side, (low + high) / 2]))
            yield _panel_fence(high - low, house.near).mesh().moved([*middle, 0.0], house.heading + np.pi / 2)
    for at in rng.uniform(-0.85 * x, 0.85 * x, int(rng.integers(1, 4)) if house.near else 0):
        if abs(at) > 1.6:
            position = house.to_world(np.array([at, y + 1.6]))
            yield bush(rng.uniform(0.4, 0.62), rng).moved([*position, 0.0])


def _open_ground(layout: Layout, taken: Any, rng: np.random.Generator) -> Iterator[Mesh]:
    """Yield enclosures and shrubs at streets without houses; all lower than about 1 m."""
    shapely.prepare(taken)
    edges = [edge for edge in layout.graph.edges_of("ground") if not layout.graph.kind(edge).guard_rails]
    kinds = {edge.getID(): drawn_name(layout.style.fences, rng) for edge in edges}
    length = 5.6
    for edge, position, heading in places_along(edges, length + 0.15, 0.0):
        position = position + right_of(heading) * _enclosure_offset(layout, edge, 0.6)
        run = rectangle_polygon(position, heading, length, 0.5)
        if layout.camera_distance(position) < GARDEN_LIMITS.open_ground_m and not run.buffer(0.15).intersects(taken):
            near = layout.camera_distance(position) < 25.0
            yield _boundary(kinds[edge.getID()], length, near, rng).moved([*position, 0.0], heading)
    for edge, position, heading in places_along(edges, 2.6, 0.0):
        at = position + right_of(heading) * _enclosure_offset(layout, edge, 2.6) + rng.uniform(-1.2, 1.2, 2)
        likely = rng.random()
        if likely < 0.4 and layout.camera_distance(at) < GARDEN_LIMITS.open_ground_m and is_free(taken, at, 1.0):
            yield bush(rng.uniform(0.35, 0.6), rng).moved([*at, 0.0])


def _scattered_shrubs(layout: Layout, taken: Any, rng: np.random.Generator) -> Iterator[Mesh]:
    """Yield low shrubs and beds on open ground near cameras and in their view, and on islands."""
    shapely.prepare(taken)
    for site in layout.sites:
        for _ in range(GARDEN_LIMITS.shrub_tries):
            angle = np.radians(site.yaw_deg + rng.uniform(-60.0, 60.0))
            at = site.position[:2] + rng.uniform(9.0, GARDEN_LIMITS.open_ground_m) * np.array(
                [np.cos(angle), np.sin(angle)]
            )
            group = int(rng.integers(1, 7))
            places = at + rng.normal(0.0, 0.5 + 0.16 * group, (group, 2)) * [1.4, 1.0]
            for position, size in zip(places, rng.uniform(0.3, 0.62, group), strict=True):
                if is_free(taken, position, 0.4):
                    yield bush(float(size), rng).moved([*position, 0.0])
    for island in polygons(layout.islands.buffer(-1.3)):
        if layout.camera_distance(np.array(island.centroid.coords[0])) < 2 * GARDEN_LIMITS.open_ground_m:
            ring = island.exterior
            for s in np.arange(1.5, ring.length, 4.5):
                if rng.random() < layout.style.median_trees:
                    yield bush(float(rng.uniform(0.3, 0.5)), rng).moved([*ring.interpolate(s).coords[0], 0.0])


def _enclosure_offset(layout: Layout, edge: Any, beyond: float) -> float:
    """Return the distance from the kerb to the enclosure of the land beside a road, metres."""
    kind = layout.graph.kind(edge)
    sidewalk = kind.sidewalk + layout.style.plaza
    return LAND_USE.kerb_m + max(sidewalk, kind.shoulder + (2.4 if layout.style.kerb == 0 else 0.0)) + beyond


def _fits(taken: Any, house: House, a: tuple[float, float], b: tuple[float, float]) -> bool:
    return not taken.intersects(LineString(house.to_world(np.array([a, b]))))


def _boundary(kind: str, length: float, near: bool, rng: np.random.Generator) -> Mesh:
    """Return an enclosure of about 0.9 m height, along x around the origin; `kind` selects its type."""
    if kind == "hedge":
        return hedge(length, rng.uniform(0.75, 0.95), 0.55, rng)
    if kind == "pickets":
        return _picket_fence(length, near).mesh()
    if kind == "railing":
        return _railing(length, near).mesh()
    if kind == "wire":
        return _wire_fence(length).mesh()
    if kind == "rails":
        return _rail_fence(length).mesh()
    return _low_wall(length, kind).mesh()


def _wire_fence(length: float) -> Solid:
    """Return timber posts with wires, as around pastures."""
    half = length / 2
    out = Solid()
    for x in np.linspace(-half + 0.1, half, max(2, round(length / 2.8)), endpoint=False):
        out.box("timber", (x - 0.05, -0.05, -0.2), (x + 0.05, 0.05, 1.1), without="-z")
    for z in (0.4, 0.7, 1.0):
        out.box("zinc", (-half, -0.008, z), (half, 0.008, z + 0.016))
    return out


def _rail_fence(length: float) -> Solid:
    """Return posts with two boards, as around paddocks."""
    half = length / 2
    out = Solid()
    for x in np.linspace(-half + 0.1, half, max(2, round(length / 2.4)), endpoint=False):
        out.box("frame", (x - 0.07, -0.07, -0.2), (x + 0.07, 0.07, 1.05), without="-z")
    for z in (0.35, 0.75):
        out.box("frame", (-half, 0.05, z), (half, 0.09, z + 0.16))
    return out


def _low_wall(length: float, material: str) -> Solid:
    half = length / 2
    out = Solid()
    out.box(material, (-half, -0.12, 0.0), (half, 0.12, 0.62), without="-z +z")
    out.box("dressing", (-half - 0.03, -0.16, 0.62), (half + 0.03, 0.16, 0.7))
    for x in (-half + 0.2, half - 0.2):
        out.box(material, (x - 0.2, -0.2, 0.0), (x + 0.2, 0.2, 0.86), without="-z")
        out.box("dressing", (x - 0.24, -0.24, 0.86), (x + 0.24, 0.24, 0.94))
    return out


def _picket_fence(length: float, near: bool) -> Solid:
    half = length / 2
    out = Solid()
    for z in (0.25, 0.68):
        out.box("frame", (-half, -0.05, z), (half, -0.01, z + 0.07))
    if not near:
        out.box("frame", (-half, 0.0, 0.08), (half, 0.02, 0.88))
        return out
    for x in np.linspace(-half + 0.05, half - 0.05, max(3, int(length / 0.19))):
        out.box("frame", (x - 0.045, 0.0, 0.08), (x + 0.045, 0.02, 0.85), without="-z +z")
        out.face("frame", (x + 0.045, 0.02, 0.85), (x - 0.045, 0.02, 0.85), (x, 0.02, 0.92))
    return out


def _railing(length: float, near: bool) -> Solid:
    half = length / 2
    out = Solid()
    out.box("dressing", (-half, -0.1, 0.0), (half, 0.1, 0.22), without="-z")
    for z in (0.3, 0.9):
        out.box("iron", (-half, -0.015, z), (half, 0.015, z + 0.04))
    step = 0.2 if near else 0.8
    for x in np.linspace(-half + 0.05, half - 0.05, max(3, int(length / step))):
        out.box("iron", (x - 0.012, -0.012, 0.22), (x + 0.012, 0.012, 1.0), without="-z +z")
    return out


def _panel_fence(length: float, near: bool) -> Solid:
    half = length / 2
    out = Solid()
    out.box("timber", (-half, -0.02, 0.05), (half, 0.02, 1.7), without="-z")
    for x in np.linspace(-half, half, max(2, round(length / 2.6) + 1)) if near else ():
        out.box("concrete", (x - 0.05, -0.05, 0.0), (x + 0.05, 0.05, 1.78), without="-z")
    return out
