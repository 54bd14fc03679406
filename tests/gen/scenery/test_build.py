"""Scenery keeps off the road and out of the cameras' view, and its ground has neither gaps nor overlaps."""

import numpy as np
import pytest
import shapely
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, quads, tube
from skope.gen.render.materials import GROUND_MATERIALS, MATERIAL_COLORS
from skope.gen.scenery import facade
from skope.gen.scenery.build import scenery
from skope.gen.scenery.quads import Solid
from skope.gen.scenery.street_furniture import FURNITURE_LIMITS
from skope.gen.towns.land_use import LAND_USE, Layout
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.town import Town, towns
from tests.gen.rays import cast

KERB = 0.12
FLAT = [town for town in towns() if Layout.of(town).ground.flat]


@pytest.fixture(scope="module", params=towns(), ids=lambda town: town.name)
def town(request: pytest.FixtureRequest) -> Town:
    found: Town = request.param
    return found


def corners(mesh: Mesh, chosen: np.ndarray) -> np.ndarray:
    return mesh.vertices[mesh.triangles[chosen]]


def area(triangles: np.ndarray) -> float:
    """Of (T, 3, 3) seen from above; what faces down counts as negative."""
    a, b = triangles[:, 1, :2] - triangles[:, 0, :2], triangles[:, 2, :2] - triangles[:, 0, :2]
    return float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def ground(mesh: Mesh, height: float) -> np.ndarray:
    """Triangles (T, 3, 3) of the ground that lie in one plane."""
    is_ground = np.array([name in GROUND_MATERIALS for name in mesh.materials])[mesh.material]
    level = (mesh.vertices[mesh.triangles][..., 2] == height).all(axis=1)
    return corners(mesh, is_ground & level)


@pytest.mark.parametrize("town", FLAT, ids=lambda town: town.name)
def test_the_carriageway_is_flat_and_whole(town: Town) -> None:
    road = RoadGraph.of(town).road
    triangles = ground(scenery(town).mesh, 0.0)
    assert area(triangles) == pytest.approx(road.area, rel=1e-4)
    assert unary_union(shapely.polygons(triangles[..., :2])).symmetric_difference(road).area < 1e-4 * road.area


@pytest.mark.parametrize("town", FLAT, ids=lambda town: town.name)
def test_the_ground_beside_it_is_laid_once_everywhere(town: Town) -> None:
    road = RoadGraph.of(town).road
    triangles = ground(scenery(town).mesh, KERB)
    points = triangles.reshape(-1, 3)
    everywhere = np.prod(points.max(axis=0)[:2] - points.min(axis=0)[:2])
    assert area(triangles) == pytest.approx(everywhere - road.area, rel=1e-5)
    rng = np.random.default_rng(0)
    tree = shapely.STRtree(shapely.polygons(triangles[..., :2]))
    places = shapely.points(rng.uniform(-150, 150, (2000, 2)))
    beside = places[~shapely.contains(road, places)]
    point, _ = tree.query(beside, predicate="within")
    assert np.bincount(point, minlength=len(beside)).max() == 1
    assert len(np.unique(point)) > 0.999 * len(beside)


@pytest.mark.parametrize("town", FLAT, ids=lambda town: town.name)
def test_nothing_stands_on_the_carriageway(town: Town) -> None:
    road, mesh = RoadGraph.of(town).road, scenery(town).mesh
    is_ground = np.array([name in GROUND_MATERIALS for name in mesh.materials])[mesh.material]
    standing = corners(mesh, ~is_ground)
    standing = standing[(standing[..., 2].max(axis=1) > KERB + 1e-6) & (standing[..., 2].min(axis=1) < 5.0)]
    feet = np.unique(standing.reshape(-1, 3)[:, :2].round(4), axis=0)
    near = shapely.contains_xy(road.buffer(FURNITURE_LIMITS.clearance_m - 1e-3), feet)
    assert not near.any(), feet[near][:5]


@pytest.mark.parametrize("town", FLAT, ids=lambda town: town.name)
def test_cameras_have_room_around_them(town: Town) -> None:
    mesh = scenery(town).mesh
    for site in Layout.of(town).sites:
        high = mesh.vertices[mesh.vertices[:, 2] > site.position[2] - 2.5]
        distance = np.hypot(*(high[:, :2] - site.position[:2]).T)
        assert distance.min() > LAND_USE.camera_clearance_m, site.name


