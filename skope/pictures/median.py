"""Median of images of one view: moving traffic disappears, stationary objects remain."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from skope.types import Pixels

_BLOCK_ROWS: Final = 64
"""Number of image rows that are processed together."""


def median_of(frames: Sequence[Pixels]) -> Pixels:
    """Return (H, W, 3) the median of frames of one size; of two middle values the upper one.

    It is computed in blocks of rows, because sorted copies of all frames would take gigabytes at 4K.
    """
    road = np.empty_like(frames[0])
    for first in range(0, len(road), _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        block = np.stack([pixels[rows] for pixels in frames])
        block.sort(axis=0)  # np.median is slower, and returns floats
        road[rows] = block[len(frames) // 2]
    return road
