"""Land use of a town: the areas beside its roads, the height of its ground, and what its cameras must see."""

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely import LineString, Point, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh
from skope.gen.towns.regions import Region, polygons
from skope.gen.towns.road_graph import RoadGraph, driven
from skope.gen.towns.sites import Site, sites_of
from skope.gen.towns.terrain import GroundSurface, Lanes
from skope.gen.towns.town import Town
from skope.gen.towns.town_style import TownStyle, style
from skope.types import Array

KERB_WIDTH: Final = 0.15
"""Width of kerbs, metres."""
ISLAND: Final = 20.0
"""Ground within the carriageway counts as a median or island if it is nowhere farther from it than this, metres."""
CAMERA_CLEARANCE: Final = 8.0
"""Radius around a camera in which nothing stands higher than 1 m, metres."""
DETAILED_WITHIN_M: Final = 42.0
"""Objects nearer to a camera than this are built in full detail, metres."""
PLAIN_FROM_M: Final = 120.0
"""Objects farther from all cameras than this are built plainly, without small parts, metres."""
HALF_VIEW_DEG: Final = 56.0
"""Half of the horizontal angle that cameras are taken to see, degrees."""


@dataclass(frozen=True, eq=False)
class Layout:
    """The regions and heights that a town's scenery is fitted into.

    All places are those of the graph: in a town with left-hand traffic, of its mirror image.
    """

    graph: RoadGraph
    style: TownStyle
    sites: tuple[Site, ...]
    """The cameras whose views are kept clear."""

    @classmethod
    def of(cls, town: Town) -> "Layout":
        """Read a town's network and style."""
        graph, sites = RoadGraph.of(town), sites_of(town)
        return cls(graph, style(town), tuple(map(_mirrored_site, sites)) if graph.mirrored else sites)

    # --------------------------------------------------------------------------------------------- beside the roads

    @cached_property
    def deck_edge(self) -> float:
        """Width of decks beside their lanes, metres."""
        return max([self.graph.kind(edge).sidewalk for edge in self.graph.edges_of("bridge")], default=0.0) + 0.45

    @property
    def under_decks(self) -> list[Any]:
        """Bridges' shadows on the ground, which are paved."""
        return [deck.buffer(2.0, cap_style="square") for deck in self.graph.decks]

    @cached_property
    def islands(self) -> Region:
        """Medians and islands."""
        return self.enclosed(ISLAND).difference(self.graph.road)

    def enclosed(self, reach: float) -> Region:
        """Ground within the carriageway that is nowhere farther than `reach` metres from it."""
        # Decks only touch what they lead to.
        closed = self.graph.road.buffer(0.1, join_style="mitre").buffer(-0.1, join_style="mitre")
        holes = [Polygon(hole) for part in polygons(closed) for hole in part.interiors]
        return unary_union([hole for hole in holes if hole.buffer(-reach).is_empty])

    def beside_lanes(self, width: str) -> Region:
        """The strips beside the carriageway that are as wide as the road's `width` ("sidewalk" or "shoulder")."""
        parts = []
        for edge in self.graph.edges:
            kind = self.graph.kind(edge)
            if (own := getattr(kind, width)) and kind.form == "ground":
                beyond = own + (KERB_WIDTH if self.style.kerb else 0.0)
                for lane in driven(edge):
                    line = LineString(lane.getShape())
                    parts.append(line.buffer(lane.getWidth() / 2 + beyond, cap_style="flat"))
                ends = [node.getShape() for node in (edge.getFromNode(), edge.getToNode())]
                parts += [Polygon(shape).buffer(beyond) for shape in ends if len(shape) > 2]
        return unary_union(parts).difference(self.islands) if parts else Polygon()

    @cached_property
    def sidewalk(self) -> Region:
        """The sidewalks of all roads on the ground."""
        return self.beside_lanes("sidewalk")

    # --------------------------------------------------------------------------------------------------------- cameras

    @cached_property
    def detailed(self) -> Region:
        """Area near enough to a camera that small things can be made out."""
        return unary_union([Point(site.position[:2]).buffer(PLAIN_FROM_M, quad_segs=4) for site in self.sites])

    @cached_property
    def around_cameras(self) -> Region:
        """Area around the cameras in which nothing high stands."""
        return unary_union([Point(site.position[:2]).buffer(CAMERA_CLEARANCE) for site in self.sites])

    def camera_distance(self, place: Array) -> float:
        """Distance of a place (2,) from the nearest camera, metres."""
        return min((float(np.hypot(*(place - site.position[:2]))) for site in self.sites), default=np.inf)

    def sightlines(self, reach: float) -> Region:
        """Region between the cameras and the carriageway that they see within `reach` metres."""
        return unary_union([self.around_cameras, *(_sightlines(site, self.graph.road, reach) for site in self.sites)])

    def road_below(self, site: Site) -> float:
        """Height of the carriageway that a camera looks at, 12 to 45 m before it: that of most places, metres."""
        angle = np.radians(site.yaw_deg + np.linspace(-25.0, 25.0, 11))
        rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        places = (np.array(site.position[:2]) + np.arange(12.0, 45.0, 3.0)[:, None, None] * rays).reshape(-1, 2)
        seen = places[shapely.contains_xy(self.graph.ground_road, places)]
        return float(np.median(self.ground.road(seen)))

    # ---------------------------------------------------------------------------------------------------------- ground

    @cached_property
    def ground(self) -> GroundSurface:
        """The ground with the carriageways on it."""
        driven_on, shaping = self.graph.ground_lanes("ground", "walled"), self.graph.ground_lanes("ground")
        return GroundSurface(self.style.terrain, Lanes(driven_on), Lanes(shaping))

    def height(self, place: ArrayLike) -> float:
        """Height of the ground or sidewalk at a place (2,) beside the carriageway, metres."""
        return float(self.ground.beside(np.asarray(place, dtype=np.float64)[None])[0]) + self.style.kerb

    def on_ground(self, place: ArrayLike) -> tuple[float, float, float]:
        """A place (2,) beside the carriageway with the height of the ground or sidewalk there, metres."""
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


def _mirrored_site(site: Site) -> Site:
    x, y, z = site.position
    return replace(site, position=(x, -y, z), yaw_deg=-site.yaw_deg)


def _sightlines(site: Site, road: Region, reach: float) -> Region:
    """The ground between a camera and the road that it sees within `reach` metres."""
    eye = np.array(site.position[:2])
    angles = np.radians(site.yaw_deg + np.linspace(-HALF_VIEW_DEG, HALF_VIEW_DEG, 17))
    view = Polygon([eye, *(eye + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1))])
    fans = []
    for part in polygons(road.intersection(view)):
        ring = np.array(part.exterior.coords)
        fans += [Polygon([eye, a, b]) for a, b in itertools.pairwise(ring)]
    return unary_union([fan for fan in fans if fan.area > 1e-6])
