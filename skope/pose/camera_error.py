"""Add the camera's uncertainty to positions, headings and speeds, in the same way for poses and tracks.

The camera's error is common to all vehicles and does not help to distinguish them from frame to frame. It is therefore
added only to what is written.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.calibration_files import calibrated_seconds, read_uncertain_camera
from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.pose.estimate_pose import Poses
from skope.types import Array

CALIBRATED_FIELD: Final = "camera_calibrated"
"""Key in `info`: the footage and time span that the camera was calibrated on, as `skope eval predict` writes it."""
COVARIANCE_KEY: Final = "camera_covariance"
"""Key in `info` of the frames: the covariance of their camera."""


def camera_info(path: Path) -> dict[str, Any]:
    """Return the fields of frames' `info` on the uncertainty of the camera in a file."""
    known = read_uncertain_camera(path)
    seconds = calibrated_seconds(path)
    return {
        **({COVARIANCE_KEY: known.covariance_dict()} if known else {}),
        **({CALIBRATED_FIELD: seconds} if seconds else {}),
    }


def camera_of_info(name: str, info: Mapping[str, Any], camera: Camera | None) -> UncertainCamera | None:
    """Return the camera of frames with the covariance in their `info`; None if there is none.

    Args:
        name: The file's name, for errors.
        info: The `info` of the frames' file.
        camera: The camera of the frames.

    Raises:
        UserError: A field of `info` is malformed.
    """
    if camera is None:
        return None
    covariance = info.get(COVARIANCE_KEY)
    if not isinstance(covariance, Mapping):
        return None
    try:
        return UncertainCamera.from_dict(camera, covariance)
    except UserError as error:
        raise UserError(f"{name}: info.{COVARIANCE_KEY}: {error}") from None


def with_camera_error(poses: Poses, known: UncertainCamera | None, ground: Ground | None) -> Poses:
    """Add the camera's error to the covariances of poses.

    Args:
        poses: Poses with covariances for a known camera.
        known: The camera with its uncertainty; None: unknown, and the poses are returned unchanged.
        ground: The road; None: unknown, and the poses are returned unchanged.
    """
    if known is None or ground is None or not len(poses.covariance):
        return poses
    places = poses.T_world_vehicle[:, :3, 3]
    ahead = np.column_stack([np.cos(poses.yaw), np.sin(poses.yaw)])
    position_covariance, heading_covariance = camera_errors(known, places, ahead, ground.slope)
    covariance = poses.covariance.copy()
    covariance[:, :2, :2] += position_covariance
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    covariance[:, 3, 3] += np.einsum("ni,nij,nj->n", aside, heading_covariance, aside)
    return replace(poses, covariance=covariance)


def camera_errors(
    known: UncertainCamera, places: Array, velocities: Array, slope: tuple[float, float]
) -> tuple[Array, Array]:
    """Return the covariances of positions and velocities from the camera's error.

    If the camera does not see a position, the relative error of distances is used for its velocity.

    Args:
        known: The camera with its uncertainty.
        places: (N, 3) positions on the road, world, metres.
        velocities: (N, 2) velocities, m/s.
        slope: Rise of the road per metre along world x and y.

    Returns:
        (N, 2, 2) square metres, and (N, 2, 2) (m/s)^2.
    """
    position_covariance, velocity_covariance = (
        known.covariance_at(places, slope),
        known.covariance_of_velocities(places, velocities, slope),
    )
    blind = ~(np.isfinite(position_covariance) & np.isfinite(velocity_covariance)).all(axis=(1, 2))
    if blind.any():
        share = known.distance_sigma()
        away = np.linalg.norm(places[blind, :2] - known.camera.position[:2], axis=1)
        position_covariance[blind] = (share * away)[:, None, None] ** 2 * np.eye(2)
        velocity_covariance[blind] = (share * np.linalg.norm(velocities[blind], axis=1))[:, None, None] ** 2 * np.eye(2)
    return position_covariance, velocity_covariance
