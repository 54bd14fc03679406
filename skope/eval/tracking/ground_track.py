"""Base of the tracks of vehicles and of other road users: motion over the road, and boxes in the image."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from skope.camera.uncertain_camera import UncertainCamera
from skope.eval.pose.camera_error import camera_errors
from skope.types import Array

_MOMENTS: Final = 48
"""So many moments of a track tell how the camera's error changes along it."""


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
    located: NDArray[np.bool_]
    """(M,) in which frames a place was taken; in the others position and speed follow from the frames around."""
    boxes: Array
    """(M, 4) boxes of the detections, x, y, width, height in pixels; NaN where the road user was missed."""
    scores: Array
    """(M,) scores of the detections; NaN where the road user was missed."""

    def under(self, known: UncertainCamera, slope: tuple[float, float] = (0.0, 0.0)) -> Self:
        """The track where what is known of the camera counts too, on a road that rises by `slope` along x and y."""
        # The camera's error changes slowly along a track: some of its moments tell the others.
        some = np.unique(np.linspace(0, len(self.times_s) - 1, _MOMENTS).astype(int))
        of_place, of_velocity = camera_errors(known, self.position[some], self.velocity[some], slope)
        speed = np.maximum(self.speed[some], 1e-9)
        along = self.velocity[some] / speed[:, None]
        worst = np.sqrt(np.linalg.eigvalsh(of_place)[:, -1])
        # Per metre that is driven: a share, which a standstill has none of.
        share = np.sqrt(np.einsum("ni,nij,nj->n", along, of_velocity, along)) / speed
        index = np.arange(len(self.times_s))
        return replace(
            self,
            position_sigma=np.hypot(self.position_sigma, np.interp(index, some, worst)),
            speed_sigma=np.hypot(self.speed_sigma, np.interp(index, some, share) * self.speed),
        )

    @cached_property
    def detected(self) -> NDArray[np.bool_]:
        """(M,) in which frames it has a box: it was detected there, or followed from other frames."""
        return np.isfinite(self.scores)

    @cached_property
    def speed(self) -> Array:
        """(M,) m/s."""
        return np.asarray(np.linalg.norm(self.velocity, axis=1))
