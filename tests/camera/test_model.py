import math

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera, Distortion
from skope.errors import UserError

IDENTITY = np.eye(4)
BROWN = Distortion("brown", (-0.12, 0.03, 0.001, -0.002, 0.004))
RATIONAL = Distortion("brown", (0.3, 0.1, 0.001, -0.0005, 0.01, 0.6, 0.2, 0.02))
PRISM = Distortion("brown", (-0.1, 0.02, 0.001, -0.0005, 0.0, 0.0, 0.0, 0.0, 0.002, -0.001, 0.0015, 0.0005))
FISHEYE = Distortion("fisheye", (-0.02, 0.005, -0.002, 0.0004))


def default_camera(distortion: Distortion | None = None) -> Camera:
    focal = 960 / math.tan(math.radians(55))
    K = np.array([[focal, 0, 960], [0, focal, 540], [0, 0, 1]])
    return Camera(1920, 1080, K, IDENTITY, distortion or Distortion())


def test_default_focal_length() -> None:
    camera = Camera.looking([0, 0, 6], yaw=0.0, pitch_down=0.0)
    assert camera.K[0, 0] == pytest.approx(672.2, abs=0.05)
    assert camera.K[0, 2] == 960
    assert camera.K[1, 2] == 540


def test_point_on_the_axis_hits_the_principal_point() -> None:
    pixels, depth, valid = default_camera().project([0, 0, 7.5])
    assert pixels == pytest.approx([960, 540])
    assert depth == 7.5
    assert valid


def test_point_at_the_image_corner_at_110_degrees() -> None:
    # tan(55 deg) to the right fills half the width; the corner's ray is 1.9 times its planar depth.
    t = math.tan(math.radians(55))
    point = np.array([10 * t, 10 * t * 9 / 16, 10.0])
    pixels, depth, valid = default_camera().project(point)
    assert pixels == pytest.approx([1920, 1080])
    assert valid
    assert np.linalg.norm(point) / depth == pytest.approx(1.92, abs=0.01)


def test_point_behind_the_camera_is_invalid() -> None:
    pixels, _, valid = default_camera().project([[0, 0, -5], [1, 1, 0]])
    assert not valid.any()
    assert np.isnan(pixels).all()


def test_point_beyond_the_fold_is_invalid() -> None:
    # x (1 - 0.2 x^2) stops growing at x^2 = 1/0.6: 52 degrees off axis.
    camera = default_camera(Distortion("brown", (-0.2, 0.0, 0.0, 0.0)))
    assert math.degrees(math.atan(camera.distortion.fold)) == pytest.approx(52.24, abs=0.01)
    angles = np.radians([51.9, 52.6, 58.6, 75.0])
    points = np.stack([np.tan(angles), np.zeros(4), np.ones(4)], axis=-1)
    pixels, _, valid = camera.project(points)
    assert valid.tolist() == [True, False, False, False]
    assert not camera.inside(pixels)[1:].any()


def test_fisheye_fold() -> None:
    # theta (1 - 0.3 theta^2) stops growing at theta = 1 / sqrt(0.9).
    assert Distortion("fisheye", (-0.3, 0, 0, 0)).fold == pytest.approx(1 / math.sqrt(0.9))


@pytest.mark.parametrize("distortion", [BROWN, RATIONAL, PRISM, FISHEYE])
def test_distortion_equals_opencv(distortion: Distortion) -> None:
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.uniform(-0.8, 0.8, (200, 2)), np.ones((200, 1))], axis=1) * rng.uniform(
        1, 90, (200, 1)
    )
    camera = default_camera(distortion)
    pixels, _, valid = camera.project(points)
    coefficients = np.array(distortion.coefficients)
    project = cv2.fisheye.projectPoints if distortion.model == "fisheye" else cv2.projectPoints
    expected = project(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.K, coefficients)[0].reshape(-1, 2)
    assert valid.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-6)


@pytest.mark.parametrize(
    "distortion", [Distortion(), BROWN, RATIONAL, PRISM, FISHEYE, Distortion("brown", (-0.2, 0, 0, 0))]
)
def test_unproject_undoes_project(distortion: Distortion) -> None:
    rng = np.random.default_rng(7)
    camera = Camera.looking([3, -2, 6.5], yaw=0.7, pitch_down=0.3, roll=0.05, distortion=distortion)
    points = rng.uniform([-60, -60, 0], [60, 60, 4], (4000, 3))
    pixels, depth, valid = camera.project(points)
    seen = valid & camera.inside(pixels)
    assert seen.sum() > 300
    back, undone = camera.unproject(pixels[seen], depth[seen])
    assert undone.mean() > 0.995  # the last pixels before a fold are too steep to invert
    np.testing.assert_allclose(back[undone], points[seen][undone], atol=1e-5)


def test_looking_down_a_street() -> None:
    camera = Camera.looking(
        [10, 20, 6], yaw=math.pi / 2, pitch_down=math.radians(15), size=(640, 360), fov=math.radians(60)
    )
    np.testing.assert_allclose(camera.position, [10, 20, 6])
    (aim, east), _, _ = camera.project([[10, 20 + 6 / math.tan(math.radians(15)), 0], [12, 50, 0]])
    np.testing.assert_allclose(aim, [320, 180], atol=1e-9)
    assert east[0] > 320  # looking north, east is to the right


def test_roll_turns_the_image_against_the_camera() -> None:
    level = Camera.looking([0, 0, 5], yaw=0, pitch_down=0.2)
    rolled = Camera.looking([0, 0, 5], yaw=0, pitch_down=0.2, roll=math.radians(2))
    point = [20, -8, 0]  # to the right of the axis
    assert rolled.project(point)[0][1] < level.project(point)[0][1]


def test_round_trip_through_a_dict() -> None:
    camera = Camera.looking([1, 2, 8], yaw=2.0, pitch_down=0.4, distortion=BROWN)
    again = Camera.from_dict(camera.to_dict(), 1920, 1080)
    np.testing.assert_array_equal(again.T_camera_world, camera.T_camera_world)
    assert again.distortion == camera.distortion


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"K": [[0, 0, 0]] * 3}, "camera.K"),
        ({"K": [[1, 2], [3, 4]]}, "camera.K"),
        ({"K": "wide"}, "camera"),
        ({"T_camera_world": (2 * np.eye(4)).tolist()}, "rigid"),
        ({"distortion": {"model": "barrel", "coefficients": []}}, "barrel"),
        ({"distortion": {"model": "brown", "coefficients": [1, 2, 3]}}, "4 or 5 or 8 or 12"),
        ({"distortion": {"model": "brown", "coefficients": [1, 2, 3, float("nan")]}}, "finite"),
    ],
)
def test_bad_cameras_are_named(change: dict, word: str) -> None:
    with pytest.raises(UserError, match=word):
        Camera.from_dict(default_camera().to_dict() | change, 1920, 1080)
