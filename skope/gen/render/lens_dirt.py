"""Dirt on the glass before the lens: specks, smears and dried drops, which stay where they are through a recording."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.render.rain import smaller
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording
from skope.types import Pixels

_SPECKS: Final = 60
"""Specks of dust on the dirtiest glass."""
_SMEARS: Final = 14
"""Smears and dried drops on it."""
_SOFT: Final = 0.022
"""Blur behind dirt, as a share of the image's width: it is far out of focus."""
_DARKEST: Final = 0.45
"""Share of the light that a speck takes."""
_THICKEST: Final = 0.85
"""Share of the picture that is out of focus behind the thickest smear."""
_VEIL: Final = 0.16
"""Light from all over the picture that dirt spreads, as a share of what it takes."""


class LensDirt:
    """The dirt of one recording's camera."""

    def __init__(self, recording: Recording) -> None:
        amount = recording.conditions.lens_dirt
        self._sharp: Pixels | None = None
        if amount > 0:
            size = (recording.camera.width, recording.camera.height)
            cover, through = _dirt(size, amount, recording.rng(Stream.LENS_DIRT))
            # As bytes, of 255, in all channels: OpenCV multiplies those many times faster than numpy does numbers.
            self._sharp, self._soft = (_in_channels(share * through) for share in (1 - cover, cover))

    def soil(self, rgb: Pixels) -> Pixels:
        """The picture (H, W, 3) through the glass."""
        if self._sharp is None:
            return rgb
        height, width = rgb.shape[:2]
        small = smaller(rgb, 8)
        soft = cv2.GaussianBlur(small, (0, 0), _SOFT * small.shape[1]).astype(np.float32)
        mean = soft.mean(axis=(0, 1))
        soft = np.clip(soft * (1 - _VEIL) + _VEIL * 1.6 * mean, 0, 255).astype(np.uint8)
        soft = cv2.resize(soft, (width, height), interpolation=cv2.INTER_LINEAR)
        kept = cv2.multiply(rgb, self._sharp, scale=1 / 255)
        return np.asarray(cv2.add(kept, cv2.multiply(soft, self._soft, scale=1 / 255)), dtype=np.uint8)


def _in_channels(share: NDArray[np.float32]) -> Pixels:
    """(H, W) shares, 0 to 1 -> (H, W, 3) of 255."""
    return np.ascontiguousarray(np.broadcast_to(np.rint(255 * share)[..., None].astype(np.uint8), (*share.shape, 3)))


def _dirt(
    size: tuple[int, int], amount: float, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(H, W) share of the picture that is out of focus, and (H, W) share of the light that comes through."""
    width, height = size
    cover, dark = (np.zeros((height, width), dtype=np.float32) for _ in range(2))
    for x, y, big, tall, turn, thick in rng.uniform(0, 1, (rng.poisson(_SMEARS * amount), 6)).tolist():
        radius = width * (0.008 + 0.06 * big**3)
        axes = (radius, radius * (0.5 + 1.6 * tall * big))
        one = _blob(size, (x * width, y * height), axes, 180 * turn, 0.25 + 0.2 * big)
        cover = np.maximum(cover, one * (0.35 + 0.65 * thick))
    for x, y, big, thick in rng.uniform(0, 1, (rng.poisson(_SPECKS * amount), 4)).tolist():
        radius = width * (0.001 + 0.004 * big**2)
        dark = np.maximum(dark, _blob(size, (x * width, y * height), (radius, radius), 0.0, 0.6) * thick)
    # A film over all of it, thicker towards the lower rim, where water runs and dries.
    film = 0.12 * amount * (0.4 + 0.6 * np.linspace(0, 1, height, dtype=np.float32)[:, None] ** 3)
    cover = np.maximum(np.minimum(_THICKEST, cover * (0.5 + 0.5 * amount)), film)
    return np.asarray(cover, dtype=np.float32), np.asarray(1 - _DARKEST * dark, dtype=np.float32)


def _blob(
    size: tuple[int, int], center: tuple[float, float], axes: tuple[float, float], degrees: float, soft: float
) -> NDArray[np.float32]:
    """(H, W) 1 inside an ellipse, falling to 0 over `soft` of its smaller axis."""
    canvas = np.zeros((size[1], size[0]), dtype=np.uint8)
    (x, y), (a, b) = center, axes
    cv2.ellipse(canvas, ((x, y), (2 * a, 2 * b), degrees), 255, -1, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), max(soft * min(axes), 0.6)) / np.float32(255), dtype=np.float32)
