"""Read camera files: skope's own and those of OpenCV (FileStorage), ROS and Kalibr (YAML), TUMTraf and Rope3D.

skope's own format is JSON with size, intrinsics, distortion, pose and their uncertainty.

Other programs place the centre of a pixel at (col, row), `skope.camera.model` at (col + 0.5, row + 0.5). Half a pixel
is therefore added to their principal points. Poses transform world points to the camera, x_camera = R x_world + t,
metres.
"""

import math
import re
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from skope.camera import lens_models
from skope.camera.model import Camera, Distortion
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.files.atomic import decoded, read_bytes, read_text
from skope.files.json_files import read_json
from skope.files.safe_names import for_opencv
from skope.types import Array


def is_camera_json(path: Path) -> bool:
    """Return whether a file is a camera file of skope.

    Raises:
        UserError: The name ends in .json, but the file is not valid JSON.
    """
    if path.suffix.lower() != ".json":
        return False
    document = read_json(path)
    return isinstance(document, dict) and "T_camera_world" in document


def camera_of_json(path: Path, document: dict[str, Any]) -> Camera:
    """Return the camera of a file's document. Raises UserError with the file and the invalid field."""
    try:
        return Camera.from_dict(document, int(document["width"]), int(document["height"]))
    except (KeyError, TypeError, OverflowError):
        raise UserError(f"{path}: width, height: expected whole numbers") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None


def read_uncertain_camera(path: Path) -> UncertainCamera | None:
    """Read a camera with its uncertainty; None if the file has no covariance.

    Raises:
        UserError: The file cannot be read or is invalid.
    """
    if not is_camera_json(path):
        return None
    document = read_json(path)
    return uncertain_of_json(path, document, camera_of_json(path, document))


def calibrated_seconds(path: Path) -> dict[str, Any] | None:
    """Return `source` and `seconds` of the footage to which the calibration in a camera file belongs.

    None: the file does not name a part of footage. The calibration then belongs to the first view of any footage.

    Raises:
        UserError: The file cannot be read.
    """
    calibrated = read_json(path).get("calibrated") if is_camera_json(path) else None
    if not isinstance(calibrated, dict) or not {"source", "seconds"} <= calibrated.keys():
        return None
    return {key: calibrated[key] for key in ("source", "seconds")}


def uncertain_of_json(path: Path, document: dict[str, Any], camera: Camera) -> UncertainCamera | None:
    """Read the uncertainty of a camera from `covariance`.

    Args:
        path: The file, for error messages.
        document: Content of the file.
        camera: The camera of the document.

    Returns:
        The camera with its covariance; None if the document has none.

    Raises:
        UserError: `covariance` does not describe camera parameters.
    """
    if not isinstance(document.get("covariance"), dict):
        return None
    try:
        return UncertainCamera.from_dict(camera, document["covariance"])
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


