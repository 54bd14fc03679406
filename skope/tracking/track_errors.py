"""The error of a road user's own height, which a track's filter does not know, as it lasts.

The filter takes the errors of poses for independent, so that many poses make a position certain. But a vehicle stands
above or below the plane that the road is taken for, and is a little higher or lower than its shape says, all the way:
from a camera of height H over the road it seems nearer or farther by (distance / H) metres per metre of that.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from skope.tracks.track import Track
from skope.types import Array

_LOWEST_CAMERA_M: Final = 1.0
"""Least height of a camera over the road, metres."""


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
