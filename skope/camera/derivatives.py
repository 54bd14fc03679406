"""Derivatives of what has none in closed form."""

from collections.abc import Callable

import numpy as np

from skope.types import Array


def slopes(of: Callable[[Array], Array], at: Array, step: float) -> Array:
    """Differentiate a function of U numbers by central differences.

    Args:
        of: The function, from numbers (U,) to (...).
        at: (U,) the numbers at which it is differentiated.
        step: Step to either side in each of them, in their unit.

    Returns:
        (..., U) derivatives, the numbers along the last axis.
    """
    return np.stack([(of(at + one) - of(at - one)) / (2 * step) for one in step * np.eye(len(at))], axis=-1)
