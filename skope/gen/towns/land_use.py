"""Land use of a town: areas beside its roads, ground heights, areas that cameras must see, sidewalks and parking bays.

Parking bays are in car parks, on drives beside houses and along kerbs.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely import LineString, Point, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh
from skope.gen.towns.regions import Region, polygons, rectangle_polygon
from skope.gen.towns.road_graph import RoadGraph, beside, driven
from skope.gen.towns.sites import Site, sites_of
from skope.gen.towns.terrain import GroundSurface, Lanes
from skope.gen.towns.town import Town
from skope.gen.towns.town_style import TownStyle, style
from skope.types import Array


@dataclass(frozen=True)
class LandUseSizes:
    """Dimensions of kerbs, bays and islands, and distances from cameras."""

    kerb_m: float = 0.15
    """Width of kerbs, metres."""
    island_m: float = 20.0
    """Maximum distance from the carriageway of ground enclosed by it that counts as a median or island, metres."""
    camera_clearance_m: float = 8.0
    """Radius around a camera without objects higher than 1 m, metres."""
    detailed_within_m: float = 42.0
    """Distance from a camera within which objects are built in full detail, metres."""
    plain_from_m: float = 120.0
    """Distance from all cameras beyond which objects are built without small parts, metres."""
    half_view_deg: float = 56.0
    """Half of the assumed horizontal field of view of cameras, degrees."""
    shortest_walk_m: float = 20.0
    """Minimum length of a sidewalk with pedestrians, metres."""
    walk_spacing_m: float = 5.0
    """Spacing of the points at which the height of a path is computed, metres."""
    bay_m: tuple[float, float] = (4.8, 2.6)
    """Length and width of a bay, metres."""
    aisle_m: float = 6.8
    """Width of an aisle, metres."""
    drive_m: float = 2.4
    """Width of a drive, metres."""
    lot_edge_m: float = 1.0
    """Distance from the edge of a car park to its bays, metres."""
    kerbside_m: tuple[float, float] = (6.0, 2.1)
    """Length and width of a bay along a kerb, metres."""
    kerbside_share: float = 0.55
    """Fraction of the streets with wide enough sidewalks that have bays along their kerbs."""
    kerbside_walk_m: float = 2.2
    """Minimum width of a sidewalk with bays, metres."""
    junction_distances_m: tuple[float, float] = (12.0, 20.0)
    """Minimum distance of bays from the start and the end of a street, metres."""
    free_share: float = 0.15
    """Fraction of the positions along a kerb that have no bay."""


LAND_USE: Final = LandUseSizes()


@dataclass(frozen=True, eq=False)
class Layout:
    """Regions and heights that a town's scenery is fitted into.

    All positions are those of the graph: in a town with left-hand traffic, those of its mirror image.
    """

    graph: RoadGraph
    style: TownStyle
    sites: tuple[Site, ...]
    """Cameras that must have a clear view."""

    @classmethod
    def of(cls, town: Town) -> "Layout":
        """Read a town's network and style."""
        graph, sites = RoadGraph.of(town), sites_of(town)
        return cls(graph, style(town), tuple(map(_mirrored_site, sites)) if graph.mirrored else sites)

    # --------------------------------------------------------------------------------------------- beside the roads

    @cached_property
    def deck_edge(self) -> float:
        """Width of a deck beside its lanes, metres."""
        return max([self.graph.kind(edge).sidewalk for edge in self.graph.edges_of("bridge")], default=0.0) + 0.45

    @property
    def under_decks(self) -> list[Any]:
        """Areas under bridges, which are paved."""
        return [deck.buffer(2.0, cap_style="square") for deck in self.graph.decks]

    @cached_property
    def islands(self) -> Region:
        """Medians and islands."""
        return self.enclosed(LAND_USE.island_m).difference(self.graph.road)

    def enclosed(self, reach: float) -> Region:
        """Return the ground enclosed by the carriageway that is nowhere farther than `reach` metres from it."""
        # Decks only touch the roads that they lead to.
        closed = self.graph.road.buffer(0.1, join_style="mitre").buffer(-0.1, join_style="mitre")
        holes = [Polygon(hole) for part in polygons(closed) for hole in part.interiors]
        return unary_union([hole for hole in holes if hole.buffer(-reach).is_empty])

    def beside_lanes(self, width: str) -> Region:
        """Return the strips beside the carriageway as wide as the road's `width` ("sidewalk" or "shoulder")."""
        parts = []
        for edge in self.graph.edges:
            kind = self.graph.kind(edge)
            if (strip := getattr(kind, width)) and kind.form == "ground":
                beyond = strip + (LAND_USE.kerb_m if self.style.kerb else 0.0)
                for lane in driven(edge):
                    line = LineString(lane.getShape())
                    parts.append(line.buffer(lane.getWidth() / 2 + beyond, cap_style="flat"))
                ends = [node.getShape() for node in (edge.getFromNode(), edge.getToNode())]
                parts += [Polygon(shape).buffer(beyond) for shape in ends if len(shape) > 2]
        return unary_union(parts).difference(self.islands) if parts else Polygon()

    @cached_property
    def sidewalk(self) -> Region:
        """Sidewalks of all roads on the ground."""
        return self.beside_lanes("sidewalk")

    # --------------------------------------------------------------------------------------------------------- cameras

    @cached_property
    def detailed(self) -> Region:
        """Area near enough to a camera for small objects to be visible."""
        return unary_union([Point(site.position[:2]).buffer(LAND_USE.plain_from_m, quad_segs=4) for site in self.sites])

    @cached_property
    def around_cameras(self) -> Region:
        """Area around the cameras without high objects."""
        return unary_union([Point(site.position[:2]).buffer(LAND_USE.camera_clearance_m) for site in self.sites])

    def camera_distance(self, position: Array) -> float:
        """Return the distance of a position (2,) from the nearest camera, metres."""
        return min((float(np.hypot(*(position - site.position[:2]))) for site in self.sites), default=np.inf)

    def sightlines(self, reach: float) -> Region:
        """Return the region between the cameras and the carriageway that they see within `reach` metres."""
        return unary_union([self.around_cameras, *(_sightlines(site, self.graph.road, reach) for site in self.sites)])

    def road_below(self, site: Site) -> float:
        """Return the median height of the carriageway 12 to 45 m in front of a camera, metres."""
        angle = np.radians(site.yaw_deg + np.linspace(-25.0, 25.0, 11))
        rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        places = (np.array(site.position[:2]) + np.arange(12.0, 45.0, 3.0)[:, None, None] * rays).reshape(-1, 2)
        seen = places[shapely.contains_xy(self.graph.ground_road, places)]
        return float(np.median(self.ground.road(seen)))

    # ---------------------------------------------------------------------------------------------------------- ground

    @cached_property
    def ground(self) -> GroundSurface:
        """Ground surface, including the carriageways on it."""
        driven_on, shaping = self.graph.ground_lanes("ground", "walled"), self.graph.ground_lanes("ground")
        return GroundSurface(self.style.terrain, Lanes(driven_on), Lanes(shaping))

    def height(self, position: ArrayLike) -> float:
        """Return the height of the ground or sidewalk at a position (2,) beside the carriageway, metres."""
        return float(self.ground.beside(np.asarray(position, dtype=np.float64)[None])[0]) + self.style.kerb

    def on_ground(self, position: ArrayLike) -> tuple[float, float, float]:
        """Return a position (2,) beside the carriageway with the height of the ground or sidewalk there, metres."""
        x, y = np.asarray(position, dtype=np.float64)
        return float(x), float(y), self.height((x, y))

    def draped(self, mesh: Mesh) -> Mesh:
        """Return a mesh, built for ground at height 0, with each vertex moved by the height of the ground below it."""
        z = self.ground.beside(mesh.vertices[:, :2]) + self.style.kerb
        return Mesh(
            mesh.vertices + np.column_stack([np.zeros((len(z), 2)), z]),
            mesh.normals,
            mesh.triangles,
            mesh.materials,
            mesh.material,
        )


