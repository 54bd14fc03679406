"""The ground as polygons in the plane, each part cut out of those below it: no two surfaces share a place."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Point, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, from_triangles, quads
from skope.gen.towns.layout import KERB_HEIGHT, KERB_WIDTH, SIDEWALK, Layout, beside, polygons, rectangle, right_of
from skope.gen.towns.markings import crossings, markings

Array = NDArray[np.float64]

MARGIN: Final = 320.0
"""How far the ground goes beyond the network, metres."""
GUTTER: Final = 0.32
_GRID: Final = 1e-4
"""Polygons' corners are rounded to that, so that parts cut out of each other keep common corners, metres."""


@dataclass(frozen=True)
class Part:
    """One material's share of the ground."""

    material: str
    region: Any
    height: float


@dataclass(frozen=True)
class Beside:
    """What is laid out beside the carriageway by those who build there."""

    forecourts: Any
    walks: Any
    drives: Any
    footings: Any
    """Bare soil at walls' feet."""
    pits: Any
    """Bare soil around trees in the sidewalk."""


def ground_parts(layout: Layout, beside_road: Beside, rng: np.random.Generator) -> list[Part]:
    """All of the ground; the carriageway is at z = 0, everything else a kerb's height above it."""
    road = shapely.set_precision(layout.road, _GRID)
    x0, y0, x1, y1 = road.bounds
    everywhere = shapely.box(x0 - MARGIN, y0 - MARGIN, x1 + MARGIN, y1 + MARGIN)
    patches, old, seals = _repairs(layout, rng)
    street = _cut(
        road,
        [
            ("cover", unary_union(list(_covers(layout, rng)))),
            ("marking", unary_union([*markings(layout.net), *crossings(layout.net, road)])),
            ("bitumen", seals),
            ("asphalt_patch", patches),
            ("asphalt_old", old),
            ("gutter", road.difference(road.buffer(-GUTTER))),
            ("asphalt_polished", _tracks(layout, 0.3)),
            ("asphalt_worn", _tracks(layout, 0.62)),
            ("asphalt", road),
        ],
        0.0,
    )
    kerb = road.buffer(KERB_WIDTH, join_style="mitre")
    sidewalk = road.buffer(KERB_WIDTH + SIDEWALK)
    beyond = _cut(
        everywhere.difference(road),
        [
            ("kerb", kerb),
            ("cover", unary_union(list(_sidewalk_covers(layout, rng))).intersection(sidewalk)),
            ("tactile", _tactile(layout, road).intersection(sidewalk)),
            ("soil", beside_road.pits.intersection(sidewalk)),
            ("sidewalk", sidewalk.union(beside_road.forecourts)),
            ("paving", beside_road.walks),
            ("gravel", beside_road.drives),
            ("soil", beside_road.footings),
            ("grass", everywhere),
        ],
        KERB_HEIGHT,
    )
    return [*street, *beyond]


def _cut(whole: Any, layers: Sequence[tuple[str, Any]], height: float) -> list[Part]:
    """Share a region out: each layer gets what the ones before it left."""
    out, left = [], shapely.set_precision(whole, _GRID)
    for material, region in layers:
        region = shapely.set_precision(region, _GRID)
        out.append(Part(material, shapely.intersection(left, region, grid_size=_GRID), height))
        left = shapely.difference(left, region, grid_size=_GRID)
    return out


def ground_meshes(layout: Layout, parts: Sequence[Part]) -> Iterator[Mesh]:
    for part in parts:
        for polygon in polygons(part.region):
            triangles = shapely.constrained_delaunay_triangles(polygon)
            oriented = [shapely.geometry.polygon.orient(t).exterior.coords for t in triangles.geoms]
            corners = np.array([np.array(ring)[:3] for ring in oriented])
            points = np.concatenate([corners, np.full((*corners.shape[:2], 1), part.height)], axis=-1).reshape(-1, 3)
            yield from_triangles(points, np.arange(len(points)), part.material)
    for ring in _rings(shapely.set_precision(layout.road, _GRID)):
        yield _wall(ring, 0.0, KERB_HEIGHT, "kerb")


def _rings(shape: Any) -> Iterator[Array]:
    """Rings (N, 2) of a region, with the region's inside on their right."""
    for polygon in polygons(shape):
        turned = shapely.geometry.polygon.orient(polygon, sign=-1.0)
        for ring in (turned.exterior, *turned.interiors):
            yield np.array(ring.coords)


def _wall(line: Array, low: float, high: float, material: str) -> Mesh:
    """A vertical strip along a line (N, 2), facing its right-hand side."""
    corners = [
        [(*a, low), (*b, low), (*b, high), (*a, high)] for a, b in itertools.pairwise(line) if np.hypot(*(b - a)) > 1e-6
    ]
    return quads(np.array(corners), material)


