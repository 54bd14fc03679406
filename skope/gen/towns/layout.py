"""Layout of a town: the carriageway, the areas beside it, and what its cameras must see."""

import itertools
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import shapely
import sumolib
from numpy.typing import ArrayLike
from shapely import LineString, MultiPolygon, Point, Polygon
from shapely.ops import unary_union

from skope.camera import Camera
from skope.gen.mesh import Mesh
from skope.gen.towns.left_hand_traffic import is_lefthand, mirrored
from skope.gen.towns.sites import Site, sites_of
from skope.gen.towns.style import Road, TownStyle, style
from skope.gen.towns.terrain import GroundSurface, Lanes
from skope.gen.towns.town import Town
from skope.types import Array

Region: TypeAlias = Polygon | MultiPolygon

GRID: Final = 1e-4
"""Grid that polygons' corners are rounded to, metres, so that parts cut out of each other keep common corners."""
KERB_WIDTH: Final = 0.15
CAMERA_CLEARANCE: Final = 8.0
"""Radius around a camera in which nothing stands higher than 1 m, metres."""
NEAR: Final = 42.0
"""Objects nearer to a camera than this are built in full detail, metres."""
FAR: Final = 120.0
"""Objects farther from all cameras than this are built plainly, without small parts, metres."""
HALF_VIEW_DEG: Final = 56.0
BARRIER: Final = 1.5
"""Half the width, metres, below which a median between retaining walls holds a barrier only."""
ISLAND: Final = 20.0
"""Ground within the carriageway counts as a median or island if it is nowhere farther from it than this, metres."""
REACH: Final = 600.0
"""Roads of a user's own network get scenery if they are nearer to the camera than this, metres."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A town's network with the regions that scenery is fitted into."""

    town: Town
    net: Any
    style: TownStyle
    sites: tuple[Site, ...]
    mirrored: bool = False
    """Whether all this is seen in the mirror of left-hand traffic (see `lefthand`)."""

    @classmethod
    def of(cls, town: Town) -> "Layout":
        """Read a town's network and style.

        The layout of a town with left-hand traffic is that of its mirror image; `world` takes places back.
        """
        path, cameras = town.network, sites_of(town)
        if not is_lefthand(path.read_bytes()):
            return cls(town, _read(path), style(town), cameras)
        with tempfile.TemporaryDirectory() as folder:
            seen = Path(folder) / path.name
            seen.write_bytes(mirrored(path.read_bytes()))
            return cls(town, _read(seen), style(town), tuple(map(_mirrored_site, cameras)), mirrored=True)

    def world(self, places: ArrayLike) -> Array:
        """Places (..., 2 or 3) or directions of the layout in the world, or the other way round."""
        out = np.array(places, dtype=np.float64)
        if self.mirrored:
            out[..., 1] *= -1
        return out

    # ------------------------------------------------------------------------------------------------------- network

    @cached_property
    def edges(self) -> list[Any]:
        """Edges that vehicles drive on."""
        edges = [edge for edge in self.net.getEdges(withInternal=False) if not edge.isSpecial() and driven(edge)]
        if self.town.road is None:
            return edges
        around = unary_union([Point(site.position[:2]).buffer(REACH) for site in self.sites])
        return [edge for edge in edges if any(LineString(lane.getShape()).intersects(around) for lane in driven(edge))]

    def kind(self, edge: Any) -> Road:
        """The features of an edge's road, by its SUMO type."""
        return self.style.roads.get(edge.getType(), self.style.road)

    def edges_of(self, form: str) -> list[Any]:
        return [edge for edge in self.edges if self.kind(edge).form == form]

    @cached_property
    def _ground_nodes(self) -> list[Any]:
        """Nodes that are not on a deck."""
        near = set(self.edges)
        return [
            node
            for node in self.net.getNodes()
            if any(self.kind(edge).form != "bridge" and edge in near for edge in legs(node))
        ]

    # ------------------------------------------------------------------------------------------------------- regions

    @cached_property
    def ground_road(self) -> Region:
        """The carriageway that lies on the ground."""
        edges = [edge for edge in self.edges if self.kind(edge).form != "bridge"]
        whole = _carriageway(edges, self._ground_nodes)
        # Between retaining walls the median belongs to the carriageway.
        walled = _carriageway(self.edges_of("walled"), [])
        return unary_union([whole, walled.buffer(BARRIER).buffer(-BARRIER)]) if not walled.is_empty else whole

    @cached_property
    def walled_road(self) -> Region:
        """The part of it between retaining walls."""
        return _carriageway(self.edges_of("walled"), []).buffer(BARRIER).buffer(-BARRIER).intersection(self.ground_road)

    @cached_property
    def decks(self) -> list[Region]:
        """Carriageways of bridges."""
        return polygons(_carriageway(self.edges_of("bridge"), []))

    @cached_property
    def deck_edge(self) -> float:
        """Width of decks beside their lanes, metres."""
        return max([self.kind(edge).sidewalk for edge in self.edges_of("bridge")], default=0.0) + 0.45

    @property
    def under_decks(self) -> list[Any]:
        """Bridges' shadows on the ground, which are paved."""
        return [deck.buffer(2.0, cap_style="square") for deck in self.decks]

    @cached_property
    def road(self) -> Region:
        """Everything that is driven on, from above."""
        return unary_union([self.ground_road, *self.decks])

    @cached_property
    def islands(self) -> Region:
        """Medians and islands."""
        return self.enclosed(ISLAND).difference(self.road)

    def enclosed(self, reach: float) -> Region:
        """Ground within the carriageway that is nowhere farther than `reach` metres from it."""
        # Decks only touch what they lead to.
        closed = self.road.buffer(0.1, join_style="mitre").buffer(-0.1, join_style="mitre")
        holes = [Polygon(hole) for part in polygons(closed) for hole in part.interiors]
        return unary_union([hole for hole in holes if hole.buffer(-reach).is_empty])

    def beside_lanes(self, width: str) -> Region:
        """The strips beside the carriageway that are as wide as the road's `width` ("sidewalk" or "shoulder")."""
        parts = []
        for edge in self.edges:
            if (own := getattr(self.kind(edge), width)) and self.kind(edge).form == "ground":
                beyond = own + (KERB_WIDTH if self.style.kerb else 0.0)
                for lane in driven(edge):
                    line = LineString(lane.getShape())
                    parts.append(line.buffer(lane.getWidth() / 2 + beyond, cap_style="flat"))
                ends = [node.getShape() for node in (edge.getFromNode(), edge.getToNode())]
                parts += [Polygon(shape).buffer(beyond) for shape in ends if len(shape) > 2]
        return unary_union(parts).difference(self.islands) if parts else Polygon()

    @cached_property
    def sidewalk(self) -> Region:
        return self.beside_lanes("sidewalk")

    @cached_property
    def detailed(self) -> Region:
        """Area near enough to a camera that small things can be made out."""
        return unary_union([Point(site.position[:2]).buffer(FAR, quad_segs=4) for site in self.sites])

    @cached_property
    def around_cameras(self) -> Region:
        return unary_union([Point(site.position[:2]).buffer(CAMERA_CLEARANCE) for site in self.sites])

    def camera_distance(self, place: Array) -> float:
        """How far a place (2,) is from the nearest camera, metres."""
        return min((float(np.hypot(*(place - site.position[:2]))) for site in self.sites), default=np.inf)

    def sightlines(self, reach: float) -> Region:
        """What lies between the cameras and the carriageway that they see within `reach` metres."""
        return unary_union([self.around_cameras, *(_sightlines(site, self.road, reach) for site in self.sites)])

    def centre_distance(self, place: Array) -> float:
        """How far a place (2,) is from the nearest signalled junction, metres."""
        nodes = [node.getCoord() for node in self.net.getNodes() if node.getType() == "traffic_light"]
        return min((float(np.hypot(*(place - node))) for node in nodes), default=np.inf)

    # ------------------------------------------------------------------------------------------------------- heights

    @cached_property
    def ground(self) -> GroundSurface:
        def lanes(*forms: str) -> Iterator[tuple[Any, float]]:
            for edge in self.edges:
                if self.kind(edge).form in forms:
                    yield from ((lane, self.kind(edge).verge) for lane in driven(edge))
            for node in self._ground_nodes:
                verge = max((self.kind(edge).verge for edge in legs(node)), default=0.0)
                inner = (self.net.getLane(name) for name in node.getInternal() if name)
                yield from ((lane, verge) for lane in inner if lane.allows("passenger"))

        return GroundSurface(self.style.terrain, Lanes(lanes("ground", "walled")), Lanes(lanes("ground")))

    @cached_property
    def deck_lanes(self) -> Lanes:
        return Lanes((lane, 0.0) for edge in self.edges_of("bridge") for lane in driven(edge))

    def road_below(self, site: Site) -> float:
        """Height of the carriageway that a camera looks at, 12 to 45 m before it: that of most places, metres."""
        angle = np.radians(site.yaw_deg + np.linspace(-25.0, 25.0, 11))
        rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        places = (np.array(site.position[:2]) + np.arange(12.0, 45.0, 3.0)[:, None, None] * rays).reshape(-1, 2)
        seen = places[shapely.contains_xy(self.ground_road, places)]
        return float(np.median(self.ground.road(seen)))

    @cached_property
    def lane_points(self) -> Mapping[str, Array]:
        """(N, 3) places of the world on the lanes of each edge, one at about every metre."""
        out = {}
        for edge in self.edges:
            if lines := [LineString(lane.getShape3D()) for lane in driven(edge)]:
                points = np.concatenate([shapely.segmentize(line, 1.0).coords for line in lines])
                out[str(edge.getID())] = self.world(points)
        return out

    def seen_by(self, camera: Camera, reach: float) -> frozenset[str]:
        """Names of the edges whose lanes a camera has in its image, nearer than `reach` metres."""
        out = set()
        for name, points in self.lane_points.items():
            pixels, depth, valid = camera.project(points)
            if (valid & camera.inside(pixels) & (depth < reach)).any():
                out.add(name)
        return frozenset(out)

    def road_level(self, center: ArrayLike) -> float:
        """Height of the carriageway around a place (2,) of the world: that of most lanes' points there, metres."""
        points = Lanes((lane, 0.0) for edge in self.edges for lane in driven(edge)).points
        away = np.hypot(*(points[:, :2] - self.world(center)).T)
        return float(np.median(points[away <= max(NEAR, away.min()), 2]))

    def height(self, place: ArrayLike) -> float:
        """Height of the ground or sidewalk at a place (2,) beside the carriageway, metres."""
        return float(self.ground.beside(np.asarray(place, dtype=np.float64)[None])[0]) + self.style.kerb

    def on_ground(self, place: ArrayLike) -> tuple[float, float, float]:
        x, y = np.asarray(place, dtype=np.float64)
        return float(x), float(y), self.height((x, y))

    def draped(self, mesh: Mesh) -> Mesh:
        """A mesh, made as if the ground were at height 0, that follows the ground under each of its vertices."""
        z = self.ground.beside(mesh.vertices[:, :2]) + self.style.kerb
        return Mesh(
            mesh.vertices + np.column_stack([np.zeros((len(z), 2)), z]),
            mesh.normals,
            mesh.triangles,
            mesh.materials,
            mesh.material,
        )


