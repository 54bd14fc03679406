"""The interface between renderers and labels: a rendered frame and the protocol of renderers."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

SKY_ID: Final = -1
"""Id of pixels that show the sky."""
STATIC_ID: Final = 0
"""Id of pixels that show the ground or scenery."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A vehicle's pixels as if nothing stood before it, on a canvas of three times the image's width and height.

    All its visible pixels lie in the mask's rectangle.
    """

    x: int
    """Image column of the mask's first column; negative left of the image."""
    y: int
    """Image row of the mask's first row; negative above the image."""
    mask: NDArray[np.bool_]
    """(h, w)"""


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """One rendered frame of a moment's N road users. Depth and ids are sampled at pixel centres."""

    rgb: NDArray[np.uint8]
    """(H, W, 3) sRGB."""
    depth: NDArray[np.float32]
    """(H, W) planar z in metres, sky = +inf."""
    slope: NDArray[np.float32]
    """(H, W, 2) change of depth per pixel to the right and down on the surface shown, metres."""
    ids: NDArray[np.int32]
    """(H, W) `SKY_ID`, `STATIC_ID`, or i + 1 for the moment's i-th road user."""
    silhouettes: tuple[Silhouette, ...]
    """N silhouettes, in the order of the moment's road users."""
    contrast: NDArray[np.float64]
    """(N,) mean absolute difference over the visible pixels between the frame with and without the vehicle, before
    noise; 0 without visible pixels. Of 255 in what a renderer draws, in standard deviations of the noise in what the
    camera's sensor makes of it."""
    noise: NDArray[np.float32] | None = None
    """(256,) standard deviation of the camera's noise at each value of `rgb`, of 255, where it was metered; None where
    conditions alone give it."""


class Renderer(Protocol):
    """Draws the frames of one recording."""

    def render(self, frame: int) -> RenderedFrame:
        """Draw a frame by its number; the same number always gives the same pixels."""
        ...
