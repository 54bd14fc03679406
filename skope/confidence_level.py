"""The level of intervals of measured values, and the normal distribution."""

import math
from typing import Final

INTERVAL_LEVEL: Final = 0.90
"""Nominal coverage of the intervals of cameras, positions, speeds and counts."""
INTERVAL_SIGMAS: Final = 1.6448536269514722
"""Standard deviations on either side of a normal distribution's mean that hold `INTERVAL_LEVEL` of it."""


def at_most(z: float) -> float:
    """Probability of a standard normal number up to `z`."""
    return 0.5 * math.erfc(-z / math.sqrt(2))
