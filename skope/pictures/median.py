"""Median of images of one view: moving traffic disappears, stationary objects remain."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from skope.types import Pixels

_BLOCK_ROWS: Final = 16
"""Number of image rows that are processed together: they fit into the processor's cache."""
_BITS: Final = (128, 64, 32, 16, 8, 4, 2, 1)


def median_of(frames: Sequence[Pixels]) -> Pixels:
    """Return (H, W, 3) the median of frames of one size; of two middle values the upper one.

    The median is the largest value that at most half of the frames are below. It is found bit by bit, ten times as fast
    as by sorting.
    """
    road = np.empty_like(frames[0])
    for first in range(0, len(road), _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        block = np.stack([pixels[rows] for pixels in frames])
        median = np.zeros_like(block[0])
        for bit in _BITS:
            larger = median | np.uint8(bit)
            below = (block < larger).sum(axis=0, dtype=np.uint16)
            median = np.where(below <= len(frames) // 2, larger, median)
        road[rows] = median
    return road
