"""Calibration files name OpenCV's two lens models in many ways: each name is read as its model, others are rejected.

Pixels are compared with those of `cv2.projectPoints` and `cv2.fisheye.projectPoints`.
"""

import contextlib
import json
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import skope as door
from skope.camera.calibration_files import CameraCalibration, read_calibration
from skope.camera.model import Camera
from skope.errors import AssumptionWarning, UserError

pytestmark = pytest.mark.filterwarnings("error::skope.errors.AssumptionWarning")
K = np.array([[500.0, 0, 639.5], [0, 510.0, 359.5], [0, 0, 1]])
RVEC, TVEC = np.array([1.9, 0.7, -0.6]), np.array([0.3, 1.2, 8.0])
FISHEYE = (0.02, -0.01, 0.005, -0.002)
BROWN = (-0.12, 0.03, 0.001, -0.002)
FISHEYE_ALONE = (-0.1, 0.0, 0.03, 0.0)
"""As Brown's, these fold the image before its border; as a fisheye's they do not."""
POINTS = (np.random.default_rng(4).uniform([-5, -3, 6], [5, 3, 12], (50, 3)) - TVEC) @ cv2.Rodrigues(RVEC)[0]
"""(N, 3) in the world, in view of the camera."""


def opencv_pixels(fisheye: bool, coefficients: Any) -> np.ndarray:
    """(N, 2) pixels of `POINTS` by OpenCV; its pixels' centres are whole numbers."""
    D = np.array(coefficients, dtype=np.float64)
    if fisheye:
        pixels, _ = cv2.fisheye.projectPoints(POINTS[None], RVEC, TVEC, K, D)
    else:
        pixels, _ = cv2.projectPoints(POINTS, RVEC, TVEC, K, D)
    return np.asarray(pixels.reshape(-1, 2) + 0.5)


