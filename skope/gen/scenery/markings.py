"""Polygons on the road: its markings and its wear.

Markings are edge lines, lane lines, stop lines, arrows and pedestrian crossings. Wear is wheel tracks, patches, cracks
and covers.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from shapely import LineString, Point, Polygon
from shapely.ops import substring, unary_union

from skope.gen.towns.land_use import LAND_USE, Layout
from skope.gen.towns.regions import rectangle_polygon
from skope.gen.towns.road_graph import (
    RoadGraph,
    beside,
    driven,
    edges_at,
    half_width,
    is_minor,
    is_signalled,
    joins,
    right_of,
)
from skope.types import Array


@dataclass(frozen=True)
class MarkingSizes:
    """Sizes of road markings."""

    crossing_m: tuple[float, float] = (0.7, 3.7)
    """Nearer and farther edge of a crossing, beyond the end of the lanes that stop before it, metres."""
    stripe_m: float = 0.5
    """Width of a stripe, metres."""
    arrows_m: tuple[float, float] = (9.0, 26.0)
    """Distances of lane arrows from the stop line, metres."""
    line_half_m: float = 0.06
    """Half of a line's width, metres."""
    through_m: float = 12.0
    """Maximum length of junctions of two edges through which lines continue, metres."""


MARKING_SIZES: Final = MarkingSizes()


def markings(graph: RoadGraph) -> Iterator[Polygon]:
    """Yield centre and edge lines (solid), lane lines (dashed), stop lines and arrows."""
    for edge in graph.edges:
        lanes, kind = driven(edge), graph.kind(edge)
        right = LineString(lanes[0].getShape())
        if kind.edge_lines:
            yield right.offset_curve(0.2 - lanes[0].getWidth() / 2).buffer(MARKING_SIZES.line_half_m, cap_style="flat")
        for lane in lanes:
            shape, half = LineString(lane.getShape()), lane.getWidth() / 2
            if lane is lanes[-1]:
                yield from _left_line(graph, edge, shape, half)
            else:
                yield from _lane_line(edge, shape.offset_curve(half))
            if is_signalled(edge):
                end = substring(shape, shape.length - 1.3, shape.length - 0.9)
                yield end.buffer(half - 0.15, cap_style="flat")
            elif is_minor(edge) and joins(edge) > 1 and kind.form == "ground":
                yield from _give_way(shape, half)
            if is_signalled(edge) or len(lanes) > 1:
                yield from _arrows(lane, shape)
    yield from _lines_through_joints(graph)


def _left_line(graph: RoadGraph, edge: Any, shape: LineString, half: float) -> Iterator[Polygon]:
    """Yield the line to the left of an edge's lanes.

    Adjacent opposite edges both draw one, which gives a double line.
    """
    if graph.kind(edge).edge_lines and not _is_divided(edge):
        # If overtaking is allowed, one of the two directions draws a broken line.
        if edge.getID() < min((e.getID() for e in _opposite_edges(edge)), default="~"):
            left = shape.offset_curve(half)
            for start in np.arange(4.0, left.length - 6.0, 12.0):
                yield substring(left, start, start + 4.0).buffer(MARKING_SIZES.line_half_m, cap_style="flat")
    else:
        yield shape.offset_curve(half - 0.16).buffer(MARKING_SIZES.line_half_m, cap_style="flat")


def _opposite_edges(edge: Any) -> list[Any]:
    return [
        e
        for e in edges_at(edge.getToNode())
        if e.getFromNode() is edge.getToNode() and e.getToNode() is edge.getFromNode()
    ]


def _is_divided(edge: Any) -> bool:
    """Return whether no opposite lanes touch an edge's lanes."""
    mine = LineString(driven(edge)[-1].getShape())
    return not any(
        LineString(driven(opposite)[-1].getShape()).distance(mine) < driven(edge)[-1].getWidth() + 0.3
        for opposite in _opposite_edges(edge)
    )


def _lane_line(edge: Any, left: LineString) -> Iterator[Polygon]:
    solid = 18.0 if is_signalled(edge) else 0.0
    for start in np.arange(2.0, left.length - 3.0 - solid, 9.0):
        yield substring(left, start, start + 3.0).buffer(MARKING_SIZES.line_half_m, cap_style="flat")
    if solid:
        yield substring(left, max(left.length - solid, 0.0), left.length - 0.9).buffer(
            MARKING_SIZES.line_half_m, cap_style="flat"
        )


