"""Light that lens and sensor spread around lamps: a point-spread function on linear light, before it is clipped.

The function is a sum of Gaussians: scatter in the lens and reflections between its faces leave a narrow core and long
tails (McCann and Rizzi, The Art and Science of HDR Imaging, 2011, ch. 11). Blue light spreads most and green least, as
lateral and axial colour errors show around small lamps.
"""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.scene.conditions import Conditions

_SPREADS_PX: Final = (1.2, 3.0, 7.0, 16.0, 45.0)
"""Standard deviations in an image 1920 pixels wide."""
_SHARES: Final = np.array([0.006, 0.006, 0.006, 0.005, 0.002])
"""Share of a lamp's light in each, for a glare of 1. Equal shares fall off with the square of the distance."""
_COLORS: Final = np.array(
    [[1.0, 0.9, 1.2], [1.0, 0.75, 1.5], [1.0, 0.65, 1.9], [1.0, 0.75, 1.6], [1.0, 1.0, 1.0]], dtype=np.float32
)
"""(5, 3) factors on red, green and blue."""
_DIRT_SHARE: Final = 0.02
"""Share of light that the dirtiest glass spreads widest."""
_FOG_SHARE: Final = 0.12
"""Share that fog spreads over the two widest, at a visibility of `_FOG_M`."""
_FOG_M: Final = 200.0


class VeilingGlare:
    """Spreads light beyond what pixels hold."""

    def __init__(self, width: int, conditions: Conditions) -> None:
        """`width` is the image's, pixels."""
        self._scale = width / 1920
        fog = _FOG_SHARE * min(_FOG_M / conditions.visibility_m, 1.0)
        self._shares = conditions.glare * _SHARES
        self._shares[-2:] += 0.5 * fog
        self._shares[-1] += _DIRT_SHARE * conditions.lens_dirt

    def spread(self, excess: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W, 3) light that is added everywhere by `excess` (H, W, 3), the light beyond what pixels hold."""
        height, width = excess.shape[:2]
        total = np.zeros((-(-height // 2), -(-width // 2), 3), dtype=np.float32)
        half = cv2.resize(excess, total.shape[1::-1], interpolation=cv2.INTER_AREA)
        if not half.any():
            return np.zeros_like(excess)
        for spread_px, share, color in zip(_SPREADS_PX, self._shares, _COLORS, strict=True):
            sigma = spread_px * self._scale / 2
            # The wider it is, the coarser the grid that it is worked out on.
            step = max(1, 2 ** int(np.log2(max(sigma / 2, 1.0))))
            size = (max(1, half.shape[1] // step), max(1, half.shape[0] // step))
            small = half if step == 1 else cv2.resize(half, size, interpolation=cv2.INTER_AREA)
            blurred = cv2.GaussianBlur(small, (0, 0), max(sigma / step, 0.5), borderType=cv2.BORDER_CONSTANT)
            if step > 1:
                blurred = cv2.resize(blurred, total.shape[1::-1], interpolation=cv2.INTER_LINEAR)
            total += blurred * (np.float32(share) * color)
        return np.asarray(cv2.resize(total, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
