"""Axis-aligned boxes in continuous pixel coordinates: formats, clipping, overlaps.

`xywh` is COCO's [x, y, width, height], `xyxy` torchvision's [x0, y0, x1, y1]; all functions take (..., 4) arrays.
"""

import numpy as np
from numpy.typing import ArrayLike

from skope.types import Array


def xywh_to_xyxy(boxes: ArrayLike) -> Array:
    """Convert (..., 4) x, y, width, height to x0, y0, x1, y1."""
    b = np.asarray(boxes, dtype=np.float64)
    return np.concatenate([b[..., :2], b[..., :2] + b[..., 2:]], axis=-1)


def xyxy_to_xywh(boxes: ArrayLike) -> Array:
    """Convert (..., 4) x0, y0, x1, y1 to x, y, width, height."""
    b = np.asarray(boxes, dtype=np.float64)
    return np.concatenate([b[..., :2], b[..., 2:] - b[..., :2]], axis=-1)


def clip(boxes_xyxy: ArrayLike, width: float, height: float) -> Array:
    """Clip boxes to an image of `width` x `height` pixels.

    Args:
        boxes_xyxy: (..., 4) boxes, pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.

    Returns:
        (..., 4) the boxes with all edges inside the image; a box outside the image has no area.
    """
    b = np.asarray(boxes_xyxy, dtype=np.float64)
    return np.clip(b, 0.0, np.array([width, height, width, height], dtype=np.float64))


def area(boxes_xyxy: ArrayLike) -> Array:
    """Return (...,) areas; an inverted box has none."""
    b = np.asarray(boxes_xyxy, dtype=np.float64)
    return np.asarray(np.prod(np.maximum(b[..., 2:] - b[..., :2], 0.0), axis=-1))


def intersection(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """Return (N, M) intersection areas of N boxes and M boxes."""
    return _shared(*_crossed(a_xyxy, b_xyxy))


def iou(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """Return (N, M) intersection over union; 0 if both boxes are empty."""
    return iou_each(*_crossed(a_xyxy, b_xyxy))


def iou_each(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """Return (...,) intersection over union of boxes in two arrays (..., 4) that broadcast; 0 if both are empty."""
    shared = _shared(a_xyxy, b_xyxy)
    return _quotient(shared, area(a_xyxy) + area(b_xyxy) - shared)


def share_inside(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """Return (N, M) share of the area of each of N boxes inside each of M boxes; 0 for an empty box."""
    return share_inside_each(*_crossed(a_xyxy, b_xyxy))


def share_inside_each(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """Return (...,) share of each first box's area inside the second; arrays (..., 4) broadcast; 0 if empty."""
    shared = _shared(a_xyxy, b_xyxy)
    return _quotient(shared, np.broadcast_to(area(a_xyxy), shared.shape))


def _crossed(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> tuple[Array, Array]:
    a, b = np.asarray(a_xyxy, dtype=np.float64), np.asarray(b_xyxy, dtype=np.float64)
    return a.reshape(-1, 1, 4), b.reshape(1, -1, 4)


def _shared(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    a, b = np.asarray(a_xyxy, dtype=np.float64), np.asarray(b_xyxy, dtype=np.float64)
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    return np.asarray(np.prod(np.maximum(sides, 0.0), axis=-1))


def _quotient(numerator: Array, denominator: Array) -> Array:
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0)
