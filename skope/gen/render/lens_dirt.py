"""Dirt on the glass before the lens: specks, smears and dried drops, which stay where they are through a recording."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording

Image = NDArray[np.uint8]

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
        self._cover: NDArray[np.float32] | None = None
        if amount > 0:
            size = (recording.camera.width, recording.camera.height)
            self._cover, self._loss = _dirt(size, amount, recording.rng(Stream.LENS_DIRT))

    def soil(self, rgb: Image) -> Image:
        """The picture (H, W, 3) through the glass."""
        if self._cover is None:
            return rgb
        height, width = rgb.shape[:2]
        small = cv2.resize(rgb, (max(width // 8, 1), max(height // 8, 1)), interpolation=cv2.INTER_AREA)
        soft = cv2.GaussianBlur(small, (0, 0), _SOFT * small.shape[1]).astype(np.float32)
        mean = soft.mean(axis=(0, 1))
        soft = cv2.resize(soft * (1 - _VEIL) + _VEIL * 1.6 * mean, (width, height), interpolation=cv2.INTER_LINEAR)
        through = rgb + self._cover * (soft - rgb)
        return np.asarray(np.clip(through * self._loss, 0, 255), dtype=np.uint8)


def _dirt(
    size: tuple[int, int], amount: float, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(H, W, 1) share of the picture that is out of focus, and (H, W, 1) share of the light that comes through."""
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
    return np.ascontiguousarray(cover[..., None]), np.ascontiguousarray((1 - _DARKEST * dark)[..., None])


def _blob(
    size: tuple[int, int], center: tuple[float, float], axes: tuple[float, float], degrees: float, soft: float
) -> NDArray[np.float32]:
    """(H, W) 1 inside an ellipse, falling to 0 over `soft` of its smaller axis."""
    canvas = np.zeros((size[1], size[0]), dtype=np.uint8)
    (x, y), (a, b) = center, axes
    cv2.ellipse(canvas, ((x, y), (2 * a, 2 * b), degrees), 255, -1, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), max(soft * min(axes), 0.6)) / np.float32(255), dtype=np.float32)
