"""Plates and glass made unrecognisable, where keypoints say they are."""

from collections.abc import Iterable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.keypoints import INDEX
from skope.schema import Result

Pixels = NDArray[np.uint8]

_PARTS: Final = tuple(
    tuple(INDEX[name] for name in names)
    for names in (
        ("roof_front_right", "roof_front_left", "windscreen_base_left", "windscreen_base_right"),
        ("roof_rear_right", "roof_rear_left", "rear_window_base_left", "rear_window_base_right"),
        ("roof_front_right", "roof_rear_right", "rear_window_base_right", "windscreen_base_right"),
        ("roof_front_left", "roof_rear_left", "rear_window_base_left", "windscreen_base_left"),
        ("headlight_inner_right", "headlight_inner_left", "bumper_front_left", "bumper_front_right"),
        ("taillight_inner_right", "taillight_inner_left", "bumper_rear_left", "bumper_rear_right"),
    )
)
"""Windscreen, rear window, side windows, and the lower middle of either end, where plates are."""


def blurred(image: Pixels, found: Iterable[Result]) -> Pixels:
    """A copy of (H, W, 3) `image` with the glass and plates of `found` averaged away, hidden sides' too."""
    out = image.copy()
    for result in found:
        x, y, w, h = result.bbox
        x0, y0 = (int(max(0, v)) for v in (x - 0.1 * w, y - 0.1 * h))
        x1, y1 = int(min(image.shape[1], x + 1.1 * w)) + 1, int(min(image.shape[0], y + 1.1 * h)) + 1
        patch = out[y0:y1, x0:x1]
        if not patch.size:
            continue
        mask = np.zeros(patch.shape[:2], dtype=np.uint8)
        for part in _PARTS:
            corners = np.clip(result.keypoints[list(part), :2] - [x0, y0], -1e4, 1e4)
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(corners).astype(np.int32)), 1)
        # A plate is about a quarter of a vehicle's width: nothing smaller than an eighth survives.
        cells = 8
        small = cv2.resize(patch, (cells, cells), interpolation=cv2.INTER_AREA)
        flat = cv2.resize(small, (patch.shape[1], patch.shape[0]), interpolation=cv2.INTER_LINEAR)
        patch[mask > 0] = np.asarray(flat, dtype=np.uint8)[mask > 0]
    return out
