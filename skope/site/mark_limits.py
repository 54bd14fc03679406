"""Limits of numbers in marks, and in what is known of a camera, for a site file and the page alike."""

from typing import Final

FARTHEST: Final = 1e8
"""Largest coordinate of a place, metres."""
WIDEST_PX: Final = 1e5
"""Largest column or row of a mark, pixels."""
LENGTH_M: Final = (0.01, 1e4)
VERTICAL_M: Final = (0.01, 1000.0)
SIGMA: Final = (1e-4, 1e3)
"""Of a mark's standard deviations, metres or pixels."""
KNOWN_RANGES: Final = {"fov_deg": (2.0, 170.0), "height_m": (0.5, 1000.0)}
"""Horizontal field of view, degrees, and the camera's height over the road, metres."""
LEAST_KNOWN_SIGMA: Final = 1e-4
"""Of values of `KNOWN_RANGES` and of a lens, in their units; they are as uncertain as their upper limit at most."""
LENS: Final = {"focal_px": (10.0, 1e5), "k1": (-2.0, 2.0)}
LONGEST_NAME: Final = 200
"""Letters of a name."""
MARKED_LENGTH_SIGMA_M: Final = 0.05
"""Standard deviation of a length where nothing is said of it, metres."""


def is_known(value: float, sigma: float, limits: tuple[float, float]) -> bool:
    """Whether a value with its standard deviation is one that a camera can have.

    Args:
        value: The value.
        sigma: Its standard deviation, in the same unit: from `LEAST_KNOWN_SIGMA` to the upper limit.
        limits: Least and largest value.
    """
    low, high = limits
    return low <= value <= high and LEAST_KNOWN_SIGMA <= sigma <= high
