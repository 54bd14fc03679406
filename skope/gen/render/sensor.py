"""What the camera adds to a clean picture: the lens' distortion and the sensor's noise."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.recording import Recording
from skope.gen.render import Renderer, View
from skope.gen.render.lens import Lens

LEAST_NOISE: Final = 0.3
"""Rounding to whole values is noise of this standard deviation already."""
_SLACK: Final = 256
_ROUNDING: Final = 2
"""A picture that differs by less was not drawn over, of 255."""


class Sensor:
    """A renderer whose views are those of the recording's own camera."""

    def __init__(self, recording: Recording, make: Callable[[Recording], Renderer]) -> None:
        """`make` is given the recording with a camera that has no distortion."""
        self._recording = recording
        self._lens = None if recording.camera.distortion.model == "none" else Lens(recording.camera)
        seen, self._bent = recording, None
        if self._lens:
            photograph = recording.photograph
            straight = None if photograph is None else self._lens.straightened(photograph)
            self._bent = None if straight is None else self._lens.bent(straight)
            seen = replace(recording, camera=self._lens.pinhole, photograph=straight)
        self._clean = make(seen)

    def render(self, frame: int) -> View:
        """Draw a frame; its contrast is in units of the noise's sigma."""
        view = self._clean.render(frame)
        if self._lens:
            view = self._lens.bend(view)
        if self._recording.photograph is not None and self._bent is not None:
            # The photograph itself where nothing was drawn over it, for going through two warps blurs it.
            untouched = cv2.absdiff(view.rgb, self._bent).max(axis=-1, keepdims=True) <= _ROUNDING
            view = replace(view, rgb=np.where(untouched, self._recording.photograph, view.rgb))
        sigma = max(self._recording.conditions.noise, LEAST_NOISE)
        return replace(view, rgb=with_noise(view.rgb, self._recording, frame), contrast=view.contrast / sigma)


@lru_cache(maxsize=2)
def _field(height: int, width: int, sigma: float) -> NDArray[np.int16]:
    """Noise for an image and `_SLACK` pixels more on each axis."""
    rng = np.random.default_rng(5)
    noise = sigma * rng.standard_normal((height + _SLACK, width + _SLACK, 3), dtype=np.float32)
    return np.asarray(np.rint(noise), dtype=np.int16)


def with_noise(clean: NDArray[np.uint8], recording: Recording, frame: int) -> NDArray[np.uint8]:
    """(H, W, 3) with the noise of this frame, which depends on seed, site, recording and frame alone.

    A window of one field, at a place of its own in each frame: drawing 6 million numbers a frame would take longer
    than rendering it.
    """
    seed = [recording.seed, *recording.site.encode(), int(recording.name), frame]
    y, x = np.random.default_rng(seed).integers(0, _SLACK, 2)
    height, width = clean.shape[:2]
    noise = _field(height, width, recording.conditions.noise)[y : y + height, x : x + width]
    return np.asarray(cv2.add(clean, noise, dtype=cv2.CV_8U), dtype=np.uint8)
