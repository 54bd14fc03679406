"""Whether two boxes in one picture are one road user's.

Detectors see many a vehicle twice, as its front and as its whole, and a rider as a bicycle, as a motorcycle and as
somebody on foot.
"""

from typing import Final

import numpy as np

from skope import boxes
from skope.types import Array

INSIDE: Final = 0.6
"""Two boxes are one road user's where so much of the smaller one lies in the other one,"""
FOOT: Final = 0.35
"""and they stand as near as this, in sizes of the larger one: its width, or half its height."""


def inside_and_apart(one: Array, other: Array) -> tuple[Array, Array]:
    """Share of the smaller of two boxes that lies in the other one, and their distance.

    Args:
        one: (N, 4) boxes: x, y, width, height, pixels.
        other: (N, 4) the others.

    Returns:
        (N,) shares from 0 to 1, and (N,) distances of the lower edges' middles in sizes of the larger box.
    """
    first, second = boxes.xywh_to_xyxy(one), boxes.xywh_to_xyxy(other)
    inside = np.maximum(boxes.share_inside_each(first, second), boxes.share_inside_each(second, first))
    size = np.maximum(one[:, 2:], other[:, 2:]) * [1.0, 0.5]
    apart = np.linalg.norm(feet(one) - feet(other), axis=1) / size.max(axis=1)
    return inside, apart


def feet(rectangles: Array) -> Array:
    """(N, 2) the middles of the lower edges of boxes (N, 4): x, y, width, height."""
    return np.asarray(rectangles[:, :2] + rectangles[:, 2:] * [0.5, 1.0])