def _lines_through_joints(graph: RoadGraph) -> Iterator[Polygon]:
    """Yield outer lines across short joints of the network, where a road only changes its number of lanes."""
    for edge in graph.edges:
        followers = [e for e in edge.getOutgoing() if not e.isSpecial()]
        if len(followers) != 1 or joins(edge) > 2 or is_signalled(edge):
            continue
        (follower,) = followers
        for index, side in ((0, -1.0), (-1, 1.0)):
            if side < 0 and not graph.kind(edge).edge_lines:
                continue
            ends = []
            for lane, at in ((driven(edge)[index], -1), (driven(follower)[index], 0)):
                shape = LineString(lane.getShape())
                inset = 0.2 if side < 0 else 0.16
                ends.append(shape.offset_curve(side * (lane.getWidth() / 2 - inset)).coords[at])
            gap = LineString(ends)
            if 0.05 < gap.length < MARKING_SIZES.through_m:
                yield gap.buffer(MARKING_SIZES.line_half_m, cap_style="flat")


def _give_way(shape: LineString, half: float) -> Iterator[Polygon]:
    """Yield a broken line of short dashes across the lane."""
    end = np.array(shape.coords[-1])
    before = np.array(shape.interpolate(shape.length - 1.0).coords[0])
    along = (end - before) / np.hypot(*(end - before))
    across = np.array([along[1], -along[0]])
    for offset in np.arange(-half + 0.35, half - 0.1, 0.75):
        yield rectangle_polygon(end - 0.4 * along + offset * across, float(np.arctan2(along[1], along[0])), 0.35, 0.45)


def _arrows(lane: Any, shape: LineString) -> Iterator[Polygon]:
    """Yield arrows for the directions of a lane, painted on it twice."""
    ways = {connection.getDirection().lower() for connection in lane.getOutgoing()} & {"s", "l", "r"}
    if ways == {"s"} and not is_signalled(lane.getEdge()):
        return
    for distance in MARKING_SIZES.arrows_m:
        if not ways or shape.length < distance + 8.0:
            continue
        at = np.array(shape.interpolate(shape.length - distance).coords[0])
        ahead = np.array(shape.interpolate(shape.length - distance + 0.5).coords[0])
        angle = float(np.arctan2(*(ahead - at)[::-1]))
        drawn = shapely.affinity.rotate(_arrow(ways), angle, origin=(0, 0), use_radians=True)
        yield shapely.affinity.translate(drawn, *at)


def _arrow(ways: set[str]) -> Any:
    """Return an arrow of 4.5 m that points along +x, with a branch for each turn of the lane."""
    stem = 2.6 if "s" in ways else 2.0
    parts = [Polygon([(-2.2, -0.08), (stem - 1.2, -0.08), (stem - 1.2, 0.08), (-2.2, 0.08)])]
    if "s" in ways:
        parts.append(Polygon([(1.2, -0.3), (2.6, 0.0), (1.2, 0.3)]))
        parts.append(Polygon([(1.0, -0.08), (1.4, -0.08), (1.4, 0.08), (1.0, 0.08)]))
    for way, side in (("l", 1.0), ("r", -1.0)):
        if way in ways:
            start = -0.6 if "s" in ways else stem - 1.25
            branch = LineString([(start - 0.6, 0.0), (start, 0.0), (start + 0.7, side * 0.5)])
            parts.append(branch.buffer(0.09, cap_style="flat", join_style="mitre"))
            parts.append(
                Polygon([(start + 0.35, side * 0.62), (start + 0.95, side * 0.3), (start + 1.25, side * 0.95)])
            )
    return unary_union(parts)


