"""Where things may stand in a town: the carriageway, what lies beside it, and what its cameras must see."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, TypeAlias

import numpy as np
import shapely
import sumolib
from numpy.typing import NDArray
from shapely import LineString, MultiPolygon, Point, Polygon
from shapely.ops import unary_union

from skope.gen.towns import Site, network, sites

Array = NDArray[np.float64]
Region: TypeAlias = Polygon | MultiPolygon

KERB_HEIGHT: Final = 0.12
KERB_WIDTH: Final = 0.15
SIDEWALK: Final = 2.4
CAMERA_CLEARANCE: Final = 8.0
"""Around a camera nothing stands higher than 1 m, metres."""
NEAR: Final = 48.0
"""Things nearer than that to a camera are drawn in full detail, metres."""
HALF_VIEW_DEG: Final = 56.0


@dataclass(frozen=True, eq=False)
class Layout:
    """A town's network with the regions that scenery is fitted into."""

    net: Any
    road: Region
    sites: tuple[Site, ...]

    @classmethod
    def of(cls, town: str) -> "Layout":
        net = sumolib.net.readNet(str(network(town)), withInternal=True)
        return cls(net, _carriageway(net), tuple(site for site in sites().values() if site.town == town))

    @property
    def edges(self) -> list[Any]:
        return list(self.net.getEdges(withInternal=False))

    @cached_property
    def around_cameras(self) -> Region:
        return unary_union([Point(site.position[:2]).buffer(CAMERA_CLEARANCE) for site in self.sites])

    def camera_distance(self, place: Array) -> float:
        """How far a place (2,) is from the nearest camera, metres."""
        return min((float(np.hypot(*(place - site.position[:2]))) for site in self.sites), default=np.inf)

    def sightlines(self, reach: float) -> Region:
        """What lies between the cameras and the carriageway that they see within `reach` metres."""
        return unary_union([self.around_cameras, *(_sightlines(site, self.road, reach) for site in self.sites)])

    def is_near(self, place: Array) -> bool:
        """Whether a camera is near enough to see details at a place (2,)."""
        return self.camera_distance(place) < NEAR

    def centre_distance(self, place: Array) -> float:
        """How far a place (2,) is from the nearest signalled junction, metres."""
        nodes = [node.getCoord() for node in self.net.getNodes() if node.getType() == "traffic_light"]
        return min((float(np.hypot(*(place - node))) for node in nodes), default=np.inf)


def _carriageway(net: Any) -> Region:
    parts = [Polygon(node.getShape()) for node in net.getNodes() if len(node.getShape()) > 2]
    for edge in net.getEdges(withInternal=False):
        parts += [LineString(lane.getShape()).buffer(lane.getWidth() / 2, cap_style="flat") for lane in edge.getLanes()]
    # Closing by a hand's breadth heals the slits between lanes and junctions.
    return unary_union(parts).buffer(0.2).buffer(-0.2).simplify(0.02)


def _sightlines(site: Site, road: Region, reach: float) -> Region:
    eye = np.array(site.position[:2])
    angles = np.radians(site.yaw_deg + np.linspace(-HALF_VIEW_DEG, HALF_VIEW_DEG, 17))
    view = Polygon([eye, *(eye + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1))])
    fans = []
    for part in polygons(road.intersection(view)):
        ring = np.array(part.exterior.coords)
        fans += [Polygon([eye, a, b]) for a, b in itertools.pairwise(ring)]
    return unary_union([fan for fan in fans if fan.area > 1e-6])


def polygons(shape: Any) -> list[Polygon]:
    """The polygons of a shape, without slivers."""
    parts = getattr(shape, "geoms", [shape])
    return [part for part in parts if isinstance(part, Polygon) and part.area > 1e-4]


def rectangle(center: Array, heading: float, length: float, depth: float) -> Polygon:
    c, s = np.cos(heading), np.sin(heading)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, depth / 2]
    return Polygon(corners @ np.array([[c, s], [-s, c]]) + center)


def beside(edge: Any, s: float, offset: float) -> tuple[Array, float]:
    """The place (2,) `s` metres along an edge and `offset` to the right of its kerb, and the heading there."""
    lane = edge.getLanes()[0]
    line = LineString(lane.getShape())
    s = float(np.clip(s, 0.0, line.length - 0.5))
    a, b = (np.array(line.interpolate(t).coords[0]) for t in (s, s + 0.5))
    heading = float(np.arctan2(*(b - a)[::-1]))
    return a + right_of(heading) * (lane.getWidth() / 2 + offset), heading


def right_of(heading: float) -> Array:
    return np.array([np.sin(heading), -np.cos(heading)])


def along(layout: Layout, spacing: float, offset: float) -> Iterator[tuple[Any, Array, float]]:
    """Every `spacing` metres of every edge: the edge, a place (2,) right of the kerb, the heading there."""
    for edge in layout.edges:
        for s in np.arange(spacing / 2, edge.getLanes()[0].getLength(), spacing):
            yield edge, *beside(edge, float(s), offset)


def free(region: Any, place: Array, distance: float = 0.0) -> bool:
    """Whether a place (2,) is outside a prepared region and at least `distance` metres from it."""
    point = Point(place)
    return not shapely.intersects(region, point) and (distance <= 0 or shapely.distance(region, point) >= distance)