def _mirrored_site(site: Site) -> Site:
    x, y, z = site.position
    return replace(site, position=(x, -y, z), yaw_deg=-site.yaw_deg)


def _sightlines(site: Site, road: Region, reach: float) -> Region:
    """Return the ground between a camera and the road that it sees within `reach` metres."""
    eye = np.array(site.position[:2])
    angles = np.radians(site.yaw_deg + np.linspace(-LAND_USE.half_view_deg, LAND_USE.half_view_deg, 17))
    view = Polygon([eye, *(eye + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1))])
    fans = []
    for part in polygons(road.intersection(view)):
        ring = np.array(part.exterior.coords)
        fans += [Polygon([eye, a, b]) for a, b in itertools.pairwise(ring)]
    return unary_union([fan for fan in fans if fan.area > 1e-6])


def sidewalks(town: Town, center: tuple[float, float], reach: float) -> list[Array]:
    """Return the centre lines (N, 3) of the sidewalks within `reach` metres of a position."""
    layout = Layout.of(town)
    graph = layout.graph
    around = Point(graph.world(center)).buffer(reach)
    out = []
    widths = sorted({graph.kind(edge).sidewalk for edge in graph.edges} - {0.0})
    for width in widths:
        edges = [edge for edge in graph.edges if graph.kind(edge).sidewalk == width]
        beyond = LAND_USE.kerb_m + width / 2
        strips = [
            LineString(lane.getShape()).buffer(lane.getWidth() / 2 + LAND_USE.kerb_m + width, cap_style="flat")
            for edge in edges
            if graph.kind(edge).form == "ground"
            for lane in driven(edge)
        ]
        area = unary_union(strips).buffer(width).intersection(layout.sidewalk).intersection(around)
        middle = shapely.line_merge(graph.road.buffer(beyond).boundary.intersection(area))
        out += [
            graph.world(_walk_path(layout, line))
            for line in _walk_lines(middle)
            if line.length > LAND_USE.shortest_walk_m
        ]
    return out