@pytest.mark.parametrize(
    "town",
    [pytest.param(town, marks=pytest.mark.slow) if town.name in ("town03", "town04") else town for town in towns()],
    ids=lambda town: town.name,
)
def test_cameras_see_the_road_before_them(town: Town) -> None:
    """Of the carriageway within 30 m in front of a camera hardly anything is hidden by scenery."""
    layout, mesh = Layout.of(town), scenery(town).mesh
    is_ground = np.array([name in GROUND_MATERIALS for name in mesh.materials])[mesh.material]
    standing = corners(mesh, ~is_ground)
    rng = np.random.default_rng(1)
    for site in layout.sites:
        angle = np.radians(site.yaw_deg + rng.uniform(-50, 50, 400))
        reach = rng.uniform(0, 30, 400)
        places = site.position[:2] + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        places = places[shapely.contains_xy(layout.graph.ground_road, places)][:60]
        rays = np.column_stack([places, layout.ground.road(places)]) - site.position
        close = np.hypot(*(standing[..., :2] - site.position[:2]).min(axis=1).T) < 32
        distances, _ = cast(np.array(site.position), rays, standing[close])
        # Distances are in the rays' own lengths: below 1 something stands in the way.
        assert (distances > 1).mean() > 0.85, site.name


@pytest.mark.parametrize("town", [Town("town04")])
def test_the_same_town_gives_the_same_mesh(town: Town) -> None:
    first, again = scenery(town), scenery.__wrapped__(town)
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.material, again.mesh.material)
    assert len(first.signals) == len(again.signals)


def test_materials_have_colours_and_the_mesh_is_of_bounded_size(town: Town) -> None:
    mesh = scenery(town).mesh
    assert set(mesh.materials) <= set(MATERIAL_COLORS)
    assert len(mesh.triangles) < 440_000
    # pybullet takes no more vertices than that in one shape.
    assert max(len(part.vertices) for part in mesh.by_material().values()) < 131_072


def test_triangles_wind_as_their_normals_point() -> None:
    mesh = scenery(Town("town01")).mesh
    hard = np.array([not name.startswith("leaves") for name in mesh.materials])[mesh.material]
    a, b, c = np.moveaxis(corners(mesh, hard), 1, 0)
    face = np.cross(b - a, c - a)
    along = (face * mesh.normals[mesh.triangles[hard]].mean(axis=1)).sum(axis=1)
    assert along.min() >= 0
    assert (along > 0).mean() > 0.99  # the tips of posts are triangles of no area


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def test_boxes_face_outwards_and_recesses_inwards() -> None:
    solid = Solid()
    solid.box("trim", (1, 2, 3), (2, 4, 6))
    assert volume(solid.mesh()) == pytest.approx(6)
    hole = Solid()
    hole.recess("trim", (0, 1), (0, 2), (-0.5, 0))
    middle = np.array([0.5, 1.0, -0.25])
    mesh = hole.mesh()
    assert ((middle - mesh.vertices) * mesh.normals).sum(axis=1).min() > 0


def test_a_quad_may_be_a_triangle() -> None:
    mesh = quads([[(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 0)]], "trim")
    assert len(mesh.triangles) == 1
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1]] * 4)


def test_tubes_face_outwards() -> None:
    mesh = tube([(0, 0, 0), (0, 0.2, 1), (0, 1, 2)], (0.1, 0.1, 0.1), "trim", 8)
    assert (mesh.vertices[:9] * mesh.normals[:9]).sum(axis=1).min() > 0


def test_a_wall_has_holes_where_its_windows_are() -> None:
    wall = facade._wall(10.0, 6.0, [(1, 2, 1, 2.5), (4, 5, 1, 2.5), (4, 5, 4, 5)])
    a, b = wall[:, 1] - wall[:, 0], wall[:, 3] - wall[:, 0]
    assert np.cross(a, b)[:, 2].sum() == pytest.approx(60 - 1.5 - 1.5 - 1)
