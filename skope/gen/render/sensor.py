"""The image sensor's noise."""

from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.recording import Recording

NOISE_SIGMA: Final = 1.5
"""Standard deviation, of 255."""
_SLACK: Final = 256


@cache
def _field(height: int, width: int) -> NDArray[np.int16]:
    """Noise for an image and `_SLACK` pixels more on each axis, made once per process."""
    rng = np.random.default_rng(5)
    noise = NOISE_SIGMA * rng.standard_normal((height + _SLACK, width + _SLACK, 3), dtype=np.float32)
    return np.asarray(np.rint(noise), dtype=np.int16)


def with_noise(clean: NDArray[np.uint8], recording: Recording, frame: int) -> NDArray[np.uint8]:
    """(H, W, 3) with the noise of this frame, which depends on seed, site, recording and frame alone.

    A window of one field, at a place of its own in each frame: drawing 6 million numbers a frame would take longer
    than rendering it.
    """
    seed = [recording.seed, *recording.site.encode(), int(recording.name), frame]
    y, x = np.random.default_rng(seed).integers(0, _SLACK, 2)
    height, width = clean.shape[:2]
    noise = _field(height, width)[y : y + height, x : x + width]
    return np.asarray(cv2.add(clean, noise, dtype=cv2.CV_8U), dtype=np.uint8)
