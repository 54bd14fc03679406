"""Stand-ins for scenery behind a photograph: ground that shadows fall on, and objects that hide the traffic."""

from collections.abc import Iterator
from typing import Final

import numpy as np
import shapely
from shapely import Polygon

from skope.gen.mesh import Mesh, from_triangles, grid, merged
from skope.gen.towns.land_use import Layout
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.town import Town
from skope.gen.towns.user_road import OwnRoad, PixelOutline
from skope.types import Array

_GROUND_RADIUS_M: Final = 2000.0
"""Radius of level ground around the camera, metres."""
_GROUND_CELL_M: Final = 2.0
_PLATES: Final = 15.0
"""Height of what throws a photograph's shadows, metres over the road."""
_SLOPED: Final = 250.0
"""Radius of ground that is not level around the camera, metres."""


def backdrop(layout: Layout, road: OwnRoad) -> Mesh:
    """Ground at the lanes' heights, and occluders that face the camera, in the world's axes."""
    return merged([_ground(layout, road.camera.position[:2]), *_occluders(road)])


def _ground(layout: Layout, middle: Array) -> Mesh:
    level = layout.ground.level
    reach, count = (_GROUND_RADIUS_M, 1) if level is not None else (_SLOPED, int(2 * _SLOPED / _GROUND_CELL_M))
    x, y = (np.linspace(at - reach, at + reach, count + 1) for at in middle)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    z = (
        layout.ground.road(layout.graph.world(places).reshape(-1, 2))
        if level is None
        else np.full(places[..., 0].size, level)
    )
    points = np.concatenate([places, z.reshape(places.shape[:2])[..., None]], axis=-1)
    return grid(points, [["asphalt"] * count] * count)


def _occluders(road: OwnRoad) -> Iterator[Mesh]:
    for one in road.occluders:
        corners = _filling_triangles(road, one.polygon)
        points, _ = road.camera.unproject(corners, np.full(len(corners), one.distance))
        yield from_triangles(points, np.arange(len(points)).reshape(-1, 3), "iron")


def plates(road: OwnRoad, toward_sun: Array) -> Mesh | None:
    """Something high over the road that throws the shadows which the photograph has; None when it has none."""
    camera, out = road.camera, []
    level = RoadGraph.of(Town.of(road)).road_level(camera.position[:2])
    for outline in road.shades:
        rays, _ = camera.rays(_filling_triangles(road, outline))
        directions = rays @ camera.T_camera_world[:3, :3]
        reach = (level - camera.position[2]) / directions[:, 2:]
        points = camera.position + reach * directions + toward_sun * _PLATES / toward_sun[2]
        out.append(from_triangles(points, np.arange(len(points)).reshape(-1, 3), "iron"))
    return merged(out) if out else None


def _filling_triangles(road: OwnRoad, outline: PixelOutline) -> Array:
    """(3T, 2) corners of triangles that fill an outline in the image, small enough for the lens."""
    fine = shapely.segmentize(Polygon(outline), max(road.camera.width, road.camera.height) / 50)
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(fine))
    return np.asarray(shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2))
