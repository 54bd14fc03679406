"""The roads of a town in its SUMO network: edges, junctions, lanes, and the carriageway that they form.

For left-hand traffic, the network is mirrored (y becomes -y) to one for right-hand traffic, and the scenery is built
for that. Code for roadside objects, signals, markings and sidewalks therefore handles one side only.
`RoadGraph.mirrored` marks results that have to be mirrored back.
"""

import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
import shapely
import sumolib
from numpy.typing import ArrayLike
from shapely import LineString, Point, Polygon
from shapely.ops import unary_union

from skope.camera.model import Camera
from skope.gen.towns.regions import Region, polygons
from skope.gen.towns.terrain import Lanes
from skope.gen.towns.town import Town
from skope.gen.towns.town_style import Road, style
from skope.types import Array

_MIRRORED_TURNS: Final = {"l": "r", "r": "l", "L": "R", "R": "L"}
_NET_TAG: Final = re.compile(rb"<net\b[^>]*>")


def is_lefthand(network: bytes) -> bool:
    """Return whether a SUMO network is one with left-hand traffic, by the attribute of its root."""
    root = _NET_TAG.search(network)
    return root is not None and re.search(rb'\blefthand="(true|1)"', root[0]) is not None


def mirrored_town(network: bytes) -> bytes:
    """Return the mirrored network: shapes are reflected, and right turns become left turns and vice versa."""
    root = ElementTree.fromstring(network)
    root.attrib.pop("lefthand", None)
    for element in root.iter():
        if "shape" in element.attrib:
            element.set("shape", " ".join(map(_reflected, element.attrib["shape"].split())))
        if element.tag == "junction" and "y" in element.attrib:
            element.set("y", _negative(element.attrib["y"]))
        if element.tag == "connection" and "dir" in element.attrib:
            element.set("dir", _MIRRORED_TURNS.get(element.attrib["dir"], element.attrib["dir"]))
        if element.tag == "location":
            x0, y0, x1, y1 = element.attrib["convBoundary"].split(",")
            element.set("convBoundary", ",".join((x0, _negative(y1), x1, _negative(y0))))
    return ElementTree.tostring(root)


def _reflected(point: str) -> str:
    x, y, *z = point.split(",")
    return ",".join((x, _negative(y), *z))


def _negative(number: str) -> str:
    return number[1:] if number.startswith("-") else f"-{number}"


@dataclass(frozen=True)
class RoadLimits:
    """Distances within which roads are considered."""

    own_roads_within_m: float = 600.0
    """Maximum distance from the camera of roads in a user's own network, metres; roads farther away are ignored."""
    barrier_m: float = 1.5
    """Half width below which a median between retaining walls holds only a barrier, metres."""
    height_within_m: float = 42.0
    """Distance within which lanes determine the height of the road at a position, metres."""


ROAD_LIMITS: Final = RoadLimits()


