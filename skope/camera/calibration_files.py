"""Camera calibrations from the files of others: OpenCV's FileStorage, TUMTraf's JSON, Rope3D's text files.

These count the centre of a pixel as (col, row), `skope.camera.model` as (col + 0.5, row + 0.5): half a pixel is added
to their principal points. Poses take world points to the camera, x_camera = R x_world + t, metres.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from skope.camera.model import Distortion
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.files.reading import read_bytes, read_text
from skope.files.safe_names import for_opencv
from skope.types import Array

CAMERA_FORMATS: Final = ("opencv", "tumtraf", "rope3d")
_K_NAMES: Final = ("camera_matrix", "cameraMatrix", "K", "intrinsic_matrix", "M1")
_DISTORTION_NAMES: Final = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "D1")
_ROTATION_NAMES: Final = ("rvec", "R", "rotation_matrix", "rotation")
_TRANSLATION_NAMES: Final = ("tvec", "t", "T", "translation_vector", "translation")
_FISHEYE_NAMES: Final = ("fisheye", "equidistant")


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A camera as a calibration file describes it; None for what the file does not say."""

    K: Array
    """(3, 3) intrinsic matrix in skope's pixels."""
    distortion: Distortion = field(default_factory=Distortion)
    size: tuple[int, int] | None = None
    """Width and height of the image, pixels."""
    T_camera_world: Array | None = None
    """(4, 4) from the world's axes to the camera's (x right, y down, z forward), metres."""


def read_calibration(path: Path, *, raw: bool = False) -> CameraCalibration:
    """The calibration in a file whose format its name tells: .yml, .yaml and .xml are OpenCV's, .json TUMTraf's,
    .txt Rope3D's. Raises UserError naming file and field."""
    suffix = path.suffix.lower()
    if suffix in (".yml", ".yaml", ".xml"):
        return read_opencv(path)
    if suffix == ".json":
        return read_tumtraf(path, raw=raw)
    if suffix == ".txt":
        return read_rope3d(path)
    raise UserError(f"{path}: expected .yml, .yaml or .xml (OpenCV), .json (TUMTraf) or .txt (Rope3D)")


# --------------------------------------------------------------------------------------------------------------- opencv


def read_opencv(path: Path) -> CameraCalibration:
    """A file of `cv2.FileStorage`, as OpenCV's calibration program writes it.

    Read are the intrinsic matrix (`camera_matrix`, `cameraMatrix` or `K`), `distortion_coefficients` (`distCoeffs`,
    `D`), the size (`image_width` and `image_height`, or `image_size`) and, where they stand there, rotation (`rvec` or
    `R`) and translation (`tvec`, `t` or `T`). `fisheye_model: 1` or `distortion_model: fisheye` (or `equidistant`)
    names OpenCV's fisheye model.
    """
    read_bytes(path)  # a missing file is a user's error; OpenCV only logs it
    address = for_opencv(path)
    try:
        storage = cv2.FileStorage(address, cv2.FILE_STORAGE_READ)
        root = storage.root()
        values = {key: _node(root.getNode(key)) for key in root.keys()}  # noqa: SIM118
    except (cv2.error, SystemError):
        raise UserError(f"{path}: not a readable cv2.FileStorage file") from None
    K = _first(values, _K_NAMES)
    if K is None:
        raise UserError(f"{path}: {_K_NAMES[0]}: missing")
    name = str(values.get("distortion_model", ""))
    fisheye = name in _FISHEYE_NAMES or values.get("fisheye_model") == 1
    coefficients = _first(values, _DISTORTION_NAMES)
    size = _first(values, ("image_size", "image_Size"))
    if size is None and {"image_width", "image_height"} <= values.keys():
        size = [values["image_width"], values["image_height"]]
    rotation, translation = _first(values, _ROTATION_NAMES), _first(values, _TRANSLATION_NAMES)
    pose = None
    if rotation is not None and translation is not None:
        turn = np.asarray(rotation, dtype=np.float64)
        R = cv2.Rodrigues(turn.reshape(3))[0] if turn.size == 3 else turn
        pose = _pose(path, R, translation)
    return CameraCalibration(
        _intrinsics(path, "camera_matrix", K),
        _distortion(path, () if coefficients is None else coefficients, fisheye=fisheye),
        _size(path, size),
        pose,
    )


def _node(node: Any) -> Any:
    """The value of a node of a FileStorage: a number, a text, an array, or None for what else there is."""
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isMap():
        return node.mat()
    return [_node(node.at(i)) for i in range(node.size())] if node.isSeq() else None


# -------------------------------------------------------------------------------------------------------------- tumtraf


def read_tumtraf(path: Path, *, raw: bool = False) -> CameraCalibration:
    """A calibration file of the TUM Traffic (A9) dataset.

    Its published images are undistorted: they belong to `optimal_intrinsic_camera_matrix`. With `raw`, the images are
    those of the camera: `intrinsic_camera_matrix` and `dist_coefficients` (k1, k2, p1, p2[, k3]). The pose is
    `rotation_matrix` and `translation_matrix`, the size `image_width` and `image_height`; matrices of -1 are unknown.
    """
    values = read_json(path)
    if not isinstance(values, dict):
        raise UserError(f"{path}: expected a JSON object")
    optimal = values.get("optimal_intrinsic_camera_matrix")
    undistorted = optimal is not None and not raw
    name = "optimal_intrinsic_camera_matrix" if undistorted else "intrinsic_camera_matrix"
    if values.get(name) is None:
        raise UserError(f"{path}: {name}: missing")
    R, t = values.get("rotation_matrix"), values.get("translation_matrix")
    has_pose = R is not None and t is not None and not (np.asarray(R) == -1).all()
    width, height = values.get("image_width"), values.get("image_height")
    return CameraCalibration(
        _intrinsics(path, name, values[name]),
        Distortion() if undistorted else _distortion(path, values.get("dist_coefficients", ()), fisheye=False),
        _size(path, None if width is None else [width, height]),
        _pose(path, R, t) if has_pose else None,
    )


