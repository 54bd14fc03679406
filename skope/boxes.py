"""Axis-aligned boxes in continuous pixel coordinates: formats, clipping, overlaps.

`xywh` is COCO's [x, y, width, height], `xyxy` torchvision's [x0, y0, x1, y1]; all functions take (..., 4) arrays.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def xywh_to_xyxy(boxes: ArrayLike) -> Array:
    """(..., 4) x, y, width, height -> x0, y0, x1, y1."""
    b = np.asarray(boxes, dtype=np.float64)
    return np.concatenate([b[..., :2], b[..., :2] + b[..., 2:]], axis=-1)


def xyxy_to_xywh(boxes: ArrayLike) -> Array:
    """(..., 4) x0, y0, x1, y1 -> x, y, width, height."""
    b = np.asarray(boxes, dtype=np.float64)
    return np.concatenate([b[..., :2], b[..., 2:] - b[..., :2]], axis=-1)


def clip(boxes_xyxy: ArrayLike, width: float, height: float) -> Array:
    """Clip boxes to an image of `width` x `height` pixels."""
    b = np.asarray(boxes_xyxy, dtype=np.float64)
    return np.clip(b, 0.0, np.array([width, height, width, height], dtype=np.float64))


def area(boxes_xyxy: ArrayLike) -> Array:
    """(...,) areas; an inverted box has none."""
    b = np.asarray(boxes_xyxy, dtype=np.float64)
    return np.asarray(np.prod(np.maximum(b[..., 2:] - b[..., :2], 0.0), axis=-1))


def intersection(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """(N, M) areas shared by each of N boxes with each of M boxes."""
    a = np.asarray(a_xyxy, dtype=np.float64).reshape(-1, 1, 4)
    b = np.asarray(b_xyxy, dtype=np.float64).reshape(1, -1, 4)
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    return np.asarray(np.prod(np.maximum(sides, 0.0), axis=-1))


def iou(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """(N, M) intersection over union; 0 where both boxes are empty."""
    shared = intersection(a_xyxy, b_xyxy)
    union = area(a_xyxy).reshape(-1, 1) + area(b_xyxy).reshape(1, -1) - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def share_inside(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """(N, M) share of each of N boxes' own area that lies inside each of M boxes; 0 for an empty box."""
    shared = intersection(a_xyxy, b_xyxy)
    own = np.broadcast_to(area(a_xyxy).reshape(-1, 1), shared.shape)
    return np.divide(shared, own, out=np.zeros_like(shared), where=own > 0)