@dataclass(frozen=True, eq=False)
class RoadGraph:
    """Roads of a town: edges and junctions of its SUMO network, their lanes, and the carriageway that they form.

    In a town with left-hand traffic, all of them are those of its mirror image (see `mirrored_town`).
    """

    net: Any
    """Network, as sumolib reads it."""
    edges: tuple[Any, ...]
    """Edges with vehicles; in a user's own network, only those near the camera (`ROAD_LIMITS.own_roads_within_m`)."""
    kinds: Mapping[str, Road]
    """Features of the roads, by SUMO edge type."""
    mirrored: bool
    """Whether positions are those of the mirror image; `world` mirrors them back."""

    @classmethod
    def of(cls, town: Town) -> "RoadGraph":
        """Read a town's network."""
        network = town.network
        if is_mirrored := is_lefthand(network.read_bytes()):
            with tempfile.TemporaryDirectory() as folder:
                image = Path(folder) / network.name
                image.write_bytes(mirrored_town(network.read_bytes()))
                net = _read_net(image)
        else:
            net = _read_net(network)
        look = style(town)
        kinds = {name: look.roads.get(name, look.road) for name in {edge.getType() for edge in net.getEdges()}}
        edges = [edge for edge in net.getEdges(withInternal=False) if not edge.isSpecial() and driven(edge)]
        if town.road:
            near = Point(_reflect(town.road.camera.position[:2], is_mirrored)).buffer(ROAD_LIMITS.own_roads_within_m)
            edges = [e for e in edges if any(LineString(lane.getShape()).intersects(near) for lane in driven(e))]
        return cls(net, tuple(edges), kinds, is_mirrored)

    def world(self, places: ArrayLike) -> Array:
        """Convert positions or directions (..., 2 or 3) from the graph to the world, or from the world to the graph."""
        return _reflect(places, self.mirrored)

    # --------------------------------------------------------------------------------------------- edges and junctions

    def kind(self, edge: Any) -> Road:
        """Return the features of an edge's road, by its SUMO type."""
        return self.kinds[edge.getType()]

    def edges_of(self, form: str) -> list[Any]:
        """Return the edges with roads of a form: on the "ground", "walled", or on a "bridge"."""
        return [edge for edge in self.edges if self.kind(edge).form == form]

    @cached_property
    def _ground_nodes(self) -> list[Any]:
        """Return the nodes that are not on a deck."""
        near = set(self.edges)
        return [
            node
            for node in self.net.getNodes()
            if any(self.kind(edge).form != "bridge" and edge in near for edge in edges_at(node))
        ]

    def signal_distance(self, position: Array) -> float:
        """Return the distance of a position (2,) from the nearest signalled junction, metres."""
        nodes = [node.getCoord() for node in self.net.getNodes() if node.getType() == "traffic_light"]
        return min((float(np.hypot(*(position - node))) for node in nodes), default=np.inf)

    # ----------------------------------------------------------------------------------------------------- carriageway

    @cached_property
    def ground_road(self) -> Region:
        """Carriageway on the ground."""
        edges = [edge for edge in self.edges if self.kind(edge).form != "bridge"]
        whole = _carriageway(edges, self._ground_nodes)
        # Between retaining walls the median is part of the carriageway.
        walled = _carriageway(self.edges_of("walled"), [])
        return (
            unary_union([whole, walled.buffer(ROAD_LIMITS.barrier_m).buffer(-ROAD_LIMITS.barrier_m)])
            if not walled.is_empty
            else whole
        )

    @cached_property
    def walled_road(self) -> Region:
        """Part of the carriageway on the ground that is between retaining walls."""
        return (
            _carriageway(self.edges_of("walled"), [])
            .buffer(ROAD_LIMITS.barrier_m)
            .buffer(-ROAD_LIMITS.barrier_m)
            .intersection(self.ground_road)
        )

    @cached_property
    def decks(self) -> list[Region]:
        """Carriageways of bridges."""
        return polygons(_carriageway(self.edges_of("bridge"), []))

    @cached_property
    def road(self) -> Region:
        """All carriageways, seen from above."""
        return unary_union([self.ground_road, *self.decks])

    # ----------------------------------------------------------------------------------------------------------- lanes

    def ground_lanes(self, *forms: str) -> Iterator[tuple[Any, float]]:
        """Yield the lanes of all roads of the given forms, and of all junctions on the ground, as `Lanes` takes them.

        Yields:
            A lane of sumolib, and the width of the strip beside it at the lane's height, metres.
        """
        for edge in self.edges:
            if self.kind(edge).form in forms:
                yield from ((lane, self.kind(edge).verge) for lane in driven(edge))
        for node in self._ground_nodes:
            verge = max((self.kind(edge).verge for edge in edges_at(node)), default=0.0)
            inner = (self.net.getLane(name) for name in node.getInternal() if name)
            yield from ((lane, verge) for lane in inner if lane.allows("passenger"))

    @cached_property
    def deck_lanes(self) -> Lanes:
        """Lanes on bridges."""
        return Lanes((lane, 0.0) for edge in self.edges_of("bridge") for lane in driven(edge))

    def road_level(self, center: ArrayLike) -> float:
        """Return the median height of the carriageway around a position (2,) in the world, metres."""
        points = Lanes((lane, 0.0) for edge in self.edges for lane in driven(edge)).points
        away = np.hypot(*(points[:, :2] - self.world(center)).T)
        return float(np.median(points[away <= max(ROAD_LIMITS.height_within_m, away.min()), 2]))

    @cached_property
    def lane_points(self) -> Mapping[str, Array]:
        """World positions (N, 3) on the lanes of each edge, about one per metre, by the edge's name."""
        out = {}
        for edge in self.edges:
            lines = [LineString(lane.getShape3D()) for lane in driven(edge)]
            points = np.concatenate([shapely.segmentize(line, 1.0).coords for line in lines])
            out[str(edge.getID())] = self.world(points)
        return out

    def seen_by(self, camera: Camera, reach: float) -> frozenset[str]:
        """Return the names of the edges with lanes in a camera's image within `reach` metres."""
        out = set()
        for name, points in self.lane_points.items():
            pixels, depth, valid = camera.project(points)
            if (valid & camera.inside(pixels) & (depth < reach)).any():
                out.add(name)
        return frozenset(out)


