"""Types that the parts of the pose solver share: the road, and the poses from which a search begins."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.types import Array

IMPOSSIBLE: Final = 1e9
"""Cost of what cannot be."""


@dataclass(frozen=True)
class Ground:
    """The road near the vehicles: a plane in the world, and how far vehicles deviate from it."""

    height: float = 0.0
    """z of the plane at `about`, metres."""
    height_sigma: float = 0.04
    """Standard deviation of the road's height over the plane, metres."""
    tilt_sigma: float = math.radians(1.0)
    """Standard deviation of the lean of a vehicle's upright axis from the plane's normal, radians: bumps and the
    suspension."""
    slope: tuple[float, float] = (0.0, 0.0)
    """Metres that the plane rises per metre along world x and y."""
    about: tuple[float, float] = (0.0, 0.0)
    """World x and y of the point at which the plane has `height`, metres."""

    @property
    def level(self) -> bool:
        """Whether the plane is horizontal."""
        return self.slope == (0.0, 0.0)

    @property
    def T_world_level(self) -> Array:  # noqa: N802 (poses are called so)
        """(4, 4) from a frame in which the plane is z = 0 and `about` the origin; its x is world x along the plane."""
        along = np.array([1.0, 0.0, self.slope[0]]) / math.hypot(1.0, self.slope[0])
        up = np.array([-self.slope[0], -self.slope[1], 1.0]) / math.hypot(*self.slope, 1.0)
        T = np.eye(4)
        T[:3, :3] = np.stack([along, np.cross(up, along), up], axis=1)
        T[:3, 3] = [*self.about, self.height]
        return T


@dataclass(frozen=True, eq=False)
class Starts:
    """Poses of N vehicles from J starts each."""

    p: Array
    """(N, J, 3) positions, metres."""
    R: Array
    """(N, J, 3, 3) from the vehicle's axes to the world's, or to the camera's where the ground is unknown."""
    cost: Array
    """(N, J) twice the negative log likelihood, roughly."""

    def take(self, chosen: NDArray[np.intp]) -> "Starts":
        """The starts `chosen` (N, J') of each vehicle."""
        row = np.arange(len(chosen))[:, None]
        return Starts(self.p[row, chosen], self.R[row, chosen], self.cost[row, chosen])

    def gathered(self, times: int) -> "Starts":
        """(N * times, J) -> (N, times * J): all starts of a vehicle in its row.

        `self` holds the N vehicles `times` times, one block after another.
        """
        n = len(self.p) // times

        def together(values: Array) -> Array:
            return np.asarray(np.moveaxis(values.reshape(times, n, *values.shape[1:]), 0, 1)).reshape(
                n, -1, *values.shape[2:]
            )

        return Starts(together(self.p), together(self.R), together(self.cost))
