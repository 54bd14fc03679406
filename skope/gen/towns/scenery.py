"""Scenery grown from a SUMO network, the same for the same network: roads, markings, sidewalks, houses, trees, signals.

The ground is worked out as polygons in the plane, each part cut out of the one below it, so that no two surfaces
share a place and fight for it.
"""

import itertools
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
import shapely
import sumolib
from numpy.typing import NDArray
from shapely import LineString, MultiPolygon, Point, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, box, flat, from_triangles, grid, lathe, merged
from skope.gen.towns import network, sites

Array = NDArray[np.float64]

MARGIN: Final = 320.0
"""How far the ground goes beyond the network, metres."""
KERB_HEIGHT: Final = 0.12
SIDEWALK: Final = 2.4
SETBACK: Final = (3.0, 7.0)
"""Range of the distance from sidewalk to house front."""


@dataclass(frozen=True, eq=False)
class Signal:
    """A traffic light's head; it shows the state of one link of a junction's program."""

    program: str
    link: int
    lamps: Array
    """(3, 3) world positions of red, yellow and green lamp."""
    facing: Array
    """(3,) the direction into which they shine."""


@dataclass(frozen=True, eq=False)
class Scenery:
    mesh: Mesh
    signals: tuple[Signal, ...]


@cache
def scenery(town: str) -> Scenery:
    """Everything of a town that does not move."""
    net = sumolib.net.readNet(str(network(town)), withInternal=True)
    rng = np.random.default_rng(zlib.crc32(town.encode()))
    road = _carriageway(net)
    signals, poles = _signals(net)
    ground = _ground_meshes(net, road)
    houses, footprints = _houses(net, road, rng)
    return Scenery(merged([*ground, *houses, *poles, *_trees(net, road, footprints, rng)]), signals)


# -------------------------------------------------------------------------------------------------------------- ground


def _carriageway(net: Any) -> Polygon | MultiPolygon:
    parts = [Polygon(node.getShape()) for node in net.getNodes() if len(node.getShape()) > 2]
    for edge in net.getEdges(withInternal=False):
        parts += [LineString(lane.getShape()).buffer(lane.getWidth() / 2, cap_style="flat") for lane in edge.getLanes()]
    # Closing by a hand's breadth heals the slits between lanes and junctions.
    return unary_union(parts).buffer(0.2).buffer(-0.2).simplify(0.02)


def _ground_meshes(net: Any, road: Polygon | MultiPolygon) -> Iterator[Mesh]:
    white = unary_union(list(_markings(net))).intersection(road)
    kerb = road.buffer(0.15, join_style="mitre").difference(road)
    walk = road.buffer(0.15 + SIDEWALK).difference(road.buffer(0.15, join_style="mitre"))
    x0, y0, x1, y1 = road.bounds
    ground = shapely.box(x0 - MARGIN, y0 - MARGIN, x1 + MARGIN, y1 + MARGIN)
    yield from _surface(road.difference(white), 0.0, "asphalt")
    yield from _surface(white, 0.0, "marking")
    yield from _surface(kerb, KERB_HEIGHT, "kerb")
    yield from _surface(walk, KERB_HEIGHT, "sidewalk")
    yield from _surface(ground.difference(road.buffer(0.15 + SIDEWALK)), KERB_HEIGHT, "grass")
    for ring in _rings(road):
        yield _wall(ring, 0.0, KERB_HEIGHT, "kerb")


def _polygons(shape: Any) -> list[Polygon]:
    return [part for part in getattr(shape, "geoms", [shape]) if isinstance(part, Polygon) and part.area > 1e-4]


def _rings(shape: Any) -> Iterator[Array]:
    """Rings (N, 2) of a region, with the region's inside on their right."""
    for polygon in _polygons(shape):
        turned = shapely.geometry.polygon.orient(polygon, sign=-1.0)
        for ring in (turned.exterior, *turned.interiors):
            yield np.array(ring.coords)


def _surface(shape: Any, z: float, material: str) -> Iterator[Mesh]:
    for polygon in _polygons(shape):
        triangles = shapely.constrained_delaunay_triangles(polygon)
        corners = np.array([np.array(shapely.geometry.polygon.orient(t).exterior.coords)[:3] for t in triangles.geoms])
        points = np.concatenate([corners, np.full((*corners.shape[:2], 1), z)], axis=-1).reshape(-1, 3)
        yield from_triangles(points, np.arange(len(points)), material)


