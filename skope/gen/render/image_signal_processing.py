"""Processing in a camera before it sends its sensor's picture: contrast, black level, colour, sharpness."""

from typing import Final

import cv2
import numpy as np

from skope.gen.scene.conditions import Conditions
from skope.types import Pixels

_MIDDLE: Final = 118.0
"""The value that contrast leaves as it is, of 255: that of a surface which returns 18% of the light."""
_GREY: Final = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in a pixel's brightness (ITU-R BT.601)."""
_DETAIL_PX: Final = 1.2
"""Standard deviation of the Gaussian that the finest detail is told apart by, pixels of the stream."""


def processed(rgb: Pixels, conditions: Conditions) -> Pixels:
    """A picture (H, W, 3) as the camera sends it; the very same array where the camera changes nothing."""
    if conditions.contrast != 1 or conditions.black_level:
        rgb = _as_image(cv2.LUT(rgb, _tones(conditions.contrast, conditions.black_level)))
    if conditions.saturation != 1:
        grey = np.broadcast_to(_GREY, (3, 3))
        rgb = _as_image(cv2.transform(rgb, conditions.saturation * (np.eye(3) - grey) + grey))
    if conditions.sharpening:
        smooth = cv2.GaussianBlur(rgb, (0, 0), _DETAIL_PX)
        rgb = _as_image(cv2.addWeighted(rgb, 1 + conditions.sharpening, smooth, -conditions.sharpening, 0))
    return rgb


def _tones(contrast: float, black_level: float) -> Pixels:
    """(256,) what each value of the sensor's picture is shown as."""
    values = _MIDDLE + contrast * (np.arange(256) - _MIDDLE)
    lifted = black_level + (1 - black_level / 255) * np.clip(values, 0, 255)
    return np.asarray(np.rint(lifted), dtype=np.uint8)


def _as_image(rgb: object) -> Pixels:
    return np.asarray(rgb, dtype=np.uint8)
