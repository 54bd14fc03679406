"""What a camera's error does to places and velocities, against repeated draws; planes; files that say it."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from skope.camera.calibration_files import read_uncertain_camera
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera, Distortion
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, UncertainCamera, moved_camera, values_of
from skope.errors import UserError
from skope.types import Array
from tests.samples import within

LENS = Distortion("brown", (-0.08, 0.01, 0.001, 0.0))
CAMERA = Camera(
    1280,
    720,
    np.array([[1100.0, 0, 655], [0, 1090.0, 350], [0, 0, 1]]),
    Camera.looking([4.0, -7.0, 6.5], yaw=0.8, pitch_down=0.35, roll=0.02).T_camera_world,
    LENS,
)
SIGMAS = np.array([0.01, 0.01, 0.1, 0.1, 0.1, 0.004, 0.004, 0.004])


def known() -> UncertainCamera:
    A = np.random.default_rng(1).normal(size=(8, 8)) + 2 * np.eye(8)
    C = A @ A.T
    C /= np.sqrt(np.outer(np.diag(C), np.diag(C)))
    return UncertainCamera(CAMERA, CAMERA_PARAMETERS, C * np.outer(SIGMAS, SIGMAS))


def drawn(count: int) -> list[Camera]:
    """Cameras as their covariance has them, in antithetic pairs: the mean of what is linear is exact."""
    one = known()
    steps = np.random.default_rng(2).multivariate_normal(np.zeros(8), one.covariance, count // 2)
    return [moved_camera(CAMERA, dict(zip(CAMERA_PARAMETERS, step, strict=True))) for step in (*steps, *-steps)]


def test_moved_cameras_have_the_values_that_they_were_moved_to() -> None:
    step = np.array([0.02, 0.01, 1.0, -2.0, 0.5, 0.03, -0.02, 0.1])
    moved = moved_camera(CAMERA, dict(zip(CAMERA_PARAMETERS, step, strict=True)))
    assert values_of(moved) == pytest.approx(values_of(CAMERA) + step)
    # The principal point and the pixels' shape stay.
    assert moved.K[:2, 2].tolist() == CAMERA.K[:2, 2].tolist()
    assert moved.K[1, 1] / moved.K[0, 0] == pytest.approx(1090 / 1100)
    assert moved.distortion.coefficients[1:] == LENS.coefficients[1:]
    plain = Camera.looking([0, 0, 5], yaw=0, pitch_down=0.3)
    assert moved_camera(plain, {"focal": 0.1}).distortion.model == "none"
    assert moved_camera(plain, {"k1": 0.1}).distortion.coefficients[0] == 0.1


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.06, -0.04)])
def test_covariances_are_those_of_repeated_draws(slope: tuple[float, float]) -> None:
    rise = np.array(slope)
    xy = intersect_ground(CAMERA, np.array([[640.0, 500.0], [300.0, 400.0], [1000.0, 600.0]]), slope=slope)
    velocities = np.array([[10.0, 0.0], [-3.0, 12.0], [0.0, 5.0]])
    one = known()
    of_place = one.covariance_at(xy, slope)
    of_velocity = one.covariance_of_velocities(xy, velocities, slope)

    def places(camera: Camera, at: Array) -> Array:
        pixels = CAMERA.project(np.column_stack([at, at @ rise]))[0]
        return intersect_ground(camera, pixels, slope=slope)[:, :2]

    at, late = xy[:, :2], xy[:, :2] + 0.05 * velocities
    cameras = drawn(800)
    moved = np.array([places(camera, at) for camera in cameras])
    ways = np.array([(places(camera, late) - places(camera, at)) / 0.05 for camera in cameras])
    for k in range(3):
        assert np.cov(moved[:, k].T) == pytest.approx(of_place[k], rel=0.2, abs=0.1 * np.trace(of_place[k]))
        assert np.cov(ways[:, k].T) == pytest.approx(of_velocity[k], rel=0.2, abs=0.1 * np.trace(of_velocity[k]))


def test_a_height_that_is_off_stretches_all_ways() -> None:
    """By similar triangles."""
    camera = Camera.looking([2.0, 3.0, 8.0], yaw=0.3, pitch_down=0.4, size=(1280, 720), fov=1.0)
    one = within(camera, 0.05)
    place = intersect_ground(camera, [700.0, 500.0])
    away = np.linalg.norm(place[:2] - [2, 3])
    assert np.sqrt(np.linalg.eigvalsh(one.covariance_at(place))) == pytest.approx([0, 0.05 * away], abs=1e-6)
    assert np.sqrt(one.covariance_of_velocities(place, [3.0, 4.0]) @ [0.6, 0.8] @ [0.6, 0.8]) == pytest.approx(0.25)
    assert one.distance_sigma() == pytest.approx(0.05)
    assert np.isnan(one.covariance_at([-50.0, 3.0, 0.0])).all()


def test_planes_are_met_where_rays_meet_them() -> None:
    """Any place of a plane, from above or below, comes back from its pixel."""
    rng = np.random.default_rng(0)
    slope, about, height = np.array([0.1, -0.05]), np.array([20.0, 5.0]), 0.7
    xy = CAMERA.position[:2] + rng.uniform(8, 30, (50, 1)) * [math.cos(0.8), math.sin(0.8)] + rng.normal(0, 3, (50, 2))
    places = np.column_stack([xy, height + (xy - about) @ slope])
    pixels, _, valid = CAMERA.project(places)
    back = intersect_ground(CAMERA, pixels[valid], height, slope=slope, about=about)
    assert valid.sum() > 30
    np.testing.assert_allclose(back, places[valid], atol=1e-8)
    own = intersect_ground(CAMERA, pixels[valid], places[valid][:, 2], slope=slope, about=places[valid][:, :2])
    np.testing.assert_allclose(own, places[valid], atol=1e-8)
    assert np.isnan(intersect_ground(CAMERA, [640.0, -500.0])).all()
    far = intersect_ground(CAMERA, [640.0, -500.0], least_fall=1e-3)
    assert np.linalg.norm(far[:2] - CAMERA.position[:2]) > 1000


def test_files_say_how_well_a_camera_is_known(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    document = {"width": 1280, "height": 720, **CAMERA.to_dict()}
    path.write_text(json.dumps({**document, "covariance": known().covariance_dict()}))
    read = read_uncertain_camera(path)
    assert read is not None
    np.testing.assert_allclose(read.covariance, known().covariance)
    path.write_text(json.dumps(document))
    assert read_uncertain_camera(path) is None
    # Logarithms, as cameras from vehicles have them.
    told = {"of": ["log_focal", "log_height"], "matrix": [[0.01, 0.002], [0.002, 0.0025]]}
    path.write_text(json.dumps({**document, "covariance": told}))
    read = read_uncertain_camera(path)
    assert read is not None
    assert read.parameters == ("focal", "z")
    assert read.covariance == pytest.approx(np.array([[0.01, 0.013], [0.013, 0.0025 * 6.5**2]]))


@pytest.mark.parametrize(
    ("covariance", "said"),
    [
        ({"of": ["z"], "matrix": [[-1.0]]}, "without negative"),
        ({"of": ["z", "z"], "matrix": [[1, 0], [0, 1]]}, "covariance: of"),
        ({"of": ["depth"], "matrix": [[1]]}, "covariance: of"),
        ({"of": "z", "matrix": [[1]]}, "covariance: of"),
        ({"of": ["z"], "matrix": [[1, 2]]}, "covariance: matrix"),
        ({"of": ["z"], "matrix": "large"}, "covariance: matrix"),
        ({"of": ["z", "x"], "matrix": [[1, 0.5], [0.1, 1]]}, "symmetric"),
        ({"of": ["z", "x"], "matrix": [[1, 2], [2, 1]]}, "without negative"),
        ({"matrix": [[1]]}, "covariance: of"),
    ],
)
def test_wrong_covariances_are_told(covariance: dict[str, object], said: str, tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text(json.dumps({"width": 1280, "height": 720, **CAMERA.to_dict(), "covariance": covariance}))
    with pytest.raises(UserError, match=said) as error:
        read_uncertain_camera(path)
    assert str(error.value).startswith(str(path))
