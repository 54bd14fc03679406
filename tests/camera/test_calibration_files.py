"""A known camera, written as others write theirs and read back, projects to the same pixels."""

import json
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from skope.camera.calibration_files import (
    over_plane,
    read_calibration,
    read_opencv,
    read_plane,
    read_rope3d,
    read_tumtraf,
)
from skope.camera.model import Camera, Distortion
from skope.camera.pose_from_points import fit_camera_to_points
from skope.errors import UserError

BROWN = Distortion("brown", (-0.12, 0.03, 0.001, -0.002, 0.004))
FISHEYE = Distortion("fisheye", (-0.02, 0.005, -0.002, 0.0004))
RNG = np.random.default_rng(3)
POINTS = RNG.uniform([12, -14, 0], [70, 14, 3], (300, 3)) @ np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]])
"""In the view of `known`."""


def known(distortion: Distortion | None = None) -> Camera:
    camera = Camera.looking(
        [1.5, -2.0, 7.3], yaw=math.atan2(0.8, 0.6), pitch_down=0.21, roll=0.013, fov=1.3, distortion=distortion
    )
    K = camera.K + [[0, 0, 7.25], [0, 3.5, -4.5], [0, 0, 0]]
    return Camera(camera.width, camera.height, K, camera.T_camera_world, camera.distortion)


def theirs(camera: Camera) -> np.ndarray:
    """K for pixels whose centres are whole numbers."""
    return camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


def same(a: Camera, b: Camera, points: np.ndarray = POINTS) -> None:
    first, second = a.project(points), b.project(points)
    assert first[2].all()
    np.testing.assert_allclose(second[0], first[0], atol=1e-6)


@pytest.mark.parametrize("distortion", [Distortion(), BROWN, FISHEYE])
@pytest.mark.parametrize("by_vector", [True, False])
def test_opencv_file_storage(distortion: Distortion, by_vector: bool, tmp_path: Path) -> None:
    camera = known(distortion)
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", theirs(camera))
    storage.write("distortion_coefficients", np.array([distortion.coefficients or (0.0,) * 5]))
    storage.write("fisheye_model", int(distortion.model == "fisheye"))
    R = camera.T_camera_world[:3, :3]
    storage.write("rvec" if by_vector else "R", cv2.Rodrigues(R)[0] if by_vector else R)
    storage.write("tvec", camera.T_camera_world[:3, 3:])
    storage.release()
    read = read_calibration(tmp_path / "camera.yml")
    assert read.size == (1920, 1080)
    assert read.T_camera_world is not None
    same(camera, Camera(*read.size, read.K, read.T_camera_world, read.distortion))


@pytest.mark.parametrize("raw", [True, False])
def test_tumtraf_json(raw: bool, tmp_path: Path) -> None:
    camera = known(BROWN if raw else None)
    matrices = [theirs(camera).tolist(), (theirs(camera) * [[1.1, 1, 1], [1, 1.1, 1], [1, 1, 1]]).tolist()]
    content = {
        "image_width": 1920,
        "image_height": 1080,
        "intrinsic_camera_matrix": [[*row, 0.0] for row in matrices[0 if raw else 1]],
        "optimal_intrinsic_camera_matrix": matrices[1 if raw else 0],
        "dist_coefficients": list(BROWN.coefficients),
        "rotation_matrix": camera.T_camera_world[:3, :3].tolist(),
        "translation_matrix": camera.T_camera_world[:3, 3:].tolist(),
    }
    path = tmp_path / "s110_camera.json"
    path.write_text(json.dumps(content))
    read = read_calibration(path, raw=raw)
    assert read.size == (1920, 1080)
    assert read.T_camera_world is not None
    same(camera, Camera(*read.size, read.K, read.T_camera_world, read.distortion))
    path.write_text(json.dumps(content | {"rotation_matrix": [[-1] * 3] * 3}))
    assert read_tumtraf(path).T_camera_world is None


