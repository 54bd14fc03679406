"""Find the camera of a view to which a calibrated camera was turned or zoomed, from the homography between both views.

A camera that only turns and zooms moves its image by K2 R inverse(K), independent of the scene. A camera that was also
moved shifts near and far objects differently, which no turn explains: this view is rejected.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.camera.motion.camera_motion import TURN_ANGLES, covariance_of_turns, turned_camera
from skope.camera.motion.view_registration import ViewHomography, is_inside, transformed
from skope.types import Array


@dataclass(frozen=True)
class TurnLimits:
    """Limits for accepting a homography as a turn of the camera."""

    residual_px: float = 0.5
    """Maximum root mean square distance of pixels from their position after a turn, per axis, in images
    `image_width_px` wide."""
    image_width_px: int = 1280
    """Image width to which `residual_px` refers, pixels."""
    near_m: float = 60.0
    """Distance within which the road distinguishes a turn from a move, metres."""
    fewest_near: int = 8
    """Minimum number of grid points on that road."""
    grid: tuple[int, int] = (24, 16)
    """Columns and rows of grid points at which the homography is compared with a turn."""


TURN_LIMITS: Final = TurnLimits()


@dataclass(frozen=True, eq=False)
class TurnedView:
    """Camera that was turned or zoomed, and the additional uncertainty of the turn."""

    camera: Camera
    zoom: float
    """Ratio of the focal length after to that before."""
    off_px: float
    """Distance of pixels from their position after turn and zoom, root mean square per axis."""
    added: dict[tuple[str, ...], Array]
    """Covariances that the turn adds, by the names of the camera's parameters."""


def turned_view(camera: Camera, homography: ViewHomography) -> TurnedView | None:
    """Find the camera after a turn or zoom.

    Args:
        camera: The camera before the turn, at the size of the images.
        homography: Homography from the view before to the view after.

    Returns:
        The camera; None if a turn and zoom do not explain the homography, or too little road is visible to distinguish
        a turn from a move.
    """
    size = (camera.width, camera.height)
    u, v = ((np.arange(count) + 0.5) / count * side for count, side in zip(TURN_LIMITS.grid, size, strict=True))
    before = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    after = transformed(homography.matrix, before)
    rays, valid = camera.rays(before)
    kept = is_inside(after, size) & valid
    before, after = before[kept], after[kept]
    distance = np.linalg.norm(intersect_ground(camera, before) - camera.position, axis=1)
    near = distance[distance < TURN_LIMITS.near_m]
    if len(near) < TURN_LIMITS.fewest_near:
        return None
    away = rays[kept] @ camera.T_camera_world[:3, :3] + camera.position
    allowed = max(
        TURN_LIMITS.residual_px * max(1.0, camera.width / TURN_LIMITS.image_width_px), 2 * homography.corner_error_px
    )
    for zooms in (False, True):
        turned, zoom, off_px = _turn(camera, away, after, homography.matrix, zooms=zooms)
        if off_px <= allowed:
            return TurnedView(turned, zoom, off_px, _added(turned, off_px, homography, float(np.median(near))))
    return None


def _turn(camera: Camera, away: Array, after: Array, matrix: Array, *, zooms: bool) -> tuple[Camera, float, float]:
    """Return the camera turned, and optionally zoomed, to map points `away` (N, 3) best to pixels `after` (N, 2).

    Returns the camera, its zoom, and the root mean square distance per axis, pixels.
    """
    middle = np.array([camera.width, camera.height]) / 2
    middle_after, across = (transformed(matrix, middle + step) for step in np.array([[0, 0], [1, 0.0]]))
    step = across - middle_after
    growth = math.log(float(np.linalg.norm(step))) if zooms else 0.0

    def seen_by(values: Array) -> Camera:
        turned = turned_camera(camera, *values[:3].tolist())
        K = turned.K.copy()
        K[:2, :2] *= math.exp(values[3]) if zooms else 1.0
        return replace(turned, K=K)

    def residuals(values: Array) -> Array:
        pixels, _, valid = seen_by(values).project(away)
        return np.where(valid[:, None], pixels - after, camera.width).ravel()

    begin = np.array([*(middle_after - middle), math.atan2(step[1], step[0]), growth])[: 4 if zooms else 3]
    solved = least_squares(residuals, begin, x_scale=np.array([1.0, 1.0, *2 * [2 / camera.width]])[: len(begin)])
    zoom = math.exp(solved.x[3]) if zooms else 1.0
    return seen_by(solved.x), zoom, float(np.sqrt((residuals(solved.x) ** 2).mean()))


def _added(turned: Camera, off_px: float, homography: ViewHomography, near_m: float) -> dict[tuple[str, ...], Array]:
    """Return the covariances of a turned camera's parameters from the pixel error of its turn.

    Args:
        turned: The turned camera.
        off_px: Distance of pixels from their position after the turn.
        homography: Homography from which the turn was computed.
        near_m: Distance of the road that distinguishes a turn from a move, metres.
    """
    error_px = math.hypot(off_px, homography.corner_error_px)
    error_turn = error_px / (turned.width / 2)
    # A move of the camera by this distance changes the image of that road by the same number of pixels.
    hidden_m = error_px * near_m / float(turned.K[0, 0])
    return {
        TURN_ANGLES: covariance_of_turns(turned, (error_px, error_px, error_turn)),
        ("x", "y", "z"): hidden_m**2 * np.eye(3),
        ("focal",): np.array([[error_turn**2]]),
    }