# --------------------------------------------------------------------------------------------------- wear and repairs


def _tracks(layout: Layout, width: float) -> Any:
    """Where wheels run: two strips along each lane."""
    strips = []
    for edge in layout.edges:
        for lane in edge.getLanes():
            line = LineString(lane.getShape())
            strips += [line.offset_curve(side).buffer(width / 2, cap_style="flat") for side in (-0.82, 0.82)]
    return unary_union(strips)


def _repairs(layout: Layout, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Dark new patches, pale old ones, and bitumen: their sealed edges and sealed cracks."""
    new, old, cracks = [], [], []
    for edge in layout.edges:
        lanes = edge.getLanes()
        half = sum(lane.getWidth() for lane in lanes) / 2
        for s in np.arange(rng.uniform(4.0, 14.0), lanes[0].getLength() - 6.0, 15.0):
            s += rng.uniform(-4.0, 4.0)
            kind, across = rng.random(), rng.uniform(-0.8, 0.8) * half
            middle, heading = beside(edge, s, -half)
            at = middle + right_of(heading) * across
            shape = rectangle(at, heading, rng.uniform(1.2, 3.5), rng.uniform(0.8, 1.8))
            if kind < 0.22:
                new.append(shape)
            elif kind < 0.40:
                old.append(shape)
            elif kind < 0.52:  # a trench across the lanes
                new.append(rectangle(middle, heading, rng.uniform(0.6, 0.9), 2 * half))
            elif kind < 0.60:  # a trench along them
                old.append(rectangle(at, heading, rng.uniform(8.0, 16.0), 0.7))
            else:
                cracks.append(_crack(at, heading + rng.choice([0.0, 0.0, np.pi / 2]), rng))
    for node in layout.net.getNodes():
        if len(node.getShape()) > 3 and (area := Polygon(node.getShape()).buffer(-3.0)).area > 40:
            for kept in (new, old):
                at, heading = _within(area, rng), rng.uniform(0, np.pi)
                kept.append(rectangle(at, heading, rng.uniform(1.2, 2.6), 1.1))
            cracks += [_crack(_within(area, rng), rng.uniform(0, np.pi), rng) for _ in range(3)]
    seams = [shape.boundary.buffer(0.035, cap_style="flat") for shape in (*new, *old)]
    return unary_union(new), unary_union(old), unary_union([*seams, *cracks])


def _within(region: Polygon, rng: np.random.Generator) -> Array:
    """A random place (2,) inside a region."""
    x0, y0, x1, y1 = region.bounds
    while True:
        place = rng.uniform((x0, y0), (x1, y1))
        if region.contains(Point(place)):
            return np.asarray(place)


def _crack(at: Array, heading: float, rng: np.random.Generator) -> Polygon:
    """A wandering sealed crack of a few metres."""
    steps = int(rng.integers(6, 16))
    turn = heading + rng.normal(0.0, 0.45, steps)
    line = at + 0.45 * np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)
    return LineString(line).buffer(rng.uniform(0.015, 0.03), quad_segs=1, join_style="mitre")


def _covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    """Manhole covers in the lanes and drain grates in the gutters."""
    for edge in layout.edges:
        lanes = edge.getLanes()
        length = lanes[0].getLength()
        for s in np.arange(rng.uniform(5.0, 20.0), length - 4.0, 27.0):
            at = LineString(lanes[rng.integers(len(lanes))].getShape()).interpolate(s + rng.uniform(-6.0, 6.0))
            yield Point(at.x + rng.uniform(-0.3, 0.3), at.y + rng.uniform(-0.3, 0.3)).buffer(0.33, quad_segs=5)
        for s in np.arange(9.0, length - 4.0, 24.0):
            at, heading = beside(edge, s, -0.19)
            yield rectangle(at, heading, 0.5, 0.3)


def _sidewalk_covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    for edge in layout.edges:
        for s in np.arange(rng.uniform(3.0, 12.0), edge.getLanes()[0].getLength(), 13.0):
            at, heading = beside(edge, s + rng.uniform(-3.0, 3.0), rng.uniform(1.0, 1.9))
            yield rectangle(at, heading, rng.choice([0.45, 0.6, 0.9]), 0.45)


def _tactile(layout: Layout, road: Any) -> Any:
    """Ribbed paving on the sidewalk at both ends of crossings."""
    stripes = unary_union(list(crossings(layout.net, road)))
    spans = polygons(stripes.buffer(0.6, join_style="mitre"))
    ends = unary_union([span.minimum_rotated_rectangle.buffer(0.8, join_style="mitre") for span in spans])
    return ends.intersection(road.buffer(KERB_WIDTH + 0.8))