_OPENCV_BEGINS: Final = (b"%YAML", b"<?xml", b"{")
"""First bytes of files that OpenCV reads unchanged."""
YAML_COMMENT: Final = re.compile(r"(^|\s)#[^\"']*$")
"""Comment in YAML. A # inside quotes does not start a comment."""
_K_NAMES: Final = ("camera_matrix", "cameraMatrix", "K", "intrinsic_matrix", "M1")
_DISTORTION_NAMES: Final = (
    *("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "D1"),
    *("distortion_coeffs", "distortion_vector"),
)
_ROTATION_NAMES: Final = ("rvec", "R", "rotation_matrix", "rotation")
_TRANSLATION_NAMES: Final = ("tvec", "t", "T", "translation_vector", "translation")


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Camera of a calibration file; None for missing values."""

    K: Array
    """(3, 3) intrinsic matrix in skope's pixels."""
    distortion: Distortion = field(default_factory=Distortion)
    size: tuple[int, int] | None = None
    """Width and height of the image, pixels."""
    T_camera_world: Array | None = None
    """(4, 4) from the world's axes to the camera's (x right, y down, z forward), metres."""


def read_calibration(path: Path, *, raw: bool = False) -> CameraCalibration:
    """Read a calibration file. Its format follows from its name.

    .yml, .yaml and .xml are OpenCV's, ROS's or Kalibr's, .json is TUMTraf's and .txt Rope3D's. Raises UserError naming
    file and field.

    Args:
        path: The file.
        raw: Whether the images of TUMTraf are raw, not undistorted; see `read_tumtraf`.
    """
    suffix = path.suffix.lower()
    if suffix in (".yml", ".yaml", ".xml"):
        return read_opencv(path)
    if suffix == ".json":
        return read_tumtraf(path, raw=raw)
    if suffix == ".txt":
        return read_rope3d(path)
    raise UserError(f"{path}: expected .yml, .yaml or .xml (OpenCV, ROS, Kalibr), .json (TUMTraf) or .txt (Rope3D)")


# --------------------------------------------------------------------------------------------------------------- opencv


def read_opencv(path: Path) -> CameraCalibration:
    """Read a file of `cv2.FileStorage`, as OpenCV's calibration program writes it, or YAML of ROS or Kalibr.

    The function reads the intrinsic matrix (`camera_matrix`, `cameraMatrix` or `K`; Kalibr's `intrinsics`),
    `distortion_coefficients` (`distCoeffs`, `D`) and the size (`image_width` and `image_height`, or `image_size`). It
    also reads rotation (`rvec` or `R`) and translation (`tvec`, `t` or `T`) if present. `distortion_model`,
    `fisheye_model` or `camera_model` names the lens model: see `skope.camera.lens_models`.
    """
    import cv2

    values = _single_camera(path, _storage(path))
    lens_models.lens_model(path, values)  # reject unknown models first, because their intrinsics may differ
    K = _first(values, _K_NAMES)
    focal_and_center = values.get("intrinsics")
    if K is None and focal_and_center is not None:
        fx, fy, cx, cy = _sized(path, "intrinsics", focal_and_center, 4)
        K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    if K is None:
        raise UserError(f"{path}: {_K_NAMES[0]}: missing")
    coefficients = _first(values, _DISTORTION_NAMES)
    size = _first(values, ("image_size", "image_Size", "resolution"))
    if size is None and {"image_width", "image_height"} <= values.keys():
        size = [values["image_width"], values["image_height"]]
    rotation, translation = _first(values, _ROTATION_NAMES), _first(values, _TRANSLATION_NAMES)
    pose = None
    if rotation is not None and translation is not None:
        turn = _array(path, "rotation", rotation)
        R = cv2.Rodrigues(turn.reshape(3))[0] if turn.size == 3 else turn
        pose = _pose(path, R, translation)
    intrinsics, width_height = _intrinsics(path, "camera_matrix", K), _size(path, size)
    given = () if coefficients is None else coefficients
    return CameraCalibration(
        intrinsics, _distortion(path, given, values, K=intrinsics, size=width_height), width_height, pose
    )


def _storage(path: Path) -> dict[str, Any]:
    """Return keys and values of a file. Raises UserError if OpenCV cannot read it."""
    import cv2

    data = read_bytes(path)  # raises UserError for a missing file, which OpenCV only logs
    address, flags = for_opencv(path), cv2.FILE_STORAGE_READ
    try:
        if not data.startswith(_OPENCV_BEGINS):
            address, flags = _as_opencv_yaml(decoded(data)), flags | cv2.FILE_STORAGE_MEMORY
        storage = cv2.FileStorage(address, flags)  # its nodes become invalid with it
        root = storage.root()
        return {key: _node(root.getNode(key)) for key in root.keys()}  # noqa: SIM118
    except (cv2.error, SystemError, ValueError):
        raise UserError(f"{path}: not a readable file of cv2.FileStorage, ROS or Kalibr") from None


def _as_opencv_yaml(text: str) -> str:
    """Convert YAML of other programs for OpenCV's reader: with its header, without comments, with indented lists.

    Raises ValueError if the first key is indented more than a later one: OpenCV's reader then never returns.
    """
    lines = [YAML_COMMENT.sub("", line).rstrip() for line in text.splitlines() if not line.startswith(("%", "---"))]
    body = textwrap.dedent("\n".join(re.sub(r"^( *)- ", r"\1  - ", line) for line in lines if line))
    if body[:1].isspace():
        raise ValueError("not YAML")
    return f"%YAML:1.0\n---\n{body}\n"


def _node(node: Any) -> Any:
    """Return the value of a FileStorage node: a number, text, list, matrix or dict; None for other types."""
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isMap():
        values = {key: _node(node.getNode(key)) for key in node.keys()}  # noqa: SIM118
        return _matrix(values) if {"rows", "cols", "data"} <= values.keys() else values.get("data", values)
    return [_node(node.at(i)) for i in range(node.size())] if node.isSeq() else None


def _matrix(values: Mapping[str, Any]) -> Any:
    """Return a matrix of OpenCV or ROS; a flat array if the number of values does not match rows and columns."""
    # OpenCV's FileNode.mat() writes out of bounds if a file gives wrong sizes.
    try:
        return np.reshape(values["data"], (int(values["rows"]), int(values["cols"])))
    except (TypeError, ValueError, OverflowError):
        return values["data"]


def _single_camera(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Return the only camera of a file, with or without a name (Kalibr's files have names).

    Raises UserError if the file has several cameras.
    """
    cameras = {key: value for key, value in values.items() if isinstance(value, dict) and "intrinsics" in value}
    if not cameras or _first(values, _K_NAMES) is not None:
        return values
    if len(cameras) > 1:
        raise UserError(f"{path}: expected one camera, got {', '.join(cameras)}")
    return next(iter(cameras.values()))


# -------------------------------------------------------------------------------------------------------------- tumtraf


def read_tumtraf(path: Path, *, raw: bool = False) -> CameraCalibration:
    """Read a calibration file of the TUM Traffic (A9) dataset.

    Its published images are undistorted and belong to `optimal_intrinsic_camera_matrix`. With `raw`, the images are
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
    K, size = _intrinsics(path, name, values[name]), _size(path, None if width is None else [width, height])
    lens = Distortion()
    if not undistorted:
        # The dataset's own files name no model; they use Brown's.
        named = {"distortion_model": "brown"} if lens_models.lens_model(path, values) is None else values
        lens = _distortion(path, values.get("dist_coefficients", ()), named, K=K, size=size)
    return CameraCalibration(K, lens, size, _pose(path, R, t) if has_pose else None)


# --------------------------------------------------------------------------------------------------------------- rope3d


def read_rope3d(path: Path) -> CameraCalibration:
    """Read a file of Rope3D's (KITTI's) `calib` folder: the line `P2:` with the twelve numbers of K [I | 0].

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
    """Read (4,) a, b, c, d of the road a x + b y + c z + d = 0 in the camera frame from a `denorm` file of Rope3D."""
    plane = _numbers(path, "plane", read_text(path), 4)
    length = float(np.linalg.norm(plane[:3]))
    if length < 1e-9:
        raise UserError(f"{path}: plane: its normal is zero")
    return plane / length


def over_plane(plane: ArrayLike, *, position: tuple[float, float], yaw: float, ground: float = 0.0) -> Array:
    """Return (4, 4) T_camera_world of a camera from the road plane ax + by + cz + d = 0 in its own frame.

    The normal may point up or down.

    Args:
        plane: (4,) a, b, c, d of the road in the camera's frame, with unit normal (a, b, c). If the normal points up, d
            is the camera's height in metres.
        position: World x and y of the camera, metres.
        yaw: Viewing direction, from world x towards y, radians.
        ground: World height of the road, metres.

    Returns:
        (4, 4) T_camera_world, metres.

    Raises:
        UserError: The camera is below the road.
    """
    *normal, height = np.asarray(plane, dtype=np.float64)
    up = np.asarray(normal)
    # The normal is flipped to point up; y points down in the camera frame.
    if up[1] > 0:
        up, height = -up, -height
    if height <= 0:
        raise UserError(f"plane: the camera is {-height:.2f} m below the road")
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
    if K.shape == (9,):
        K = K.reshape(3, 3)
    if K.ndim != 2 or K.shape not in ((3, 3), (3, 4)) or np.linalg.det(K[:, :3]) == 0 or K[2, 2] == 0:
        raise UserError(f"{path}: {name}: expected a 3x3 matrix, not singular")
    K = np.asarray(K[:, :3] / K[2, 2])
    K[:2, 2] += 0.5
    return K


def _distortion(
    path: Path, value: Any, values: Mapping[str, Any], *, K: Array, size: tuple[int, int] | None
) -> Distortion:
    coefficients = _array(path, "distortion coefficients", value).ravel()
    return lens_models.distortion(path, coefficients, values, K=K, size=size)


def _sized(path: Path, name: str, value: Any, count: int) -> Array:
    numbers = _array(path, name, value).ravel()
    if len(numbers) != count:
        raise UserError(f"{path}: {name}: expected {count} numbers, got {len(numbers)}")
    return numbers


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
    # Files have few digits, so the nearest rotation is used.
    u, _, v = np.linalg.svd(rotation)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ v, translation
    return T
