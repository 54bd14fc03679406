"""Errors that a track's filter does not know: the road user's own, which lasts, and the camera's, which all share.

The filter takes the errors of poses for independent, so that many poses make a position certain. But a vehicle stands
above or below the plane that the road is taken for, and is a little higher or lower than its shape says, all the way:
from a camera of height H over the road it seems nearer or farther by (distance / H) metres per metre of that.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from skope.camera.uncertain_camera import UncertainCamera
from skope.eval.pose.camera_error import camera_errors
from skope.tracks.track import Track
from skope.types import Array

_LOWEST_CAMERA_M: Final = 1.0
"""Least height of a camera over the road, metres."""
_MOMENTS: Final = 48
"""Number of moments of a track at which the camera's error is computed; it changes slowly between them."""


def with_body_error(track: Track, camera_position: Array, height_sigma_m: float) -> Track:
    """The track with the error of its height over the road, along the line of sight, added to its `body_error`.

    Args:
        track: The track.
        camera_position: (3,) world, metres.
        height_sigma_m: Standard deviation of the height, metres.
    """
    line = track.xy - camera_position[:2]
    distance = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    height = np.maximum(_LOWEST_CAMERA_M, camera_position[2] - track.position[:, 2])
    ray = line / distance[:, None]
    # What seems farther by a share of the distance seems faster by that share, along the line of sight.
    towards = np.einsum("mi,mi->m", track.velocity, ray) ** 2 / np.maximum(track.speed, 1e-9)
    return replace(
        track,
        body_error=track.body_error + ray * (distance / height * height_sigma_m)[:, None],
        speed_sigma=np.hypot(track.speed_sigma, towards / height * height_sigma_m),
    )


def with_camera_error(track: Track, known: UncertainCamera, slope: tuple[float, float] = (0.0, 0.0)) -> Track:
    """The track with the camera's error in its covariance and speed errors: to show one track by itself.

    Never for measuring traffic: there the camera's error is one for all tracks.

    Args:
        track: The track.
        known: The camera and how well it is known.
        slope: Metres that the road rises per metre along world x and y.
    """
    rows = np.unique(np.linspace(0, len(track.times_s) - 1, _MOMENTS).astype(int))
    of_position, of_velocity = camera_errors(known, track.position[rows], track.velocity[rows], slope)
    speed = np.maximum(track.speed[rows], 1e-9)
    along = track.velocity[rows] / speed[:, None]
    # Relative to the speed: a standstill has none.
    share = np.sqrt(np.einsum("ni,nij,nj->n", along, of_velocity, along)) / speed
    index = np.arange(len(track.times_s))
    between = [np.interp(index, rows, of_position[:, i, j]) for i in range(2) for j in range(2)]
    return replace(
        track,
        covariance=track.covariance + np.stack(between, axis=1).reshape(-1, 2, 2),
        speed_sigma=np.hypot(track.speed_sigma, np.interp(index, rows, share) * track.speed),
    )
