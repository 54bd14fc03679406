"""Read the [camera] table of a site file: intrinsics, distortion and pose.

Intrinsics are one of `K`, `fov_deg` and `file`; those of a file are scaled from its image size to the camera's. The
pose is one of `T_camera_world`, `R` and `t` (x_camera = R x_world + t), `position` with `look_at` or `yaw_deg` and
`pitch_deg`, `points` (known in image and world), `ground` (the road as a plane in the camera frame, in a file) with
`position` and `yaw_deg`, and the file's own. `covariance` gives the uncertainty of all this, `calibrated` the time and
source of the calibration.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.calibration_files import (
    CameraCalibration,
    calibrated_seconds,
    camera_of_json,
    is_camera_json,
    over_plane,
    read_calibration,
    read_plane,
    read_uncertain_camera,
)
from skope.camera.model import Camera, Distortion
from skope.camera.pose_from_points import fit_camera_to_points
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.records import TomlTable
from skope.types import Array

ImageSize = tuple[int, int]

DEFAULT_SIZE_PX: Final = (1920, 1080)
WORST_CONTROL_POINT: Final = 0.05
"""Maximum reprojection error of a control point, as a share of the image's width. A larger one is a mistake."""


@dataclass(frozen=True, eq=False)
class OwnCamera:
    camera: Camera
    said: str
    """Sentence on the residuals of the control points; empty without any."""
    known: UncertainCamera | None = None
    """The camera with its covariance; None: the uncertainty is unknown."""
    calibrated: Mapping[str, Any] | None = None
    """`source` and `seconds` of the footage to which the pose belongs, if a camera file names them."""


def read_site_camera(table: TomlTable, picture: ImageSize | None) -> OwnCamera:
    """Read the camera of a table; `picture` is the photograph's size, the default of the camera's size."""
    try:
        made = _camera(table, picture)
        made = replace(made, known=_known(table, made.camera), calibrated=_calibrated_part(table))
    except UserError as error:
        raise error if str(error).startswith(str(table.path)) else table.wrong("", str(error)) from None
    _calibrated(table.table("calibrated"))
    table.done()
    return made


def _known(table: TomlTable, camera: Camera) -> UncertainCamera | None:
    """Return the camera with the covariance of the table, or of the file with the whole camera; None without one."""
    if "covariance" in table:
        covariance_table = table.table("covariance")
        covariance = {key: covariance_table.value(key) for key in ("of", "matrix")}
        covariance_table.done()
        return UncertainCamera.from_dict(camera, covariance)
    file = _file_of_pose(table)
    known = read_uncertain_camera(file) if file else None
    return UncertainCamera(camera, known.parameters, known.covariance) if known else None


def _calibrated_part(table: TomlTable) -> dict[str, Any] | None:
    """Return the part of the footage that the file of the pose names; None without one."""
    file = _file_of_pose(table)
    return calibrated_seconds(file) if file else None


def _file_of_pose(table: TomlTable) -> Path | None:
    """Return the camera file if it also gives the pose."""
    own_pose = ("T_camera_world", "R", "points", "ground", "position", "look_at")
    return None if any(key in table for key in own_pose) else table.file("file")


def _calibrated(table: TomlTable) -> None:
    """Check when and from what the camera was calibrated; this is only information for people."""
    when = table.value("when")
    if when is not None and not isinstance(when, datetime | str):
        raise table.wrong("when", "expected a time")
    table.text("from")


def _camera(table: TomlTable, picture: ImageSize | None) -> OwnCamera:
    file, raw = table.file("file"), table.flag("raw")
    read = _calibration(file, raw=raw) if file else None
    size = _size(table, read, picture)
    if sum(key in table for key in ("K", "fov_deg", "file")) > 1:
        raise table.wrong("", "expected one of K, fov_deg and file")
    K = _intrinsics(table, read, size)
    lens = _distortion(table, read)
    fixed = [key for key in ("T_camera_world", "R", "points", "ground", "look_at", "yaw_deg") if key in table]
    if "ground" in fixed and "yaw_deg" in fixed:
        fixed.remove("yaw_deg")
    if len(fixed) > 1:
        raise table.wrong("", f"its pose is given twice: by {' and by '.join(fixed)}")
    if "points" in table:
        return _from_points(table, size, K, lens)
    if K is None:
        raise table.wrong("", "expected one of K, fov_deg and file")
    return OwnCamera(Camera(*size, K, _pose(table, read, fixed), lens), "")


def _calibration(path: Path, *, raw: bool) -> CameraCalibration:
    """Read a camera file of skope or of another program."""
    if not is_camera_json(path):
        return read_calibration(path, raw=raw)
    camera = camera_of_json(path, read_json(path))
    return CameraCalibration(camera.K, camera.distortion, (camera.width, camera.height), camera.T_camera_world)


