"""What the tracks of vehicles and of other road users have in common: motion over the road, and boxes in the image."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from skope.types import Array


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundTrack:
    """A road user over M frames."""

    number: int
    frames: NDArray[np.intp]
    times_s: Array
    position: Array
    """(M, 3) smoothed, world, on the ground, metres."""
    velocity: Array
    """(M, 2) m/s."""
    position_sigma: Array
    """(M,) standard deviation of the place in its worst direction, metres, given the ground; and given the camera,
    unless `under` was called."""
    speed_sigma: Array
    """(M,) standard deviation of the speed, m/s, given the same."""
    measured: NDArray[np.bool_]
    """(M,) in which frames a place was taken; in the others position and speed follow from the frames around."""
    boxes: Array
    """(M, 4) boxes of the detections, x, y, width, height in pixels; NaN where the road user was missed."""
    scores: Array
    """(M,) scores of the detections; NaN where the road user was missed."""

    def under(self, distance_sigma: float, foot: Array) -> Self:
        """The track where the camera, over `foot` (2,), makes distances wrong by a share of that standard deviation."""
        away = np.linalg.norm(self.position[:, :2] - foot, axis=1)
        return replace(
            self,
            position_sigma=np.hypot(self.position_sigma, distance_sigma * away),
            speed_sigma=np.hypot(self.speed_sigma, distance_sigma * self.speed),
        )

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(M,) in which frames it has a box: it was detected there, or followed from other frames."""
        return np.isfinite(self.scores)

    @cached_property
    def speed(self) -> Array:
        """(M,) m/s."""
        return np.asarray(np.linalg.norm(self.velocity, axis=1))