def hatching(position: Array, heading: float, rng: np.random.Generator) -> list[Polygon]:
    """Return a hatched area of chevrons or slanting stripes, as where lanes split and end.

    Args:
        position: (2,) start of its right edge.
        heading: Direction of the area, radians.
        rng: Random generator.
    """
    long, wide, thick = rng.uniform(8.0, 20.0), rng.uniform(1.2, 2.6), rng.uniform(0.3, 0.6)
    step, lean = thick + rng.uniform(0.6, 1.4), rng.uniform(0.5, 1.2) * rng.choice([-1.0, 1.0])
    shares = ((0.0, 0.0), (1.0, 0.5), (0.0, 1.0)) if rng.random() < 0.6 else ((0.0, 0.0), (1.0, 1.0))
    out = []
    for x in np.arange(1.2, long - 1.2 - thick, step).tolist():
        near = [(x + lean * ahead, wide * across) for ahead, across in shares]
        out.append(Polygon([*near, *((u + thick, v) for u, v in reversed(near))]))
    out += [shapely.box(0.0, y - MARKING_SIZES.line_half_m, long, y + MARKING_SIZES.line_half_m) for y in (0.0, wide)]
    turned = (shapely.affinity.rotate(part, heading, origin=(0, 0), use_radians=True) for part in out)
    return [shapely.affinity.translate(part, *position) for part in turned]


def zebra_stripes(graph: RoadGraph) -> Iterator[Polygon]:
    """Yield zebra stripes across the carriageway where edges with sidewalks lead to a signalled junction.

    The corner of a narrow junction, where two crossings would meet, has no stripes.
    """
    zebras = [zebra for edge in graph.edges if (zebra := _zebra(graph, edge))]
    hulls = [shapely.MultiPolygon([stripe for stripe, _ in zebra]).convex_hull for zebra in zebras]
    for number, zebra in enumerate(zebras):
        other_crossings = unary_union([hull for k, hull in enumerate(hulls) if k != number])
        yield from (stripe for stripe, before_lanes in zebra if before_lanes or not stripe.intersects(other_crossings))