def file_storage(path: Path, coefficients: Any = FISHEYE, names: tuple[str, str] = ("K", "D"), **more: Any) -> Path:
    """A file of OpenCV's own, with a pose."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in {"image_width": 1280, "image_height": 720, **more}.items():
        storage.write(key, value)
    storage.write(names[0], K)
    if coefficients is not None:
        storage.write(names[1], np.array(coefficients, dtype=np.float64)[:, None])
    storage.write("R", cv2.Rodrigues(RVEC)[0])
    storage.write("t", TVEC)
    storage.release()
    return path


def check(read: CameraCalibration | Camera, fisheye: bool, coefficients: Any) -> None:
    """Compare a camera with OpenCV; what has no pose is given that of the points."""
    if isinstance(read, CameraCalibration):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(RVEC)[0], TVEC
        assert read.size == (1280, 720)
        assert read.T_camera_world is None
        read = Camera(*read.size, read.K, T, read.distortion)
    pixels, _, valid = read.project(POINTS)
    assert valid.all()
    np.testing.assert_allclose(pixels, opencv_pixels(fisheye, coefficients), atol=1e-6)
    assert np.abs(pixels - opencv_pixels(not fisheye, (*coefficients, 0, 0, 0, 0)[:4])).max() > 1


FISHEYE_NAMES: list[tuple[str, Any]] = [
    ("distortion_model", "equidistant"),
    ("distortion_model", "EQUIDISTANT"),
    ("distortion_model", "kannala_brandt"),
    ("distortion_model", "Kannala-Brandt"),
    ("distortion_model", "Kannala Brandt4"),
    ("distortion_model", "fisheye"),
    ("camera_model", "fisheye"),
    ("camera_model", "KannalaBrandt8"),
    ("camera_model", "OPENCV_FISHEYE"),
    ("model", "OPENCV_FISHEYE"),
    ("model", "opencv_fisheye"),
    ("fisheye_model", 1),
    ("fisheye_model", "equidistant"),
]


@pytest.mark.parametrize(("key", "name"), FISHEYE_NAMES)
@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_names_of_the_fisheye_model(key: str, name: Any, suffix: str, tmp_path: Path) -> None:
    camera = door.read_camera(file_storage(tmp_path / f"camera{suffix}", **{key: name}))
    assert camera.distortion.model == "fisheye"
    check(camera, True, FISHEYE)


@pytest.mark.parametrize(
    ("key", "name", "coefficients"),
    [
        ("distortion_model", "plumb_bob", (*BROWN, 0.004)),
        ("distortion_model", "plumb_bob", BROWN),
        ("distortion_model", "PLUMB_BOB", BROWN),
        ("distortion_model", "radtan", BROWN),
        ("distortion_model", "rational_polynomial", (*BROWN, 0.004, 0.01, -0.02, 0.003)),
        ("distortion_model", "Brown Conrady", BROWN),
        ("camera_model", "brown", BROWN),
        ("camera_model", "OPENCV", BROWN),
        ("model", "FULL_OPENCV", (*BROWN, 0.004, 0.01, -0.02, 0.003)),
        ("fisheye_model", 0, BROWN),
        ("camera_name", "north", (*BROWN, 0.004)),
    ],
)
def test_names_of_the_brown_model(key: str, name: Any, coefficients: tuple[float, ...], tmp_path: Path) -> None:
    camera = door.read_camera(file_storage(tmp_path / "camera.yml", coefficients, **{key: name}))
    assert camera.distortion.model == "brown"
    check(camera, False, coefficients)


def test_a_fisheye_lens_without_coefficients_is_no_pinhole(tmp_path: Path) -> None:
    camera = door.read_camera(file_storage(tmp_path / "camera.yml", (0, 0, 0, 0), distortion_model="equidistant"))
    check(camera, True, (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(UserError, match="distortion coefficients: fisheye takes 4 numbers, got 0"):
        door.read_camera(file_storage(tmp_path / "none.yml", None, distortion_model="equidistant"))
    with pytest.raises(UserError, match="distortion coefficients: fisheye takes 4 numbers, got 5"):
        door.read_camera(file_storage(tmp_path / "five.yml", (*FISHEYE, 0.1), distortion_model="equidistant"))


ROS = """\
# {model}, calibrated by hand
image_width: 1280
image_height: 720
camera_name: narrow_stereo/left  # of two
camera_matrix:
  rows: 3
  cols: 3
  data: [500., 0., 639.5, 0., 510., 359.5,
         0., 0., 1.]
distortion_model: {model}  # as ROS names it
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {coefficients}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [480., 0., 630., 0., 0., 490., 350., 0., 0., 0., 1., 0.]
"""
ROS_WITH_HEADER = """\
%YAML:1.0
---
image_width: 1280
image_height: 720
camera_matrix: {{ rows: 3, cols: 3, data: [500, 0, 639.5, 0, 510, 359.5, 0, 0, 1] }}
distortion_model: "{model}"
distortion_coefficients: {{ rows: 1, cols: {count}, data: {coefficients} }}
"""
KALIBR = """\
cam0:
  T_cam_imu:
  - [0.0148, -0.9998, 0.0041, -0.0216]
  - [0.9995, 0.0149, 0.0257, -0.0646]
  - [-0.0257, 0.0037, 0.9996, 0.0098]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: {coefficients}
  distortion_model: {model}
  intrinsics: [500.0, 510.0, 639.5, 359.5]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