def test_rope3d_intrinsics_and_plane(tmp_path: Path) -> None:
    camera = known()
    P = np.column_stack([theirs(camera), np.zeros(3)])
    (tmp_path / "calib.txt").write_text("P2: " + " ".join(map(repr, P.ravel().tolist())) + "\n")
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    up = R[:, 2]  # the world's z in the camera frame; the road is where z = 0
    (tmp_path / "denorm.txt").write_text(" ".join(map(repr, [*(2 * up).tolist(), 2 * float(-up @ t)])))
    read, plane = read_rope3d(tmp_path / "calib.txt"), read_plane(tmp_path / "denorm.txt")
    assert plane[1] < 0
    assert plane[3] == pytest.approx(7.3)
    pose = over_plane(plane, position=(1.5, -2.0), yaw=math.atan2(0.8, 0.6))
    same(camera, Camera(1920, 1080, read.K, pose))
    again = over_plane(-plane, position=(1.5, -2.0), yaw=math.atan2(0.8, 0.6))
    np.testing.assert_allclose(again, pose)
    with pytest.raises(UserError, match="below the road"):
        over_plane([*plane[:3], -2.0], position=(0, 0), yaw=0)


GROUND = np.array([[14, 3, 0], [30, -8, 0], [52, 10, 0], [25, 6, 0], [20, -2, 0], [38, 1, 0.0]])


@pytest.mark.parametrize("count", [4, 6])
@pytest.mark.parametrize("focal", ["known", "estimated"])
@pytest.mark.parametrize("distortion", [Distortion(), BROWN])
def test_control_points(count: int, focal: str, distortion: Distortion) -> None:
    """On the ground, seen by a camera whose principal point is the image's middle."""
    camera = Camera.looking([1.5, -2.0, 7.3], yaw=0.1, pitch_down=0.21, roll=0.013, fov=1.3, distortion=distortion)
    pixels, _, valid = camera.project(GROUND[:count])
    assert valid.all()
    K = camera.K if focal == "known" else None
    fit = fit_camera_to_points(pixels, GROUND[:count], (1920, 1080), K=K, distortion=distortion)
    assert fit.rms_px < 1e-3
    others = RNG.uniform([12, -9, 0], [70, 9, 3], (100, 3))
    np.testing.assert_allclose(fit.camera.project(others)[0], camera.project(others)[0], atol=0.01)


def test_control_points_in_space_and_with_errors() -> None:
    camera = Camera.looking([400.0, 9000.0, 6.0], yaw=2.0, pitch_down=0.3, fov=1.0)
    rays, _ = camera.rays(RNG.uniform([100, 100], [1800, 1000], (12, 2)))
    points = camera.unproject(camera.project(camera.position + rays @ camera.T_camera_world[:3, :3])[0], 20.0)[0]
    points += RNG.normal(0, 4, points.shape)
    pixels = camera.project(points)[0] + RNG.normal(0, 0.5, (12, 2))
    fit = fit_camera_to_points(pixels, points, (1920, 1080))
    assert fit.camera.K[0, 0] == pytest.approx(camera.K[0, 0], rel=0.02)
    assert 0.2 < fit.rms_px < 1.0
    np.testing.assert_allclose(fit.camera.position, camera.position, atol=0.5)


@pytest.mark.parametrize(
    ("points", "word"), [(GROUND[:3], "4 or more"), (GROUND[:1] + np.arange(5)[:, None] * [1, 1, 0], "one line")]
)
def test_useless_control_points(points: np.ndarray, word: str) -> None:
    pixels = known().project(points)[0]
    with pytest.raises(UserError, match=word):
        fit_camera_to_points(pixels, points, (1920, 1080))


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("none.yml", None, "no such file"),
        ("broken.yml", "%YAML:1.0\n---\ncamera_matrix: [", "FileStorage"),
        ("empty.yml", "%YAML:1.0\n---\nimage_width: 640\n", "camera_matrix"),
        ("a.json", "{}", "intrinsic_camera_matrix"),
        ("b.json", '{"intrinsic_camera_matrix": [[1, 2], [3]]}', "matrix"),
        ("c.json", '{"intrinsic_camera_matrix": [[0,0,0],[0,0,0],[0,0,0]]}', "singular"),
        ("a.txt", "P0: 1 2 3\n", "P2: missing"),
        ("b.txt", "P2: 1 2 3\n", "12 numbers"),
        ("a.dat", "", ".yml"),
    ],
)
def test_bad_files_are_named(name: str, content: str | None, word: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=word) as stop:
        read_calibration(tmp_path / name)
    assert name in str(stop.value)
    assert "\n" not in str(stop.value)


def test_a_path_that_is_not_utf_8_is_refused(tmp_path: Path) -> None:
    """OpenCV would end the process."""
    path = tmp_path / os.fsdecode(b"\xff.yml")
    path.touch()
    with pytest.raises(UserError, match="OpenCV takes no path that is not UTF-8"):
        read_opencv(path)
