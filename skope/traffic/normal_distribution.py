"""The normal distribution, as far as measures need it."""

import math
from typing import Final

COUNT_INTERVAL_LEVEL: Final = 0.90
"""All intervals shall hold the truth so often."""
INTERVAL_SIGMAS: Final = 1.6448536269514722
"""Standard deviations on either side of a normal distribution's middle that hold `COUNT_INTERVAL_LEVEL` of it."""


def at_most(z: float) -> float:
    """Probability of a standard normal number up to `z`."""
    return 0.5 * math.erfc(-z / math.sqrt(2))
