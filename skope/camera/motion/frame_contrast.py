"""Brightness and contrast of a video's frames: whether the camera saw anything in them."""

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from skope.camera.motion.view_changes import unpacked_look
from skope.types import Pixels

_SQUARE_PX: Final = 9
"""Contrast is that of squares of so many pixels of the small picture."""
_BLACK: Final = 0.02
"""Brightness that is added where contrast is set against it: noise in the dark is no contrast."""
_CONTRAST_PERCENT: Final = 75
"""So many percent of the squares have less contrast than what is taken: an empty road has hardly any."""


def sight_rows(looks: Sequence[tuple[float, str]]) -> list[list[float]]:
    """A row of time (s), brightness and contrast of each small picture, as `Looks` takes them."""
    return [[round(time_s, 4), *brightness_and_contrast(unpacked_look(packed))] for time_s, packed in looks]


def brightness_and_contrast(grey: Pixels) -> tuple[float, float]:
    """Mean brightness of a small grey picture (H, W), from 0 to 1, and its contrast.

    Contrast is the standard deviation within a square over the square's brightness, of the square that three quarters
    of all have less than.
    """
    values = grey.astype(np.float32) / 255
    size = (_SQUARE_PX, _SQUARE_PX)
    mean = cv2.blur(values, size)
    deviation = np.sqrt(np.maximum(cv2.blur(values * values, size) - mean * mean, 0))
    contrast = np.percentile(deviation / (mean + _BLACK), _CONTRAST_PERCENT)
    return round(float(values.mean()), 4), round(float(contrast), 4)