def _wall(line: Array, low: float, high: float, material: str) -> Mesh:
    """A vertical strip along a line (N, 2), facing its right-hand side."""
    quads = [
        [(*a, low), (*b, low), (*b, high), (*a, high)] for a, b in itertools.pairwise(line) if np.hypot(*(b - a)) > 1e-6
    ]
    return flat(quads, material)


def _markings(net: Any) -> Iterator[Polygon]:
    """Centre lines (solid), lane lines (dashed) and stop lines as polygons."""
    for edge in net.getEdges(withInternal=False):
        lanes = edge.getLanes()
        for lane in lanes:
            shape, half = LineString(lane.getShape()), lane.getWidth() / 2
            left = shape.offset_curve(half)
            if lane is lanes[-1]:
                # Both directions draw their own line: together they are a double line.
                yield shape.offset_curve(half - 0.13).buffer(0.06, cap_style="flat")
            else:
                for start in np.arange(2.0, left.length - 3.0, 9.0):
                    dash = shapely.ops.substring(left, start, start + 3.0)
                    yield dash.buffer(0.06, cap_style="flat")
            if edge.getToNode().getType() == "traffic_light":
                end = shapely.ops.substring(shape, shape.length - 1.3, shape.length - 0.9)
                yield end.buffer(half - 0.15, cap_style="flat")


# ---------------------------------------------------------------------------------------------- beside the carriageway


def _along(net: Any, spacing: float, offset: float) -> Iterator[tuple[Array, float]]:
    """Places (2,) on the right of every edge, `offset` metres from the kerb, with the edge's heading there."""
    for edge in net.getEdges(withInternal=False):
        lane = edge.getLanes()[0]
        line = LineString(lane.getShape())
        for s in np.arange(spacing / 2, line.length, spacing):
            a, b = (np.array(line.interpolate(t).coords[0]) for t in (s, min(s + 0.5, line.length)))
            if np.hypot(*(b - a)) < 0.1:
                continue
            heading = float(np.arctan2(*(b - a)[::-1]))
            right = np.array([np.sin(heading), -np.cos(heading)])
            yield a + right * (lane.getWidth() / 2 + offset), heading


def _rectangle(center: Array, heading: float, length: float, depth: float) -> Polygon:
    c, s = np.cos(heading), np.sin(heading)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, depth / 2]
    return Polygon(corners @ np.array([[c, s], [-s, c]]) + center)


def _houses(net: Any, road: Any, rng: np.random.Generator) -> tuple[list[Mesh], list[Polygon]]:
    meshes: list[Mesh] = []
    footprints: list[Polygon] = []
    keep_clear = road.buffer(SIDEWALK + 1.5)
    for place, heading in _along(net, 17.0, SIDEWALK):
        length, depth = rng.uniform(9, 15), rng.uniform(8, 11)
        floors, setback = int(rng.integers(2, 4)), rng.uniform(*SETBACK)
        walls, roof = rng.choice(["brick", "plaster", "stone"]), rng.choice(["tiles", "slate"])
        right = np.array([np.sin(heading), -np.cos(heading)])
        center = place + right * (setback + depth / 2)
        footprint = _rectangle(center, heading, length, depth)
        if footprint.intersects(keep_clear) or any(footprint.buffer(1.5).intersects(other) for other in footprints):
            continue
        footprints.append(footprint)
        meshes.append(_house(length, depth, floors, str(walls), str(roof)).moved([*center, KERB_HEIGHT], heading))
    return meshes, footprints


def _house(length: float, depth: float, floors: int, walls: str, roof: str) -> Mesh:
    """A house around the origin with its front towards +y: rows of windows, a gabled roof."""
    x, y, eaves = length / 2, depth / 2, 3.0 * floors
    corners = [(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)]
    parts = [_facade(np.array(a), np.array(b), floors, walls) for a, b in itertools.pairwise(corners)]
    ridge, over = eaves + depth * 0.32, 0.4
    drop = over * 0.64
    slopes = [
        [
            (-x - over, -y - over, eaves - drop),
            (x + over, -y - over, eaves - drop),
            (x + over, 0, ridge),
            (-x - over, 0, ridge),
        ],
        [
            (x + over, y + over, eaves - drop),
            (-x - over, y + over, eaves - drop),
            (-x - over, 0, ridge),
            (x + over, 0, ridge),
        ],
    ]
    gables = [[(x, -y, eaves), (x, y, eaves), (x, 0, ridge)], [(-x, y, eaves), (-x, -y, eaves), (-x, 0, ridge)]]
    return merged([*parts, flat(slopes, roof), flat(gables, walls)])


