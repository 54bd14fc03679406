"""The road under the vehicles, as far as it is known."""

import math
from dataclasses import dataclass

import numpy as np

from skope.types import Array


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