def _zebra(graph: RoadGraph, edge: Any) -> list[tuple[Polygon, bool]]:
    """Return an edge's stripes, and whether each lies before lanes that begin or end there."""
    if not is_signalled(edge) or not graph.kind(edge).sidewalk:
        return []
    road, lane = graph.ground_road, driven(edge)[-1]
    line = LineString(lane.getShape())
    end, before = (np.array(line.interpolate(t).coords[0]) for t in (line.length, line.length - 1.0))
    along = (end - before) / np.hypot(*(end - before))
    across = np.array([along[1], -along[0]])
    middle = end + along * sum(MARKING_SIZES.crossing_m) / 2 - across * lane.getWidth() / 2
    span = _chord(road, middle, across)
    if span is None:
        return []
    low, high = span[0] + 0.3, span[1] - 0.3
    arm = _chord(road, before - across * lane.getWidth() / 2, across) or span
    count = int((high - low) // (2 * MARKING_SIZES.stripe_m))
    start = (low + high) / 2 - (count - 0.5) * MARKING_SIZES.stripe_m
    out = []
    for i in range(count):
        offset = start + 2 * MARKING_SIZES.stripe_m * i + MARKING_SIZES.stripe_m / 2
        turned = float(np.arctan2(along[1], along[0]))
        stripe = rectangle_polygon(
            middle + across * offset,
            turned,
            MARKING_SIZES.crossing_m[1] - MARKING_SIZES.crossing_m[0],
            MARKING_SIZES.stripe_m,
        )
        out.append((stripe, arm[0] < offset < arm[1]))
    return out


def _chord(road: Any, middle: Array, across: Array) -> tuple[float, float] | None:
    """Return the extent of the road to both sides of a position along a direction, metres.

    None if it is off the road.
    """
    chord = road.intersection(LineString([middle - 32 * across, middle + 32 * across]))
    pieces = [piece for piece in getattr(chord, "geoms", [chord]) if piece.distance(shapely.Point(middle)) < 0.1]
    if not pieces:
        return None
    offsets = (np.array(pieces[0].coords) - middle) @ across
    return float(offsets.min()), float(offsets.max())


def tracks(layout: Layout, width: float) -> Any:
    """Return the areas under wheels: two strips along each lane."""
    strips = []
    for edge in layout.graph.edges:
        for lane in driven(edge):
            line = LineString(lane.getShape())
            strips += [line.offset_curve(side).buffer(width / 2, cap_style="flat") for side in (-0.82, 0.82)]
    return unary_union(strips).intersection(layout.detailed)


def repairs(layout: Layout, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Return dark new patches, pale old patches, and bitumen: the sealed edges of patches and sealed cracks."""
    new, old, cracks = [], [], []
    for edge in layout.graph.edges:
        half = half_width(edge)
        for s in np.arange(rng.uniform(4.0, 14.0), driven(edge)[0].getLength() - 6.0, 15.0):
            s += rng.uniform(-4.0, 4.0)
            kind, across = rng.random(), rng.uniform(-0.8, 0.8) * half
            middle, heading = beside(edge, s, -half)
            if layout.camera_distance(middle) > LAND_USE.plain_from_m:
                continue
            at = middle + right_of(heading) * across
            shape = rectangle_polygon(at, heading, rng.uniform(1.2, 3.5), rng.uniform(0.8, 1.8))
            if kind < 0.22:
                new.append(shape)
            elif kind < 0.40:
                old.append(shape)
            elif kind < 0.52:  # a trench across the lanes
                new.append(rectangle_polygon(middle, heading, rng.uniform(0.6, 0.9), 2 * half))
            elif kind < 0.60:  # a trench along the lanes
                old.append(rectangle_polygon(at, heading, rng.uniform(8.0, 16.0), 0.7))
            else:
                cracks.append(_crack(at, heading + rng.choice([0.0, 0.0, np.pi / 2]), rng))
    for node in layout.graph.net.getNodes():
        if layout.camera_distance(np.array(node.getCoord())) > LAND_USE.plain_from_m or len(node.getShape()) < 4:
            continue
        if (area := Polygon(node.getShape()).buffer(-3.0)).area > 40:
            for kept in (new, old):
                at, heading = _random_position(area, rng), rng.uniform(0, np.pi)
                kept.append(rectangle_polygon(at, heading, rng.uniform(1.2, 2.6), 1.1))
            cracks += [_crack(_random_position(area, rng), rng.uniform(0, np.pi), rng) for _ in range(3)]
    seams = [shape.boundary.buffer(0.035, cap_style="flat") for shape in (*new, *old)]
    return unary_union(new), unary_union(old), unary_union([*seams, *cracks])


def _random_position(region: Any, rng: np.random.Generator) -> Array:
    """Return a random position (2,) inside a region."""
    x0, y0, x1, y1 = region.bounds
    while True:
        position = rng.uniform((x0, y0), (x1, y1))
        if region.contains(Point(position)):
            return np.asarray(position)


def _crack(at: Array, heading: float, rng: np.random.Generator) -> Polygon:
    """Return an irregular sealed crack of a few metres."""
    steps = int(rng.integers(6, 16))
    turn = heading + rng.normal(0.0, 0.45, steps)
    line = at + 0.45 * np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)
    return LineString(line).buffer(rng.uniform(0.015, 0.03), quad_segs=1, join_style="mitre")


def covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    """Yield manhole covers in the lanes and drain grates in the gutters of roads with sidewalks."""
    for edge in layout.graph.edges:
        if not layout.graph.kind(edge).sidewalk:
            continue
        lanes = driven(edge)
        length = lanes[0].getLength()
        for s in np.arange(rng.uniform(5.0, 20.0), length - 4.0, 27.0):
            at = LineString(lanes[rng.integers(len(lanes))].getShape()).interpolate(s + rng.uniform(-6.0, 6.0))
            if layout.camera_distance(np.array([at.x, at.y])) < LAND_USE.plain_from_m:
                yield Point(at.x + rng.uniform(-0.3, 0.3), at.y + rng.uniform(-0.3, 0.3)).buffer(0.33, quad_segs=5)
        for s in np.arange(9.0, length - 4.0, 24.0):
            at, heading = beside(edge, s, -0.19)
            if layout.camera_distance(at) < LAND_USE.plain_from_m:
                yield rectangle_polygon(at, heading, 0.5, 0.3)


def sidewalk_covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    for edge in layout.graph.edges:
        for s in np.arange(rng.uniform(3.0, 12.0), driven(edge)[0].getLength(), 13.0):
            at, heading = beside(edge, s + rng.uniform(-3.0, 3.0), rng.uniform(1.0, 1.9))
            if layout.camera_distance(at) > LAND_USE.plain_from_m:
                continue
            yield rectangle_polygon(at, heading, rng.choice([0.45, 0.6, 0.9]), 0.45)