def _facade(a: Array, b: Array, floors: int, walls: str) -> Mesh:
    """A wall from a to b (outside on the right) with a window in each bay of each floor."""
    width = float(np.hypot(*(b - a)))
    bays = max(2, int(width / 2.8))
    us = np.concatenate([np.array([0.0, 0.25, 0.75]) + i for i in range(bays)] + [[bays]]) / bays
    zs = np.concatenate([np.array([0.0, 0.95, 2.35]) + 3.0 * i for i in range(floors)] + [[3.0 * floors]])
    points = np.array([[[*(a + (b - a) * u), z] for u in us] for z in zs])
    cells = [["window" if i % 3 == 1 and j % 3 == 1 else walls for j in range(len(us) - 1)] for i in range(len(zs) - 1)]
    return grid(points, cells)


def _trees(net: Any, road: Any, footprints: list[Polygon], rng: np.random.Generator) -> Iterator[Mesh]:
    cameras = [Point(site.position).buffer(8.0) for site in sites().values()]
    keep_clear = unary_union([road.buffer(1.2), *(f.buffer(2.0) for f in footprints), *cameras])
    for place, _ in _along(net, 13.0, 1.9):
        at = place + rng.uniform(-1.0, 1.0, 2)
        height, girth, likely = rng.uniform(5.5, 9.0), rng.uniform(1.4, 2.3), rng.random()
        blobs = rng.normal(0, 0.12, (3, 26))
        if likely < 0.45 or keep_clear.contains(Point(at)) or keep_clear.distance(Point(at)) < 0.3:
            continue
        yield _tree(height, girth, blobs).moved([*at, KERB_HEIGHT])


def _tree(height: float, girth: float, blobs: Array) -> Mesh:
    trunk = lathe([(0, 0.16), (height * 0.5, 0.11)], ["bark"], 7, "z")
    crowns = []
    for i, noise in enumerate(blobs):
        angle = 2.4 * i
        center = [0.45 * girth * np.cos(angle), 0.45 * girth * np.sin(angle), height * (0.58 + 0.12 * i)]
        crowns.append(_blob(girth * (1.0 - 0.15 * i), noise).moved(center))
    return merged([trunk, *crowns])


def _blob(radius: float, noise: Array) -> Mesh:
    """An uneven sphere of 8 x 5 facets; `noise` (26,) moves its vertices in and out."""
    around, up = np.linspace(0, 2 * np.pi, 9), np.linspace(-np.pi / 2, np.pi / 2, 6)
    r = np.full((6, 9), radius * (1 + noise[0]))
    r[1:5, :8] *= 1 + np.resize(noise[1:], (4, 8))
    r[:, 8] = r[:, 0]
    points = np.stack(
        [
            r * np.cos(up)[:, None] * np.cos(around),
            r * np.cos(up)[:, None] * np.sin(around),
            0.85 * r * np.sin(up)[:, None] + 0 * r,
        ],
        axis=-1,
    )
    return grid(points, [["leaves"] * 8] * 5)


# ------------------------------------------------------------------------------------------------------------- signals


def _signals(net: Any) -> tuple[tuple[Signal, ...], list[Mesh]]:
    """One pole with a head for every edge that leads to a signalled junction, at its stop line."""
    signals, poles = [], []
    for program in net.getTrafficLights():
        links = {lane.getEdge().getID(): (lane.getEdge(), link) for lane, _, link in reversed(program.getConnections())}
        for edge, link in links.values():
            shape = np.array(edge.getLanes()[0].getShape())
            heading = float(np.arctan2(*(shape[-1] - shape[-2])[::-1]))
            right = np.array([np.sin(heading), -np.cos(heading)])
            foot = shape[-1] + right * (edge.getLanes()[0].getWidth() / 2 + 0.7)
            head = box([-0.12, -0.17, 2.6], [0.1, 0.17, 3.6], "trim")
            pole = lathe([(0.0, 0.07), (3.2, 0.06)], ["pole"], 8, "z").moved([0.17, 0, 0])
            poles.append(merged([head, pole]).moved([*foot, KERB_HEIGHT], heading))
            facing = np.array([-np.cos(heading), -np.sin(heading), 0.0])
            lamps = [*foot, KERB_HEIGHT] + 0.13 * facing + np.array([[0, 0, 3.42], [0, 0, 3.1], [0, 0, 2.78]])
            signals.append(Signal(program.getID(), link, lamps, facing))
    return tuple(signals), poles
