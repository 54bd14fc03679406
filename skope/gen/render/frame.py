"""What a renderer makes of a recording's frame; labels know nothing else of renderers."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

SKY: Final = -1
STATIC: Final = 0


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A vehicle's pixels as if nothing stood before it, on a canvas of three times the image's width and height.

    All its visible pixels lie in the mask's rectangle.
    """

    x: int
    """Image column of the mask's first column; negative left of the image."""
    y: int
    mask: NDArray[np.bool_]
    """(h, w)"""


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """One rendered frame of N vehicles. Depth and ids are sampled at pixel centres."""

    rgb: NDArray[np.uint8]
    """(H, W, 3) sRGB."""
    depth: NDArray[np.float32]
    """(H, W) planar z in metres, sky = +inf."""
    slope: NDArray[np.float32]
    """(H, W, 2) change of depth per pixel to the right and down on the surface shown, metres."""
    ids: NDArray[np.int32]
    """(H, W) `SKY`, `STATIC`, or i + 1 for the frame's i-th vehicle."""
    silhouettes: tuple[Silhouette, ...]
    """N of them."""
    contrast: NDArray[np.float64]
    """(N,) mean absolute difference over the visible pixels between the frame with and without the vehicle, before
    noise, of 255; 0 without visible pixels."""


class Renderer(Protocol):
    """Draws the frames of one recording; the same frame always gives the same view."""

    def render(self, frame: int) -> RenderedFrame: ...