def _walk_lines(shape: shapely.Geometry) -> list[LineString]:
    parts = getattr(shape, "geoms", [shape])
    return [part for part in parts if isinstance(part, LineString)]


def _walk_path(layout: Layout, line: LineString) -> Array:
    marks = np.linspace(0, line.length, max(2, round(line.length / LAND_USE.walk_spacing_m)))
    xs = np.union1d(marks, [line.project(Point(point)) for point in line.coords])
    positions = np.array([line.interpolate(x).coords[0] for x in xs])
    return np.array([layout.on_ground(position) for position in positions])


@dataclass(frozen=True)
class Bay:
    """Parking bay for one car."""

    position: tuple[float, float]
    """World x and y of its middle, metres."""
    heading: float
    """Direction in which a car drives into the bay, counter-clockwise from east, radians."""


def ground_of(bays: Iterable[Bay]) -> Any:
    """Return the ground area of bays along kerbs."""
    return unary_union(
        [rectangle_polygon(np.array(bay.position), bay.heading, *LAND_USE.kerbside_m).buffer(0.01) for bay in bays]
    )


def lot_bays(lots: Any) -> list[Bay]:
    """Return rows of bays with aisles between them for each of the car parks."""
    return [bay for lot in polygons(lots) for bay in _bay_rows(lot)]


def _bay_rows(lot: Polygon) -> Iterator[Bay]:
    corners = np.array(lot.minimum_rotated_rectangle.exterior.coords)[:4]
    sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    if sides[0] < sides[1]:
        corners = np.roll(corners, -1, axis=0)
    a, along, across = corners[0], corners[1] - corners[0], corners[3] - corners[0]
    length, depth = np.hypot(*along), np.hypot(*across)
    along, across = along / length, across / depth
    inside = lot.buffer(-0.3)
    for row in np.arange(
        LAND_USE.lot_edge_m + LAND_USE.bay_m[0] / 2, depth - LAND_USE.bay_m[0] / 2, LAND_USE.bay_m[0] + LAND_USE.aisle_m
    ):
        for x in np.arange(2.0 + LAND_USE.bay_m[1] / 2, length - 2.0 - LAND_USE.bay_m[1] / 2, LAND_USE.bay_m[1]):
            position = a + along * x + across * row
            bay = Bay((float(position[0]), float(position[1])), float(np.arctan2(*across[::-1])))
            if inside.contains(rectangle_polygon(position, bay.heading, *LAND_USE.bay_m)):
                yield bay


def kerb_bays(layout: Layout, keep_clear: Any, rng: np.random.Generator) -> list[Bay]:
    """Sample parking bays along the kerbs of some streets, on the sidewalk's side and in the direction of the traffic.

    Args:
        layout: Layout of the town; the bays are in its coordinates.
        keep_clear: Region that must stay free of bays, such as drives and crossings.
        rng: Random generator for streets and gaps.
    """
    out = []
    for edge in layout.graph.edges_of("ground"):
        if layout.graph.kind(edge).sidewalk < LAND_USE.kerbside_walk_m or rng.random() > LAND_USE.kerbside_share:
            continue
        first, last = LAND_USE.junction_distances_m
        for s in np.arange(first, driven(edge)[0].getLength() - last, LAND_USE.kerbside_m[0]):
            position, heading = beside(edge, float(s), LAND_USE.kerb_m + LAND_USE.kerbside_m[1] / 2)
            ground = rectangle_polygon(position, heading, *LAND_USE.kerbside_m)
            if rng.random() > LAND_USE.free_share and not any(map(ground.intersects, (keep_clear, layout.graph.road))):
                out.append(Bay((float(position[0]), float(position[1])), heading))
    return out


def bay_lines(lots: Any) -> Any:
    """Return the painted lines on both sides of each bay of the car parks."""
    lines = []
    for bay in lot_bays(lots):
        side = np.array([-np.sin(bay.heading), np.cos(bay.heading)]) * LAND_USE.bay_m[1] / 2
        lines += [
            rectangle_polygon(np.array(bay.position) + sign * side, bay.heading, LAND_USE.bay_m[0], 0.1)
            for sign in (-1, 1)
        ]
    return unary_union(lines).intersection(lots.buffer(-0.3)) if lines else Polygon()


def drive_ring(half_length: float, front: float, street: float) -> Array:
    """Return the corners (4, 2) of a drive beside a house, from its side to the street, in the house's frame."""
    x = half_length + 0.3
    return np.array(
        [[x, front - 5.0], [x + LAND_USE.drive_m, front - 5.0], [x + LAND_USE.drive_m, street], [x, street]]
    )


def drive_bay(half_length: float, front: float) -> tuple[float, float]:
    """Return the middle of the parking space on a drive, in the house's frame."""
    return half_length + 0.3 + LAND_USE.drive_m / 2, front - 5.0 + LAND_USE.bay_m[0] / 2 + 0.3
