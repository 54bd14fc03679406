"""The camera files that skope writes: JSON with size, intrinsics, distortion, pose, and how well these are known."""

from pathlib import Path
from typing import Any

from skope.camera.model import Camera
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.files.json_files import read_json


def is_camera_json(path: Path) -> bool:
    """Whether a file is one of these; UserError where it is JSON by its name alone."""
    if path.suffix.lower() != ".json":
        return False
    document = read_json(path)
    return isinstance(document, dict) and "T_camera_world" in document


def camera_of_json(path: Path, document: dict[str, Any]) -> Camera:
    """The camera of a file's document. Raises UserError naming file and field."""
    try:
        return Camera.from_dict(document, int(document["width"]), int(document["height"]))
    except (KeyError, TypeError, OverflowError):
        raise UserError(f"{path}: width, height: expected whole numbers") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None


def read_uncertain_camera(path: Path) -> UncertainCamera | None:
    """The camera of a file with how well it is known; None where the file does not say that.

    Raises:
        UserError: The file cannot be read, or says it wrongly.
    """
    if not is_camera_json(path):
        return None
    document = read_json(path)
    return uncertain_of_json(path, document, camera_of_json(path, document))


def uncertain_of_json(path: Path, document: dict[str, Any], camera: Camera) -> UncertainCamera | None:
    """Read how well a camera is known: from `covariance`, or in older files from the share that distances are off by.

    Args:
        path: The file, for error messages.
        document: Its content.
        camera: The camera that it describes.

    Returns:
        The camera with its covariance; None where the document has neither.

    Raises:
        UserError: `covariance` is not one of a camera's parameters.
    """
    if isinstance(document.get("covariance"), dict):
        try:
            return UncertainCamera.from_dict(camera, document["covariance"])
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
    sigma = document.get("sigma")
    share = sigma.get("distance") if isinstance(sigma, dict) else None
    if isinstance(share, int | float) and not isinstance(share, bool) and 0 <= share < 1:
        return UncertainCamera.of_distances(camera, share)
    return None
