"""Parking: bays of car parks, on the drives beside houses, and along kerbs."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from shapely import Polygon
from shapely.ops import unary_union

from skope.gen.towns.land_use import KERB_WIDTH, Layout
from skope.gen.towns.regions import polygons, rectangle_polygon
from skope.gen.towns.road_graph import beside, driven
from skope.types import Array

BAY: Final = (4.8, 2.6)
"""Length and width of a bay, metres."""
AISLE: Final = 6.8
DRIVE: Final = 2.4
"""Width of a drive, metres."""
_LOT_EDGE_M: Final = 1.0
"""Distance from a car park's edge to its bays, metres."""
KERBSIDE: Final = (6.0, 2.1)
"""Length and width of a bay along a kerb, metres."""
_PARKED_ALONG: Final = 0.55
"""Share of the streets with wide enough sidewalks that have bays along their kerbs."""
_WIDE_ENOUGH: Final = 2.2
"""Width of a sidewalk from which it may have bays, metres."""
_FROM_JUNCTIONS: Final = (12.0, 20.0)
"""Distance from the beginning and the end of a street to its bays, metres."""
_FREE_SHARE: Final = 0.15
"""Share of the places along a kerb that are left free between bays."""


@dataclass(frozen=True)
class Bay:
    """A parking bay for one car."""

    place: tuple[float, float]
    """World x and y of its middle, metres."""
    heading: float
    """Direction in which a car drives into it, counter-clockwise from east, radians."""


def ground_of(bays: Iterable[Bay]) -> Any:
    """The ground that bays along kerbs take up."""
    return unary_union([rectangle_polygon(np.array(bay.place), bay.heading, *KERBSIDE).buffer(0.01) for bay in bays])


def lot_bays(lots: Any) -> list[Bay]:
    """Rows of bays with aisles between them in each of the car parks."""
    return [bay for lot in polygons(lots) for bay in _rows(lot)]


def _rows(lot: Polygon) -> Iterator[Bay]:
    corners = np.array(lot.minimum_rotated_rectangle.exterior.coords)[:4]
    sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    if sides[0] < sides[1]:
        corners = np.roll(corners, -1, axis=0)
    a, along, across = corners[0], corners[1] - corners[0], corners[3] - corners[0]
    length, depth = np.hypot(*along), np.hypot(*across)
    along, across = along / length, across / depth
    inside = lot.buffer(-0.3)
    for row in np.arange(_LOT_EDGE_M + BAY[0] / 2, depth - BAY[0] / 2, BAY[0] + AISLE):
        for x in np.arange(2.0 + BAY[1] / 2, length - 2.0 - BAY[1] / 2, BAY[1]):
            place = a + along * x + across * row
            bay = Bay((float(place[0]), float(place[1])), float(np.arctan2(*across[::-1])))
            if inside.contains(rectangle_polygon(place, bay.heading, *BAY)):
                yield bay


def kerb_bays(layout: Layout, keep_clear: Any, rng: np.random.Generator) -> list[Bay]:
    """Bays along the kerbs of some streets, on the side of the sidewalk, in the direction of the traffic.

    Args:
        layout: The town's, in whose places the bays are.
        keep_clear: Region that no bay may meet, such as drives and crossings.
        rng: Draws streets and gaps.
    """
    out = []
    for edge in layout.graph.edges_of("ground"):
        if layout.graph.kind(edge).sidewalk < _WIDE_ENOUGH or rng.random() > _PARKED_ALONG:
            continue
        first, last = _FROM_JUNCTIONS
        for s in np.arange(first, driven(edge)[0].getLength() - last, KERBSIDE[0]):
            place, heading = beside(edge, float(s), KERB_WIDTH + KERBSIDE[1] / 2)
            ground = rectangle_polygon(place, heading, *KERBSIDE)
            if rng.random() > _FREE_SHARE and not any(map(ground.intersects, (keep_clear, layout.graph.road))):
                out.append(Bay((float(place[0]), float(place[1])), heading))
    return out


def bay_lines(lots: Any) -> Any:
    """Painted lines on both sides of each bay of the car parks."""
    lines = []
    for bay in lot_bays(lots):
        side = np.array([-np.sin(bay.heading), np.cos(bay.heading)]) * BAY[1] / 2
        lines += [rectangle_polygon(np.array(bay.place) + sign * side, bay.heading, BAY[0], 0.1) for sign in (-1, 1)]
    return unary_union(lines).intersection(lots.buffer(-0.3)) if lines else Polygon()


def drive_ring(half_length: float, front: float, street: float) -> Array:
    """(4, 2) corners of a drive beside a house, from its side to the street, in the house's frame."""
    x = half_length + 0.3
    return np.array([[x, front - 5.0], [x + DRIVE, front - 5.0], [x + DRIVE, street], [x, street]])


def drive_bay(half_length: float, front: float) -> tuple[float, float]:
    """The middle of the place for a car on such a drive, in the house's frame."""
    return half_length + 0.3 + DRIVE / 2, front - 5.0 + BAY[0] / 2 + 0.3
