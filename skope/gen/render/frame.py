"""Interface between renderers and labels: a rendered frame and the renderer protocol."""

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
    """Pixels of a vehicle without any occlusion, on a canvas of three times the image's width and height.

    All its pixels on the canvas lie in the mask's rectangle.
    """

    x: int
    """Image column of the mask's first column; negative left of the image."""
    y: int
    """Image row of the mask's first row; negative above the image."""
    mask: NDArray[np.bool_]
    """(h, w) mask of the vehicle's pixels."""


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """Rendered frame with N road users. Depth and ids are sampled at pixel centres."""

    rgb: NDArray[np.uint8]
    """(H, W, 3) sRGB image."""
    depth: NDArray[np.float32]
    """(H, W) planar depth z, metres; +inf for the sky."""
    slope: NDArray[np.float32]
    """(H, W, 2) change of depth per pixel to the right and down on the visible surface, metres."""
    ids: NDArray[np.int32]
    """(H, W) `SKY_ID`, `STATIC_ID`, or i + 1 for the moment's i-th road user."""
    silhouettes: tuple[Silhouette, ...]
    """N silhouettes, in the order of the moment's road users."""
    contrast: NDArray[np.float64]
    """(N,) mean absolute difference between the frame with and without the vehicle over its visible pixels, before
    noise; 0 without visible pixels. Unit: grey levels (0 to 255) as rendered; multiples of the noise floor after
    `Sensor`."""
    noise: NDArray[np.float32] | None = None
    """(256,) standard deviation of the camera's noise at each value of `rgb`, grey levels (0 to 255). None if the
    noise follows from the conditions alone."""


class Renderer(Protocol):
    """Protocol of renderers, which draw the frames of one recording."""

    def render(self, frame: int) -> RenderedFrame:
        """Draw a frame by its number. The same number always gives the same pixels."""
        ...