# --------------------------------------------------------------------------------------------------------------- rope3d


def read_rope3d(path: Path) -> CameraCalibration:
    """A file of Rope3D's (KITTI's) `calib` folder: the line `P2:` with the twelve numbers of K [I | 0].

    The pose comes from the plane in the file of the same name in `denorm`: see `read_plane` and `over_plane`.
    """
    for line in read_text(path).splitlines():
        name, _, rest = line.partition(":")
        if name.strip() == "P2":
            P = _numbers(path, "P2", rest, 12).reshape(3, 4)
            if np.abs(P[:, 3]).max() > 1e-6:
                raise UserError(f"{path}: P2: its last column is not zero")
            return CameraCalibration(_intrinsics(path, "P2", P))
    raise UserError(f"{path}: P2: missing")


def read_plane(path: Path) -> Array:
    """(4,) a, b, c, d of the road a x + b y + c z + d = 0 in the camera frame, as Rope3D's `denorm` files have it."""
    plane = _numbers(path, "plane", read_text(path), 4)
    length = float(np.linalg.norm(plane[:3]))
    if length < 1e-9:
        raise UserError(f"{path}: plane: its normal is zero")
    return plane / length


def over_plane(plane: ArrayLike, *, position: tuple[float, float], yaw: float, ground: float = 0.0) -> Array:
    """(4, 4) T_camera_world of a camera that sees the road as a plane ax + by + cz + d = 0 in its own frame.

    The normal may point up or down.

    Args:
        plane: (4,) a, b, c, d of the road in the camera's frame, of unit normal (a, b, c); d is the camera's height in
            metres where the normal points up.
        position: World x and y of the camera, metres.
        yaw: Direction in which it looks, from world x towards y, radians.
        ground: World height of the road, metres.

    Returns:
        (4, 4) T_camera_world, metres.

    Raises:
        UserError: The camera lies under the road.
    """
    *normal, height = np.asarray(plane, dtype=np.float64)
    up = np.asarray(normal)
    # Normals are written pointing up; y points down in the camera.
    if up[1] > 0:
        up, height = -up, -height
    if height <= 0:
        raise UserError(f"plane: the camera lies {-height:.2f} m under the road")
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead /= np.linalg.norm(ahead)
    left = np.cross(up, ahead)
    c, s = math.cos(yaw), math.sin(yaw)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([c * ahead - s * left, s * ahead + c * left, up])
    T[:3, 3] = -T[:3, :3] @ [*position, ground + height]
    return T


# -------------------------------------------------------------------------------------------------------------- parts


def _first(values: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((values[name] for name in names if values.get(name) is not None), None)


def _numbers(path: Path, name: str, text: str, count: int) -> Array:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if values.size != count or not np.isfinite(values).all():
        raise UserError(f"{path}: {name}: expected {count} numbers")
    return values


def _array(path: Path, name: str, value: Any) -> Array:
    try:
        out = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{path}: {name}: not a matrix of numbers") from None
    if not np.isfinite(out).all():
        raise UserError(f"{path}: {name}: not all are finite numbers")
    return out


def _intrinsics(path: Path, name: str, value: Any) -> Array:
    K: Array = _array(path, name, value)
    if K.ndim != 2 or K.shape not in ((3, 3), (3, 4)) or K[2, 2] == 0:
        raise UserError(f"{path}: {name}: expected a 3x3 matrix, not singular")
    K = np.asarray(K[:, :3] / K[2, 2])
    K[:2, 2] += 0.5
    return K


def _distortion(path: Path, value: Any, *, fisheye: bool) -> Distortion:
    coefficients = _array(path, "distortion coefficients", value).ravel()
    # OpenCV writes a tilted sensor's two angles too; without tilt they are zero.
    if len(coefficients) == 14 and not coefficients[12:].any():
        coefficients = coefficients[:12]
    if not coefficients.any():
        return Distortion()
    try:
        return Distortion("fisheye" if fisheye else "brown", tuple(coefficients.tolist()))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def _size(path: Path, value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    size = _array(path, "image size", value).ravel()
    if size.shape != (2,) or (size < 1).any():
        raise UserError(f"{path}: image size: expected width and height")
    return int(size[0]), int(size[1])


def _pose(path: Path, R: Any, t: Any) -> Array:
    rotation, translation = _array(path, "rotation", R), _array(path, "translation", t).ravel()
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise UserError(f"{path}: rotation, translation: expected 3x3 and 3 numbers")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        raise UserError(f"{path}: rotation: not a rotation matrix")
    # Files have few digits: the nearest rotation.
    u, _, v = np.linalg.svd(rotation)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ v, translation
    return T
