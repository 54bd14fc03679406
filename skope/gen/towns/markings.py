"""Road markings as polygons: lane lines, stop lines, arrows, crossings for pedestrians."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon
from shapely.ops import substring, unary_union

from skope.gen.towns.layout import rectangle

Array = NDArray[np.float64]

CROSSING: Final = (0.7, 3.7)
"""Where a crossing lies beyond the end of the lanes that stop before it, metres."""
STRIPE: Final = 0.5
ARROWS: Final = (9.0, 26.0)
"""Distances of lane arrows from the stop line, metres."""
_LINE: Final = 0.06


def markings(net: Any) -> Iterator[Polygon]:
    """Centre lines (solid), lane lines (dashed), stop lines and arrows."""
    for edge in net.getEdges(withInternal=False):
        lanes = edge.getLanes()
        for lane in lanes:
            shape, half = LineString(lane.getShape()), lane.getWidth() / 2
            left = shape.offset_curve(half)
            if lane is lanes[-1]:
                # Both directions draw their own line: together they are a double line.
                yield shape.offset_curve(half - 0.13).buffer(_LINE, cap_style="flat")
            else:
                solid = 18.0 if edge.getToNode().getType() == "traffic_light" else 0.0
                for start in np.arange(2.0, left.length - 3.0 - solid, 9.0):
                    yield substring(left, start, start + 3.0).buffer(_LINE, cap_style="flat")
                if solid:
                    yield substring(left, left.length - solid, left.length - 0.9).buffer(_LINE, cap_style="flat")
            if edge.getToNode().getType() == "traffic_light":
                end = substring(shape, shape.length - 1.3, shape.length - 0.9)
                yield end.buffer(half - 0.15, cap_style="flat")
                yield from _arrows(lane, shape)
            elif edge.getPriority() < 2 and len(edge.getToNode().getIncoming()) > 1:
                yield from _give_way(shape, half)


def _give_way(shape: LineString, half: float) -> Iterator[Polygon]:
    """A broken line of short dashes across the lane."""
    end = np.array(shape.coords[-1])
    before = np.array(shape.interpolate(shape.length - 1.0).coords[0])
    along = (end - before) / np.hypot(*(end - before))
    across = np.array([along[1], -along[0]])
    for offset in np.arange(-half + 0.35, half - 0.1, 0.75):
        yield rectangle(end - 0.4 * along + offset * across, float(np.arctan2(along[1], along[0])), 0.35, 0.45)


def _arrows(lane: Any, shape: LineString) -> Iterator[Polygon]:
    """Where the lane leads, painted on it twice."""
    ways = {connection.getDirection().lower() for connection in lane.getOutgoing()} & {"s", "l", "r"}
    for distance in ARROWS:
        if not ways or shape.length < distance + 8.0:
            continue
        at = np.array(shape.interpolate(shape.length - distance).coords[0])
        ahead = np.array(shape.interpolate(shape.length - distance + 0.5).coords[0])
        angle = float(np.arctan2(*(ahead - at)[::-1]))
        drawn = shapely.affinity.rotate(_arrow(ways), angle, origin=(0, 0), use_radians=True)
        yield shapely.affinity.translate(drawn, *at)


def _arrow(ways: set[str]) -> Any:
    """An arrow of 4.5 m that points along +x, with a branch to each side that the lane leads to."""
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


def crossings(net: Any, road: Any) -> Iterator[Polygon]:
    """Zebra stripes across the carriageway where edges lead to a signalled junction."""
    for edge in net.getEdges(withInternal=False):
        if edge.getToNode().getType() != "traffic_light":
            continue
        line = LineString(edge.getLanes()[-1].getShape())
        end, before = (np.array(line.interpolate(t).coords[0]) for t in (line.length, line.length - 1.0))
        along = (end - before) / np.hypot(*(end - before))
        across = np.array([along[1], -along[0]])
        middle = end + along * sum(CROSSING) / 2 - across * edge.getLanes()[-1].getWidth() / 2
        chord = road.intersection(LineString([middle - 20 * across, middle + 20 * across]))
        pieces = [piece for piece in getattr(chord, "geoms", [chord]) if piece.distance(shapely.Point(middle)) < 0.1]
        if not pieces:
            continue
        offsets = (np.array(pieces[0].coords) - middle) @ across
        low, high = offsets.min() + 0.3, offsets.max() - 0.3
        count = int((high - low) // (2 * STRIPE))
        start = (low + high) / 2 - (count - 0.5) * STRIPE
        for i in range(count):
            at = middle + across * (start + 2 * STRIPE * i + STRIPE / 2)
            yield rectangle(at, float(np.arctan2(along[1], along[0])), CROSSING[1] - CROSSING[0], STRIPE)
