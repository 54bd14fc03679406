"""Camera calibration from marks: points with known coordinates, lengths, parallels, and values of a site file."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from skope.camera.model import Camera
from skope.errors import UserError
from skope.records import check_number

if TYPE_CHECKING:
    from skope.camera.calibrate import SiteCalibration
    from skope.camera.fit.fit_camera import CameraEstimate
    from skope.camera.uncertain_camera import UncertainCamera


def calibrate_camera(
    marks: str | Path | tuple[ArrayLike, ArrayLike], size: tuple[int, int] | None = None
) -> "SiteCalibration":
    """Find a camera from marked points, as `skope eval camera --points` does.

    Args:
        marks: A site file with [calibration], a CSV or .otrfpts file of points; or a pair of arrays, (N, 2) pixels and
            (N, 3) places in the world, metres.
        size: Width and height of the image that was marked, pixels; needed but for a site file that says it.

    Returns:
        The calibration: its `camera`, how uncertain that is (`covariance`), which points are `outliers`, `residuals`
        and `warnings`.

    Raises:
        UserError: A file is malformed, or the marks do not tell a camera.
    """
    from skope.camera.calibrate import calibrate
    from skope.camera.evidence import Evidence, marked_points
    from skope.camera.fit.camera_from_marks import evidence_of

    if size is not None:
        for side in size:
            check_number("size", side, 1, math.inf)
    if isinstance(marks, str | Path):
        path = Path(marks)
        if size is None and path.suffix.lower() != ".toml":
            raise UserError(f"{path}: size: expected width and height of the image that was marked, got None")
        return calibrate(evidence_of(path, None if size is None else "{}x{}".format(*size)))
    if size is None:
        raise UserError("size: expected width and height of the image that was marked, got None")
    pixels, places = (np.asarray(values, dtype=np.float64) for values in marks)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or places.shape != (len(pixels), 3):
        raise UserError(f"marks: expected (N, 2) pixels and (N, 3) places, got {pixels.shape} and {places.shape}")
    return calibrate(Evidence(size, points=marked_points(pixels, places)))


def save_camera(path: str | Path, camera: "Camera | UncertainCamera | CameraEstimate") -> None:
    """Write a camera file, as `skope eval camera` does, with how well the camera is known where that is known.

    Args:
        path: The .json file, which must be new, or hold the same.
        camera: A camera, or what `calibrate_camera` or `Video.estimate_camera` gave.

    Raises:
        UserError: The file cannot be written, or holds something else.
    """
    from skope.camera.fit.camera_unknowns import UNKNOWN_NAMES
    from skope.camera.fit.write_camera import write_camera
    from skope.camera.uncertain_camera import UncertainCamera

    if isinstance(camera, Camera):
        bare, known = camera, {}
    elif isinstance(camera, UncertainCamera):
        bare, known = camera.camera, {"covariance": camera.covariance_dict()}
    else:
        bare = camera.camera
        known = {"covariance": {"of": list(UNKNOWN_NAMES), "matrix": camera.covariance.tolist()}}
    for _ in write_camera(Path(path), bare, known):
        pass
