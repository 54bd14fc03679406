import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skope import keypoints
from skope.errors import UserError
from skope.gen.localize import transform, trilaterate
from skope.gen.vehicles import build, fleet
from skope.gen.vehicles.sidecar import Sidecar
from tests.gen.rays import cast, distance_to_triangles

MODELS = sorted(fleet())


@pytest.mark.parametrize("model", MODELS)
def test_keypoints_lie_on_the_surface(model: str) -> None:
    vehicle = fleet()[model].vehicle
    triangles = vehicle.mesh.vertices[vehicle.mesh.triangles]
    for k, point in enumerate(vehicle.points):
        if k not in keypoints.WHEELS:
            assert distance_to_triangles(point, triangles) < 0.01, keypoints.NAMES[k]


@pytest.mark.parametrize("model", MODELS)
def test_keypoints_are_mirror_images(model: str) -> None:
    points = fleet()[model].vehicle.points
    np.testing.assert_allclose(points[list(keypoints.FLIP)], points * [1, -1, 1], atol=1e-12)
    right = [i for i, name in enumerate(keypoints.NAMES) if name.endswith("_right")]
    assert (points[right, 1] < -0.2).all()
    assert points[keypoints.INDEX["front_logo"], 1] == 0


@pytest.mark.parametrize("model", MODELS)
def test_keypoints_are_where_their_names_say(model: str) -> None:
    vehicle = fleet()[model].vehicle
    p = {name: vehicle.points[i] for name, i in keypoints.INDEX.items()}
    length, width, height = vehicle.size_lwh
    assert p["front_logo"][0] == pytest.approx(length / 2, abs=0.06)
    assert p["bumper_rear_left"][0] == pytest.approx(-length / 2, abs=0.25)
    assert p["roof_front_left"][2] == pytest.approx(height, abs=0.12)
    assert p["roof_front_left"][0] < p["windscreen_base_left"][0] < p["hood_front_left"][0]
    assert p["roof_rear_left"][0] >= p["rear_window_base_left"][0] >= p["trunk_rear_left"][0]
    assert p["headlight_inner_left"][1] < p["headlight_outer_left"][1] <= width / 2
    assert p["taillight_inner_left"][1] < p["taillight_outer_left"][1] <= width / 2
    assert p["bumper_front_left"][2] < p["headlight_outer_left"][2] < p["hood_front_left"][2]
    assert p["mirror_left"][1] > width / 2
    assert p["wheel_front_left"][2] == vehicle.shape.wheel_radius


@pytest.mark.parametrize("model", MODELS)
def test_meshes_are_as_large_as_their_dimensions(model: str) -> None:
    vehicle = fleet()[model].vehicle
    length, width, height = vehicle.size_lwh
    body = vehicle.mesh.vertices
    assert np.ptp(body[:, 0]) == pytest.approx(length, abs=0.01)
    assert np.ptp(body[:, 1]) == pytest.approx(width + 0.3, abs=0.16)  # with mirrors
    assert body[:, 2].max() == pytest.approx(height, abs=0.02)
    assert np.abs(vehicle.wheel.vertices[:, [0, 2]]).max() == pytest.approx(vehicle.shape.wheel_radius, abs=0.005)


@pytest.mark.parametrize("model", MODELS)
def test_surfaces_face_outward(model: str) -> None:
    """Rays from all around, above the wheel arches, meet the front of the first triangle that they hit."""
    vehicle = fleet()[model].vehicle
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(150, 3))
    origins *= 12 / np.linalg.norm(origins, axis=1, keepdims=True)
    origins[:, 2] = np.abs(origins[:, 2]) + 1.0
    targets = rng.uniform([-1.5, -0.6, 0.9], [1.5, 0.6, 1.1], (150, 3))
    hits = 0
    for mesh, aims in ((vehicle.mesh, targets), (vehicle.wheel, np.zeros((150, 3)))):
        triangles = mesh.vertices[mesh.triangles]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        for origin, aim in zip(origins, aims, strict=True):
            _, (hit,) = cast(origin, (aim - origin)[None], triangles)
            assert hit < 0 or normals[hit] @ (aim - origin) < 0
            hits += hit >= 0
    assert hits > 250


@pytest.mark.parametrize("model", MODELS)
def test_trilateration_equals_the_rigid_transform(model: str) -> None:
    vehicle = fleet()[model].vehicle
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (64, 1, 1))
    poses[:, :3, :3] = Rotation.random(64, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-2000, 2000, (64, 3))
    rigid = transform(poses, np.tile(vehicle.points, (64, 1, 1)))
    sidecar = vehicle.sidecar
    free = trilaterate(
        rigid[:, list(keypoints.WHEELS)], np.tile(sidecar.distances, (64, 1, 1)), np.tile(sidecar.side, (64, 1))
    )
    assert np.abs(free - rigid).max() < 1e-3


def test_trilateration_of_points_above_in_and_below_the_wheel_plane() -> None:
    wheels = np.array([[1.4, -0.8, 0.3], [1.4, 0.8, 0.3], [-1.4, -0.8, 0.3], [-1.4, 0.8, 0.3]])
    points = np.zeros((keypoints.K, 3))
    points[list(keypoints.WHEELS)] = wheels
    points[0], points[1], points[2] = [0.5, 0.2, 1.3], [0.1, -0.4, 0.3], [2.0, 0.9, 0.1]
    sidecar = Sidecar.of(points)
    assert sidecar.side[[0, 1, 2]].tolist() == [1, 0, -1]
    assert sidecar.distances[0, 0] == pytest.approx(np.sqrt(0.9**2 + 1.0**2 + 1.0**2))
    turned = Rotation.from_euler("zyx", [2.0, 0.1, 3.1]).as_matrix()  # nearly upside down
    found = trilaterate((wheels @ turned.T)[None], sidecar.distances[None], sidecar.side[None])[0]
    np.testing.assert_allclose(found[:3], points[:3] @ turned.T, atol=1e-6)


def test_sidecar_survives_json() -> None:
    sidecar = fleet()["sedan"].vehicle.sidecar
    again = Sidecar.from_dict(sidecar.to_dict())
    np.testing.assert_array_equal(again.distances, sidecar.distances)
    np.testing.assert_array_equal(again.side, sidecar.side)


def test_at_least_three_body_types() -> None:
    assert {"sedan", "suv", "van"} <= {entry.vehicle.vehicle_type for entry in fleet().values()}


def test_unknown_models_and_shapes_are_named() -> None:
    with pytest.raises(UserError, match="hovercraft"):
        build("hovercraft", {})
    with pytest.raises(UserError, match="sedan"):
        build("sedan", {"wings": 2.0})
