"""Cauchy's distribution, whose heavy tails let a few wrong keypoints be."""

from typing import Final

import numpy as np

from skope.types import Array

_TAIL: Final = 9.0
"""Squared distance, in variances, at which a keypoint's weight is half."""


def cost(squared: Array) -> Array:
    """Twice the negative log likelihood of distances that are given squared and in variances, but for a constant."""
    return np.asarray(_TAIL * np.log1p(squared / _TAIL))


def weight(squared: Array) -> Array:
    """The weight of such distances in least squares that are iterated until they have the same minimum, 0 to 1."""
    return np.asarray(1 / (1 + squared / _TAIL))
