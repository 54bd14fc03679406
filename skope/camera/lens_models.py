"""Map names of lens models in the calibration files of other programs to skope's models."""

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.model import Distortion
from skope.errors import AssumptionWarning, UserError
from skope.types import Array

FISHEYE_NAMES: Final = ("fisheye", "equidistant", "kannala_brandt", "opencv_fisheye")
"""Names of the equidistant fisheye model."""
BROWN_NAMES: Final = ("plumb_bob", "radtan", "brown", "opencv", "rational_polynomial")
"""Names of Brown's model."""
_MODEL_OF: Final = {
    **dict.fromkeys((*FISHEYE_NAMES, "kannala_brandt4", "kannala_brandt8", "kb4", "kb8"), "fisheye"),
    **dict.fromkeys((*BROWN_NAMES, "brown_conrady", "radial_tangential", "full_opencv"), "brown"),
    **dict.fromkeys(("none", "no_distortion"), "none"),
}
"""Lens model by name, as in ROS, Kalibr, OpenCV, COLMAP, ORB-SLAM and RealSense."""
_MODEL_OF_LETTERS: Final = {name.replace("_", ""): model for name, model in _MODEL_OF.items()}
PROJECTION_NAMES: Final = ("", "pinhole", "simplepinhole", "perspective")
"""Names that do not determine the distortion, without underscores."""
MODEL_KEYS: Final = ("distortion_model", "fisheye_model", "camera_model", "model")
"""Keys under which files name the lens model."""
_DEVICE_KEY: Final = "model"
"""Key that may also hold the name of the device."""
SHARED_COUNT: Final = 4
"""Number of distortion coefficients that fits both Brown's model and the fisheye model."""


def lens_model(path: Path, values: Mapping[str, Any]) -> str | None:
    """Return the lens model that a calibration file names.

    Args:
        path: The file, for messages.
        values: Keys and values of the file.

    Returns:
        "fisheye", "brown" or "none"; None if the file names no model.

    Raises:
        UserError: A name is unknown, or two names contradict each other.
    """
    found: dict[str, str] = {}
    unknown = []
    for key in MODEL_KEYS:
        value = values.get(key)
        model = _model_of(key, value)
        if model:
            found[key] = model
        elif model is None:
            unknown.append(key)
    if found:
        unknown = [key for key in unknown if key != _DEVICE_KEY]
    if unknown:
        raise UserError(
            f"{path}: {unknown[0]}: {_shown(values[unknown[0]])} is no lens model that skope reads: expected one of "
            f"{', '.join(FISHEYE_NAMES)} (fisheye) or {', '.join(BROWN_NAMES)} (Brown)"
        )
    for key, next_key in zip(found, list(found)[1:], strict=False):
        if found[key] != found[next_key]:
            raise UserError(
                f"{path}: {key}: {_shown(values[key])} contradicts {next_key}: {_shown(values[next_key])}; expected "
                "one model"
            )
    return next(iter(found.values()), None)


def distortion(
    path: Path, coefficients: Array, values: Mapping[str, Any], *, K: Array, size: tuple[int, int] | None
) -> Distortion:
    """Return the lens distortion of a calibration file, with the model that it names.

    OpenCV's own files name no model. More than four coefficients can only be Brown's. Four coefficients are also read
    as Brown's, with an `AssumptionWarning`.

    Args:
        path: The file, for messages.
        coefficients: (N,) in OpenCV's order; N is 0 without distortion.
        values: Keys and values of the file.
        K: (3, 3) intrinsic matrix in skope's pixels.
        size: Width and height of the image, pixels; None: twice the principal point.

    Raises:
        UserError: The model is unknown, its number of coefficients differs, or no model is named and the four
            coefficients clearly belong to a fisheye lens.
    """
    model = lens_model(path, values)
    # OpenCV also writes the two angles of a tilted sensor; without tilt they are zero.
    if len(coefficients) == 14 and not coefficients[12:].any():
        coefficients = coefficients[:12]
    if not coefficients.any() and model != "fisheye":
        return Distortion()
    if model == "none":
        key = next(key for key in MODEL_KEYS if _model_of(key, values.get(key)) == "none")
        raise UserError(f"{path}: distortion coefficients: expected none, as {key} is {_shown(values[key])}")
    if model is None and len(coefficients) == SHARED_COUNT:
        _assume_brown(path, coefficients, K, size)
    try:
        return Distortion(model or "brown", tuple(coefficients.tolist()))
    except UserError as error:
        text = str(error).replace("distortion.coefficients", "distortion coefficients")
        raise UserError(f"{path}: {text}") from None


def _assume_brown(path: Path, coefficients: Array, K: Array, size: tuple[int, int] | None) -> None:
    """Warn that four coefficients are read as Brown's.

    Raises UserError if only a fisheye lens can have such coefficients.
    """
    width, height = size or (2 * K[0, 2], 2 * K[1, 2])
    x, y = np.meshgrid([0.0, width / 2, width], [0.0, height / 2, height])
    border = np.linalg.solve(K, np.stack([x.ravel(), y.ravel(), np.ones(x.size)]))[:2].T
    fits = {
        model: bool(Distortion(model, tuple(coefficients.tolist())).undistort(border)[1].all())
        for model in ("brown", "fisheye")
    }
    if fits["fisheye"] and not fits["brown"]:
        raise UserError(
            f"{path}: distortion coefficients: four without distortion_model fold the image as those of plumb_bob; "
            "add distortion_model: equidistant for a fisheye lens, else plumb_bob"
        )
    warnings.warn(
        f"{path}: distortion coefficients: four without distortion_model are read as k1, k2, p1, p2 of plumb_bob; "
        "for a fisheye lens add distortion_model: equidistant",
        AssumptionWarning,
        stacklevel=2,
    )


def _model_of(key: str, value: Any) -> str | None:
    """Return the model that a key names; "" if it names none, None if the name is unknown."""
    if value is None:
        return ""
    if key == "fisheye_model" and isinstance(value, int | float):
        return "fisheye" if value else "brown"
    letters = re.sub(r"[-_\s]", "", value).lower() if isinstance(value, str) else "?"
    return "" if letters in PROJECTION_NAMES else _MODEL_OF_LETTERS.get(letters)


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, int | float) else f"{value!r:.60}"