def _read_net(path: Path) -> Any:
    return sumolib.net.readNet(str(path), withInternal=True)


def _reflect(places: ArrayLike, mirrored: bool) -> Array:
    """Return positions or directions (..., 2 or 3), with y negated if they are mirrored."""
    out = np.array(places, dtype=np.float64)
    if mirrored:
        out[..., 1] *= -1
    return out


def _carriageway(edges: Sequence[Any], nodes: Sequence[Any]) -> Region:
    """Return the area that the lanes of edges and the junctions at nodes cover."""
    parts = [Polygon(node.getShape()) for node in nodes if len(node.getShape()) > 2]
    for edge in edges:
        parts += [LineString(lane.getShape()).buffer(lane.getWidth() / 2, cap_style="flat") for lane in driven(edge)]
    # Buffering outwards and inwards by some centimetres closes the gaps between lanes and junctions.
    return unary_union(parts).buffer(0.2).buffer(-0.2).simplify(0.02)


# --------------------------------------------------------------------------------------------------- edges of sumolib


def driven(edge: Any) -> list[Any]:
    """Return an edge's lanes that cars may use, from right to left."""
    return [lane for lane in edge.getLanes() if lane.allows("passenger")]


def edges_at(node: Any) -> list[Any]:
    """Return the edges that begin or end at a node."""
    return [e for e in (*node.getIncoming(), *node.getOutgoing()) if not e.isSpecial() and driven(e)]


def joins(edge: Any) -> int:
    """Return the number of edges that end at the same node."""
    return sum(connected.getToNode() is edge.getToNode() for connected in edges_at(edge.getToNode()))


def is_minor(edge: Any) -> bool:
    """Return whether an edge's traffic gives way at its end."""
    connections = driven(edge)[0].getOutgoing()
    # Vehicles that turn left from a main road also give way.
    return bool(connections) and all(connection.getState() in ("m", "s", "w") for connection in connections)


def is_signalled(edge: Any) -> bool:
    """Return whether an edge ends at a junction with traffic lights."""
    return bool(edge.getToNode().getType() == "traffic_light")


def half_width(edge: Any) -> float:
    """Return half of the total width of an edge's lanes, metres."""
    return float(sum(lane.getWidth() for lane in driven(edge)) / 2)


def beside(edge: Any, s: float, offset: float) -> tuple[Array, float]:
    """Return the position (2,) `s` m along an edge and `offset` m right of its kerb, and the heading (radians)."""
    lane = driven(edge)[0]
    line = _line_of(lane)
    s = float(np.clip(s, 0.0, line.length - 0.5))
    a, b = (np.array(line.interpolate(t).coords[0]) for t in (s, s + 0.5))
    heading = float(np.arctan2(*(b - a)[::-1]))
    return a + right_of(heading) * (lane.getWidth() / 2 + offset), heading


@lru_cache(maxsize=4096)
def _line_of(lane: Any) -> LineString:
    """Return the centre line of a lane."""
    return LineString(lane.getShape())


def places_along(edges: Sequence[Any], spacing: float, offset: float) -> Iterator[tuple[Any, Array, float]]:
    """Yield positions every `spacing` metres along edges and `offset` metres to the right of their kerbs.

    Yields:
        The edge, the position (2,) and the heading there (radians).
    """
    for edge in edges:
        for s in np.arange(spacing / 2, driven(edge)[0].getLength(), spacing):
            yield edge, *beside(edge, float(s), offset)


def right_of(heading: float) -> Array:
    """Return the unit vector (2,) to the right of a heading (radians)."""
    return np.array([np.sin(heading), -np.cos(heading)])
