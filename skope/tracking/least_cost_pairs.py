"""Assignment of rows to columns at the least cost."""

from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from skope.types import Array

_OUT_OF_REACH: Final = 1e6
"""Stands for infinity, which the assignment does not take."""


def cheapest_pairs(cost: Array, below: float) -> list[tuple[int, int]]:
    """Pair rows with columns, one to one, at the least cost in total (Jonker and Volgenant's algorithm, of scipy).

    Args:
        cost: (N, M) what each pair costs, far less than a million; infinite where there can be none.
        below: Only pairs that cost less are returned.
    """
    pairs = zip(*linear_sum_assignment(np.minimum(cost, _OUT_OF_REACH)), strict=True)
    return [(int(row), int(column)) for row, column in pairs if cost[row, column] < below]
