"""Measure brightness and contrast of a video's frames, to find times without visibility."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from skope.camera.motion.view_changes import unpacked_look
from skope.types import Pixels


@dataclass(frozen=True)
class ContrastMeasure:
    """Settings for measuring the contrast of a frame."""

    square_px: int = 9
    """Side of the squares for measuring contrast, pixels of the small image."""
    black: float = 0.02
    """Brightness that is added to the denominator, so that noise in the dark does not count as contrast."""
    percentile: int = 75
    """Percentile of the squares' contrast that is reported; above the median, because an empty road has little
    contrast."""


CONTRAST_MEASURE: Final = ContrastMeasure()


def visibility_rows(looks: Sequence[tuple[float, str]]) -> list[list[float]]:
    """Return a row of time (s), brightness and contrast of each small image of `ViewSamples`."""
    return [[round(time_s, 4), *brightness_and_contrast(unpacked_look(packed))] for time_s, packed in looks]


def brightness_and_contrast(grey: Pixels) -> tuple[float, float]:
    """Return the mean brightness of a small grey image (H, W), from 0 to 1, and its contrast.

    Contrast is the standard deviation within a square divided by the square's brightness. The 75th percentile of all
    squares is returned.
    """
    values = grey.astype(np.float32) / 255
    size = (CONTRAST_MEASURE.square_px, CONTRAST_MEASURE.square_px)
    mean = cv2.blur(values, size)
    deviation = np.sqrt(np.maximum(cv2.blur(values * values, size) - mean * mean, 0))
    contrast = np.percentile(deviation / (mean + CONTRAST_MEASURE.black), CONTRAST_MEASURE.percentile)
    return round(float(values.mean()), 4), round(float(contrast), 4)