"""


@pytest.mark.parametrize("ending", ["\n", "\r\n"], ids=["LF", "CRLF"])
@pytest.mark.parametrize(
    "text",
    [ROS, ROS_WITH_HEADER, KALIBR, "\ufeff" + ROS_WITH_HEADER, "---\n" + ROS],
    ids=["ROS", "ROS with a YAML header", "Kalibr", "byte order mark", "document mark"],
)
@pytest.mark.parametrize(("model", "coefficients"), [("equidistant", FISHEYE), ("radtan", BROWN), ("plumb_bob", BROWN)])
def test_files_of_ros_and_kalibr(
    text: str, model: str, coefficients: tuple[float, ...], ending: str, tmp_path: Path
) -> None:
    text = text.format(model=model, count=len(coefficients), coefficients=list(coefficients))
    (tmp_path / "camera.yaml").write_text(text, newline=ending)
    check(read_calibration(tmp_path / "camera.yaml"), model == "equidistant", coefficients)
    with pytest.raises(UserError, match="has no pose of the camera"):
        door.read_camera(tmp_path / "camera.yaml")


def test_yaml_that_is_no_calibration_is_named(tmp_path: Path) -> None:
    for text in (
        "camera_matrix: [1, 2\n",
        "camera_matrix:\n",
        "\0",
        "hello",
        "- 1\n- 2\n",
        "a: 1",
        "cam0: {a: 1}",
        "  a: 1\nb: 2\n",
    ):
        (tmp_path / "camera.yaml").write_text(text)
        with pytest.raises(
            UserError, match=r"camera\.yaml: (not a readable file|camera_matrix: (missing|not a matrix))"
        ):
            read_calibration(tmp_path / "camera.yaml")
    (tmp_path / "camera.yaml").write_text(ROS.format(model="radtan", count=4, coefficients=[0.1]))
    with pytest.raises(UserError, match="distortion coefficients: brown takes 4 or 5 or 8 or 12 numbers, got 1"):
        read_calibration(tmp_path / "camera.yaml")
    # OpenCV's own reading of such matrices corrupts memory.
    file_storage(tmp_path / "camera.yaml", BROWN, ("camera_matrix", "D"), distortion_model="radtan")
    text = (tmp_path / "camera.yaml").read_text()
    for line in ("   cols: 3\n", "   dt: d\n", "   rows: 3\n"):
        (tmp_path / "camera.yaml").write_text(text.replace(line, line.replace("3", "300") if "rows" in line else ""))
        with contextlib.suppress(UserError):
            assert read_calibration(tmp_path / "camera.yaml").K.shape == (3, 3)
    (tmp_path / "camera.yaml").write_text("K: [0, 0, 1, 0, 0, 1, 0, 0, 1]\nD: [0.1, 0.1, 0.1, 0.1]\n")
    with pytest.raises(UserError, match="expected a 3x3 matrix, not singular"):
        read_calibration(tmp_path / "camera.yaml")


def test_a_camera_info_message(tmp_path: Path) -> None:
    """As `rostopic echo` prints it: matrices are flat lists."""
    (tmp_path / "camera.yaml").write_text(
        "image_width: 1280\nimage_height: 720\ndistortion_model: equidistant\n"
        f"D: {list(FISHEYE)}\nK: {K.ravel().tolist()}\n"
    )
    check(read_calibration(tmp_path / "camera.yaml"), True, FISHEYE)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ROS.format(model="thin_prism_fisheye", count=4, coefficients=list(FISHEYE)), "distortion_model: 'thin_prism_"),
        (KALIBR.format(model="fov", coefficients=[0.9]), "distortion_model: 'fov'"),
        (KALIBR.format(model="radtan", coefficients=list(BROWN)).replace("pinhole", "omni"), "camera_model: 'omni'"),
        (ROS.format(model="inverse_brown_conrady", count=5, coefficients=[0.1] * 5), "'inverse_brown_conrady'"),
    ],
)
def test_a_model_that_is_not_known_is_rejected(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(UserError) as error:
        read_calibration(tmp_path / "camera.yaml")
    line = str(error.value)
    assert line.startswith(f"{tmp_path}/camera.yaml: ")
    assert "\n" not in line
    for word in (said, "equidistant", "kannala_brandt", "opencv_fisheye", "plumb_bob", "radtan", "rational_polynomial"):
        assert word in line


def test_the_name_of_a_device_is_no_lens_model(tmp_path: Path) -> None:
    """`model` may be that of the device where another key names the lens."""
    camera = door.read_camera(file_storage(tmp_path / "a.yml", model="AXIS M3058", distortion_model="equidistant"))
    assert camera.distortion.model == "fisheye"
    with pytest.raises(UserError, match="model: 'AXIS M3058' is no lens model"):
        door.read_camera(file_storage(tmp_path / "b.yml", model="AXIS M3058"))


def test_names_that_contradict_each_other_are_rejected(tmp_path: Path) -> None:
    path = file_storage(tmp_path / "a.yml", fisheye_model=0, distortion_model="equidistant")
    with pytest.raises(UserError, match="distortion_model: 'equidistant' contradicts fisheye_model: 0"):
        door.read_camera(path)
    path = file_storage(tmp_path / "b.yml", BROWN, distortion_model="none")
    with pytest.raises(UserError, match="distortion coefficients: expected none, as distortion_model is 'none'"):
        door.read_camera(path)


@pytest.mark.parametrize(("model", "fisheye"), [("equidistant", True), ("radtan", False)])
def test_json_files_name_their_model_too(model: str, fisheye: bool, tmp_path: Path) -> None:
    document = {
        "image_width": 1280,
        "image_height": 720,
        "intrinsic_camera_matrix": K.tolist(),
        "dist_coefficients": list(FISHEYE if fisheye else BROWN),
        "distortion_model": model,
    }
    (tmp_path / "a.json").write_text(json.dumps(document))
    check(read_calibration(tmp_path / "a.json", raw=True), fisheye, FISHEYE if fisheye else BROWN)
    document["distortion_model"] = "omni"
    (tmp_path / "a.json").write_text(json.dumps(document))
    with pytest.raises(UserError, match=r"a\.json: distortion_model: 'omni'"):
        read_calibration(tmp_path / "a.json", raw=True)


def test_four_coefficients_without_a_name_are_read_as_opencvs_with_a_warning(tmp_path: Path) -> None:
    path = file_storage(tmp_path / "camera.yml", BROWN)
    with pytest.warns(AssumptionWarning) as said:
        camera = door.read_camera(path)
    check(camera, False, BROWN)
    assert [str(one.message) for one in said] == [
        f"{path}: distortion coefficients: four without distortion_model are read as k1, k2, p1, p2 of plumb_bob; "
        "for a fisheye lens add distortion_model: equidistant"
    ]
    for harmless in ((0, 0, 0, 0), (*BROWN, 0.004)):
        assert door.read_camera(file_storage(path, harmless)).distortion.model != "fisheye"


def test_four_coefficients_that_only_a_fisheye_lens_can_have_are_rejected(tmp_path: Path) -> None:
    path = file_storage(tmp_path / "camera.yml", FISHEYE_ALONE)
    with pytest.raises(UserError, match="four without distortion_model fold the image as those of plumb_bob; add "):
        door.read_camera(path)
    check(door.read_camera(file_storage(path, FISHEYE_ALONE, distortion_model="fisheye")), True, FISHEYE_ALONE)


def test_several_cameras_are_not_chosen_from(tmp_path: Path) -> None:
    one = KALIBR.format(model="radtan", coefficients=list(BROWN))
    (tmp_path / "camchain.yaml").write_text(one + one.replace("cam0", "cam1"))
    with pytest.raises(UserError, match=r"camchain\.yaml: expected one camera, got cam0, cam1"):
        read_calibration(tmp_path / "camchain.yaml")


def test_the_command_says_what_it_assumes_and_rejects(skope: Any, tmp_path: Path) -> None:
    file_storage(tmp_path / "camera.yml", BROWN)
    (tmp_path / "site.toml").write_text('[camera]\nfile = "camera.yml"\n')
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        code, _, err = skope("eval", "traffic", "nowhere", "--site", "site.toml")
    assert code == 2
    assert "warning: camera.yml: distortion coefficients: four without distortion_model" in err
    assert "AssumptionWarning" not in err
    file_storage(tmp_path / "camera.yml", BROWN, distortion_model="omni")
    code, _, err = skope("eval", "traffic", "nowhere", "--site", "site.toml")
    assert code == 2
    assert err.startswith("skope: site.toml: camera: camera.yml: distortion_model: 'omni'")
    assert err.count("\n") == 1
