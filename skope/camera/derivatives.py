"""Derivatives of what has none in closed form."""

from collections.abc import Callable

import numpy as np

from skope.types import Array


def slopes(of: Callable[[Array], Array], at: Array, step: float) -> Array:
    """(..., U) derivatives of a function (...) of numbers (U,), by central differences of `step` in each."""
    return np.stack([(of(at + one) - of(at - one)) / (2 * step) for one in step * np.eye(len(at))], axis=-1)