def _read(path: Path) -> Any:
    return sumolib.net.readNet(str(path), withInternal=True)


def _mirrored_site(site: Site) -> Site:
    x, y, z = site.position
    return replace(site, position=(x, -y, z), yaw_deg=-site.yaw_deg)


def driven(edge: Any) -> list[Any]:
    """An edge's lanes that cars may drive on, from right to left."""
    return [lane for lane in edge.getLanes() if lane.allows("passenger")]


def legs(node: Any) -> list[Any]:
    """The edges that begin or end at a node."""
    return [e for e in (*node.getIncoming(), *node.getOutgoing()) if not e.isSpecial() and driven(e)]


def joins(edge: Any) -> int:
    """How many edges end where this one does."""
    return sum(leg.getToNode() is edge.getToNode() for leg in legs(edge.getToNode()))


def is_minor(edge: Any) -> bool:
    """Whether an edge's traffic gives way where it ends."""
    connections = driven(edge)[0].getOutgoing()
    # Vehicles that turn left from a main road give way too.
    return bool(connections) and all(connection.getState() in ("m", "s", "w") for connection in connections)


def is_signalled(edge: Any) -> bool:
    return bool(edge.getToNode().getType() == "traffic_light")


def _carriageway(edges: Sequence[Any], nodes: Sequence[Any]) -> Region:
    parts = [Polygon(node.getShape()) for node in nodes if len(node.getShape()) > 2]
    for edge in edges:
        parts += [LineString(lane.getShape()).buffer(lane.getWidth() / 2, cap_style="flat") for lane in driven(edge)]
    # Growing and shrinking by some centimetres closes the slits between lanes and junctions.
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
    lane = driven(edge)[0]
    line = LineString(lane.getShape())
    s = float(np.clip(s, 0.0, line.length - 0.5))
    a, b = (np.array(line.interpolate(t).coords[0]) for t in (s, s + 0.5))
    heading = float(np.arctan2(*(b - a)[::-1]))
    return a + right_of(heading) * (lane.getWidth() / 2 + offset), heading


def half_width(edge: Any) -> float:
    """Half of the width of an edge's lanes together, metres."""
    return float(sum(lane.getWidth() for lane in driven(edge)) / 2)


def right_of(heading: float) -> Array:
    return np.array([np.sin(heading), -np.cos(heading)])


def along(edges: Sequence[Any], spacing: float, offset: float) -> Iterator[tuple[Any, Array, float]]:
    """Every `spacing` metres of every edge: the edge, a place (2,) right of the kerb, the heading there."""
    for edge in edges:
        for s in np.arange(spacing / 2, driven(edge)[0].getLength(), spacing):
            yield edge, *beside(edge, float(s), offset)


def free(region: Any, place: Array, distance: float = 0.0) -> bool:
    """Whether a place (2,) is outside a prepared region and at least `distance` metres from it."""
    point = Point(place)
    return not shapely.intersects(region, point) and (distance <= 0 or shapely.distance(region, point) >= distance)
