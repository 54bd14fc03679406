"""What stands for the scenery behind a photograph: the ground that shadows fall on, and what hides the traffic."""

from collections.abc import Iterator
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from skope.gen.mesh import Mesh, from_triangles, grid, merged
from skope.gen.towns.layout import Layout
from skope.gen.towns.place import Place

Array = NDArray[np.float64]

_FAR: Final = 2000.0
"""Where level ground ends, metres from the camera."""
_CELL: Final = 2.0
_SLOPED: Final = 250.0
"""Where ground that is not level ends, metres from the camera."""


def backdrop(layout: Layout, place: Place) -> Mesh:
    """Ground at the lanes' heights, and occluders that face the camera, in the world's axes."""
    return merged([_ground(layout, place.camera.position[:2]), *_occluders(place)])


def _ground(layout: Layout, middle: Array) -> Mesh:
    level = layout.ground.level
    reach, count = (_FAR, 1) if level is not None else (_SLOPED, int(2 * _SLOPED / _CELL))
    x, y = (np.linspace(at - reach, at + reach, count + 1) for at in middle)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    z = (
        layout.ground.road(layout.world(places).reshape(-1, 2))
        if level is None
        else np.full(places[..., 0].size, level)
    )
    points = np.concatenate([places, z.reshape(places.shape[:2])[..., None]], axis=-1)
    return grid(points, [["asphalt"] * count] * count)


def _occluders(place: Place) -> Iterator[Mesh]:
    camera = place.camera
    for one in place.occluders:
        outline = shapely.segmentize(Polygon(one.polygon), max(camera.width, camera.height) / 50)
        triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(outline))
        corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
        points, _ = camera.unproject(corners.reshape(-1, 2), np.full(3 * len(corners), one.distance))
        yield from_triangles(points, np.arange(len(points)).reshape(-1, 3), "iron")
