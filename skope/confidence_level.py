"""Level of confidence intervals of measured values, and the normal distribution."""

import math
from typing import Final

INTERVAL_LEVEL: Final = 0.90
"""Nominal coverage of the intervals of cameras, positions, speeds and counts."""
INTERVAL_SIGMAS: Final = 1.6448536269514722
"""Number of standard deviations on either side of a normal distribution's mean that contain `INTERVAL_LEVEL` of it."""


def at_most(z: float) -> float:
    """Return the probability that a standard normal number is at most `z`."""
    return 0.5 * math.erfc(-z / math.sqrt(2))
