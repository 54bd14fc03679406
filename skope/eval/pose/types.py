"""Words that the parts of the pose solver share: the road, and where a search begins."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

IMPOSSIBLE: Final = 1e9
"""Cost of what cannot be."""


@dataclass(frozen=True)
class Ground:
    """The road near the vehicles: a plane of the world, known so well."""

    height: float = 0.0
    """Its z where it is said to be `about`, metres."""
    height_sigma: float = 0.04
    tilt_sigma: float = math.radians(1.0)
    """How far a vehicle's upright axis leans from the plane's normal, radians: bumps and the suspension."""
    slope: tuple[float, float] = (0.0, 0.0)
    """Metres that it rises per metre along world x and y."""
    about: tuple[float, float] = (0.0, 0.0)
    """World x and y, metres."""

    @property
    def level(self) -> bool:
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
    """(N, J, 3)"""
    R: Array
    """(N, J, 3, 3)"""
    cost: Array
    """(N, J) twice the negative log likelihood, roughly."""

    def take(self, chosen: NDArray[np.intp]) -> "Starts":
        """Of each vehicle the starts `chosen` (N, J')."""
        row = np.arange(len(chosen))[:, None]
        return Starts(self.p[row, chosen], self.R[row, chosen], self.cost[row, chosen])

    def gathered(self, times: int) -> "Starts":
        """(N * times, J) -> (N, times * J): starts of vehicles that were repeated, one after another, as one's own."""
        n = len(self.p) // times

        def together(values: Array) -> Array:
            return np.asarray(np.moveaxis(values.reshape(times, n, *values.shape[1:]), 0, 1)).reshape(
                n, -1, *values.shape[2:]
            )

        return Starts(together(self.p), together(self.R), together(self.cost))
