"""Wear of the road: wheel tracks, patches, cracks, covers."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from shapely import LineString, Point, Polygon
from shapely.ops import unary_union

from skope.gen.towns.land_use import PLAIN_FROM_M, Layout
from skope.gen.towns.regions import rectangle_polygon
from skope.gen.towns.road_graph import beside, driven, half_width, right_of
from skope.types import Array


def tracks(layout: Layout, width: float) -> Any:
    """Areas that wheels run over: two strips along each lane."""
    strips = []
    for edge in layout.graph.edges:
        for lane in driven(edge):
            line = LineString(lane.getShape())
            strips += [line.offset_curve(side).buffer(width / 2, cap_style="flat") for side in (-0.82, 0.82)]
    return unary_union(strips).intersection(layout.detailed)


def repairs(layout: Layout, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Dark new patches, pale old ones, and bitumen: their sealed edges and sealed cracks."""
    new, old, cracks = [], [], []
    for edge in layout.graph.edges:
        half = half_width(edge)
        for s in np.arange(rng.uniform(4.0, 14.0), driven(edge)[0].getLength() - 6.0, 15.0):
            s += rng.uniform(-4.0, 4.0)
            kind, across = rng.random(), rng.uniform(-0.8, 0.8) * half
            middle, heading = beside(edge, s, -half)
            if layout.camera_distance(middle) > PLAIN_FROM_M:
                continue
            at = middle + right_of(heading) * across
            shape = rectangle_polygon(at, heading, rng.uniform(1.2, 3.5), rng.uniform(0.8, 1.8))
            if kind < 0.22:
                new.append(shape)
            elif kind < 0.40:
                old.append(shape)
            elif kind < 0.52:  # a trench across the lanes
                new.append(rectangle_polygon(middle, heading, rng.uniform(0.6, 0.9), 2 * half))
            elif kind < 0.60:  # a trench along them
                old.append(rectangle_polygon(at, heading, rng.uniform(8.0, 16.0), 0.7))
            else:
                cracks.append(_crack(at, heading + rng.choice([0.0, 0.0, np.pi / 2]), rng))
    for node in layout.graph.net.getNodes():
        if layout.camera_distance(np.array(node.getCoord())) > PLAIN_FROM_M or len(node.getShape()) < 4:
            continue
        if (area := Polygon(node.getShape()).buffer(-3.0)).area > 40:
            for kept in (new, old):
                at, heading = _random_place(area, rng), rng.uniform(0, np.pi)
                kept.append(rectangle_polygon(at, heading, rng.uniform(1.2, 2.6), 1.1))
            cracks += [_crack(_random_place(area, rng), rng.uniform(0, np.pi), rng) for _ in range(3)]
    seams = [shape.boundary.buffer(0.035, cap_style="flat") for shape in (*new, *old)]
    return unary_union(new), unary_union(old), unary_union([*seams, *cracks])


def _random_place(region: Any, rng: np.random.Generator) -> Array:
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


def covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    """Manhole covers in the lanes and drain grates in the gutters of roads with sidewalks."""
    for edge in layout.graph.edges:
        if not layout.graph.kind(edge).sidewalk:
            continue
        lanes = driven(edge)
        length = lanes[0].getLength()
        for s in np.arange(rng.uniform(5.0, 20.0), length - 4.0, 27.0):
            at = LineString(lanes[rng.integers(len(lanes))].getShape()).interpolate(s + rng.uniform(-6.0, 6.0))
            if layout.camera_distance(np.array([at.x, at.y])) < PLAIN_FROM_M:
                yield Point(at.x + rng.uniform(-0.3, 0.3), at.y + rng.uniform(-0.3, 0.3)).buffer(0.33, quad_segs=5)
        for s in np.arange(9.0, length - 4.0, 24.0):
            at, heading = beside(edge, s, -0.19)
            if layout.camera_distance(at) < PLAIN_FROM_M:
                yield rectangle_polygon(at, heading, 0.5, 0.3)


def sidewalk_covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    for edge in layout.graph.edges:
        for s in np.arange(rng.uniform(3.0, 12.0), driven(edge)[0].getLength(), 13.0):
            at, heading = beside(edge, s + rng.uniform(-3.0, 3.0), rng.uniform(1.0, 1.9))
            if layout.camera_distance(at) > PLAIN_FROM_M:
                continue
            yield rectangle_polygon(at, heading, rng.choice([0.45, 0.6, 0.9]), 0.45)