def _size(table: TomlTable, read: CameraCalibration | None, picture: ImageSize | None) -> ImageSize:
    if "size" in table:
        width, height = table.numbers("size", 2)
        if min(width, height) < 16 or max(width, height) > 8192 or width % 1 or height % 1:
            raise table.wrong("size", "expected width and height, 16 to 8192 whole pixels")
        return int(width), int(height)
    if read and read.size:
        return read.size
    return picture or DEFAULT_SIZE_PX


def _intrinsics(table: TomlTable, read: CameraCalibration | None, size: ImageSize) -> Array | None:
    if "K" in table:
        return np.array(table.matrix("K", 3, 3))
    if "fov_deg" in table:
        focal = size[0] / 2 / math.tan(math.radians(table.number("fov_deg", low=2, high=170)) / 2)
        return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    if read is None or read.size is None:
        return read.K if read else None
    return _scaled(table, read.K, read.size, size)


def _scaled(table: TomlTable, K: Array, calibrated: ImageSize, size: ImageSize) -> Array:
    """Scale intrinsics from a calibration's image size to the camera's. Distortion has no unit and is unchanged."""
    x, y = size[0] / calibrated[0], size[1] / calibrated[1]
    if abs(calibrated[1] * x - size[1]) > 1:
        raise table.wrong(
            "size",
            f"{size[0]}x{size[1]} has another shape than {calibrated[0]}x{calibrated[1]} of {table.file('file')}",
        )
    return np.diag([x, y, 1.0]) @ K


def _distortion(table: TomlTable, read: CameraCalibration | None) -> Distortion:
    if "distortion" not in table:
        return read.distortion if read else Distortion()
    distortion_table = table.table("distortion")
    model, values = distortion_table.text("model", "brown"), distortion_table.value("coefficients")
    if not isinstance(values, list):
        raise distortion_table.wrong("coefficients", "expected a list of numbers")
    coefficients = distortion_table.numbers("coefficients", len(values))
    distortion_table.done()
    return Distortion(model, coefficients)


def _pose(table: TomlTable, read: CameraCalibration | None, fixed: list[str]) -> Array:
    if "T_camera_world" in table:
        return np.array(table.matrix("T_camera_world", 4, 4))
    if "R" in table:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = table.matrix("R", 3, 3), table.numbers("t", 3)
        return T
    if (plane := table.file("ground")) is not None:
        x, y = table.numbers("position", 2) if "position" in table else (0.0, 0.0)
        return over_plane(read_plane(plane), position=(x, y), yaw=math.radians(table.number("yaw_deg", 0.0)))
    if fixed:
        return _hung(table)
    if read is None or read.T_camera_world is None:
        raise table.wrong(
            "", "its pose is missing: expected T_camera_world, R and t, points, ground, or position and look_at"
        )
    return read.T_camera_world


def _hung(table: TomlTable) -> Array:
    position = table.numbers("position", 3)
    roll = math.radians(table.number("roll_deg", 0.0, low=-180, high=180))
    if "look_at" in table:
        ahead = np.array(table.numbers("look_at", 3)) - position
        away = math.hypot(ahead[0], ahead[1])
        if away < 1e-6:
            raise table.wrong("look_at", "straight above or below the camera")
        yaw, pitch = math.atan2(ahead[1], ahead[0]), math.atan2(-ahead[2], away)
    else:
        yaw = math.radians(table.number("yaw_deg"))
        pitch = math.radians(table.number("pitch_deg", low=-89, high=89))
    return Camera.looking(position, yaw=yaw, pitch_down=pitch, roll=roll).T_camera_world


def _from_points(table: TomlTable, size: ImageSize, K: Array | None, lens: Distortion) -> OwnCamera:
    rows = table.value("points")
    if not isinstance(rows, list):
        raise table.wrong("points", "expected rows of [column, row, x, y, z]")
    values = np.array(table.matrix("points", len(rows), 5)).reshape(-1, 5)
    fit = fit_camera_to_points(values[:, :2], values[:, 2:], size, K=K, distortion=lens)
    worst = int(fit.errors_px.argmax())
    if fit.errors_px[worst] > WORST_CONTROL_POINT * size[0]:
        raise table.wrong(
            "points", f"point {worst + 1} is {fit.errors_px[worst]:.0f} px from where the best camera projects it"
        )
    x, y, z = fit.camera.position
    return OwnCamera(
        fit.camera,
        f"{len(rows)} control points, reprojection error {fit.rms_px:.2f} px (largest {fit.errors_px[worst]:.2f} px at "
        f"point {worst + 1}); focal length {fit.camera.K[0, 0]:.1f} px, at ({x:.2f}, {y:.2f}, {z:.2f}) m",
    )
