"""Backdrop of a scene: hills or a skyline at the edge of the ground, and stand-ins for a photograph's scenery.

The stand-ins are ground that receives shadows and objects that hide the traffic.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from shapely import Polygon

from skope.gen.mesh import Mesh, from_triangles, grid, merged
from skope.gen.scenery.ground import GROUND_SIZES
from skope.gen.scenery.quads import Solid
from skope.gen.towns.land_use import Layout
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.town import OwnRoad, PixelOutline, Town
from skope.types import Array


@dataclass(frozen=True)
class BackdropGround:
    """Ground behind a photograph."""

    radius_m: float = 2000.0
    """Radius of level ground around the camera, metres."""
    cell_m: float = 2.0
    """Cell size of the ground, metres."""
    shading_height_m: float = 15.0
    """Height above the road of the plates that cast a photograph's shadows, metres."""
    sloped_radius_m: float = 250.0
    """Radius of ground that is not level around the camera, metres."""


BACKDROP_GROUND: Final = BackdropGround()


def backdrop(layout: Layout, road: OwnRoad) -> Mesh:
    """Return ground at the lanes' heights, and occluders that face the camera, in world axes."""
    return merged([_ground(layout, road.camera.position[:2]), *_occluders(road)])


def _ground(layout: Layout, middle: Array) -> Mesh:
    level = layout.ground.level
    reach, count = (
        (BACKDROP_GROUND.radius_m, 1)
        if level is not None
        else (BACKDROP_GROUND.sloped_radius_m, int(2 * BACKDROP_GROUND.sloped_radius_m / BACKDROP_GROUND.cell_m))
    )
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
    for occluder in road.occluders:
        corners = _filling_triangles(road, occluder.polygon)
        points, _ = road.camera.unproject(corners, np.full(len(corners), occluder.distance))
        yield from_triangles(points, np.arange(len(points)).reshape(-1, 3), "iron")


def plates(road: OwnRoad, toward_sun: Array) -> Mesh | None:
    """Return plates high above the road that cast the photograph's shadows; None if it has no shadows."""
    camera, out = road.camera, []
    level = RoadGraph.of(Town.of(road)).road_level(camera.position[:2])
    for outline in road.shades:
        rays, _ = camera.rays(_filling_triangles(road, outline))
        directions = rays @ camera.T_camera_world[:3, :3]
        reach = (level - camera.position[2]) / directions[:, 2:]
        points = camera.position + reach * directions + toward_sun * BACKDROP_GROUND.shading_height_m / toward_sun[2]
        out.append(from_triangles(points, np.arange(len(points)).reshape(-1, 3), "iron"))
    return merged(out) if out else None


def _filling_triangles(road: OwnRoad, outline: PixelOutline) -> Array:
    """Return the corners (3T, 2) of triangles that fill an outline in the image, small enough for the lens."""
    fine = shapely.segmentize(Polygon(outline), max(road.camera.width, road.camera.height) / 50)
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(fine))
    return np.asarray(shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2))


_SKYLINE_MATERIALS: Final = (
    "concrete",
    "plaster_grey",
    "brick_buff",
    "stone",
    "plaster_white",
    "brick_brown",
    "cladding_grey",
)


def horizon(layout: Layout, rng: np.random.Generator) -> Iterator[Mesh]:
    yield _hills(layout, rng)
    if layout.style.horizon == "skyline":
        yield _skyline(layout, rng)


def _ground_outline(graph: RoadGraph, count: int) -> tuple[Array, Array, Array]:
    """Return middle and half sizes of the ground, and directions (count, 2) all around, clockwise."""
    x0, y0, x1, y1 = graph.road.bounds
    centre, half = np.array([x0 + x1, y0 + y1]) / 2, np.array([x1 - x0, y1 - y0]) / 2 + GROUND_SIZES.margin_m
    angle = np.linspace(0, 2 * np.pi, count)[::-1]
    return centre, half, np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _hills(layout: Layout, rng: np.random.Generator) -> Mesh:
    """Return wooded hills all around."""
    count = 540
    centre, half, ring = _ground_outline(layout.graph, count + 1)
    angle = np.linspace(0, 2 * np.pi, count + 1)[::-1]
    swell = 1 + 0.3 * sum(np.sin(k * angle + rng.uniform(0, 6)) / k for k in (2, 3, 5, 9))
    size = layout.style.hill_height
    rows = []
    for share, height in (
        (0.70, -1.5),
        (0.71, 4.5),
        (0.76, 7.0),
        (0.88, 14.0 * size),
        (0.89, 17.0 * size),
        (1.0, 22.0 * size),
    ):
        crowns = np.resize(rng.uniform(-1.8, 1.2, count), count + 1)
        places = centre + share * half * ring
        foot = layout.ground.natural(places)
        rows.append(np.column_stack([places, foot + height * np.clip(swell, 0.3, 2) + crowns]))
    return grid(np.array(rows), [["woods"] * count] * 5)


def _skyline(layout: Layout, rng: np.random.Generator) -> Mesh:
    """Return distant blocks of several heights, with bands of windows, all around."""
    centre, half, ring = _ground_outline(layout.graph, 150)
    out = Solid()
    for k, direction in enumerate(ring[:-1]):
        x, y = centre + direction * half * rng.uniform(0.66, 0.86)
        width, depth = rng.uniform(10, 24, 2)
        storeys = int(rng.integers(4, 9) if rng.random() < 0.7 else rng.integers(9, 21))
        wall = _SKYLINE_MATERIALS[rng.integers(len(_SKYLINE_MATERIALS))]
        top = 3.2 * storeys + 1.0
        out.box(wall, (x - width / 2, y - depth / 2, -0.5), (x + width / 2, y + depth / 2, top), without="-z")
        out.box("felt", (x - width / 4, y - depth / 4, top), (x + width / 5, y + depth / 5, top + 3.0), without="-z")
        for storey in range(storeys):
            z = 3.2 * storey + 1.2
            low, high = (
                (x - width / 2 - 0.15, y - depth / 2 - 0.15, z),
                (x + width / 2 + 0.15, y + depth / 2 + 0.15, z + 1.5),
            )
            out.box("window", low, high, without="-z +z")
        for share in np.linspace(-0.5, 0.5, 5 + k % 3):
            at = x + share * width
            out.box(wall, (at - 0.4, y - depth / 2 - 0.3, 0.0), (at + 0.4, y + depth / 2 + 0.3, top), without="-z +z")
            at = y + share * depth
            out.box(wall, (x - width / 2 - 0.3, at - 0.4, 0.0), (x + width / 2 + 0.3, at + 0.4, top), without="-z +z")
    return out.mesh()
