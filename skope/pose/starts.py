"""Poses from which the search for a vehicle's pose begins."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.types import Array

IMPOSSIBLE: Final = 1e9
"""Cost of what cannot be."""


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
