"""Light that lens and sensor spread around lamps: a point-spread function on linear light, before it is clipped.

The function is a sum of Gaussians: scatter in the lens and reflections between its faces leave a narrow core and long
tails (McCann and Rizzi, The Art and Science of HDR Imaging, 2011, ch. 11). Blue light spreads most and green least, as
lateral and axial colour errors show around small lamps.
"""

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.scene.conditions import Conditions

_SPREADS_PX: Final = (1.2, 3.0, 7.0, 16.0, 45.0)
"""Standard deviations in an image 1920 pixels wide."""
_SHARES: Final = np.array([0.010, 0.010, 0.008, 0.0025, 0.0008])
"""Share of a lamp's light in each, for a glare of 1. Equal shares would fall off with the
square of the distance; these fall off faster beyond 15 pixels."""
_COLORS: Final = np.array(
    [[1.0, 0.95, 1.1], [1.0, 0.9, 1.25], [1.0, 0.88, 1.35], [1.0, 0.9, 1.2], [1.0, 1.0, 1.0]], dtype=np.float32
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

    def spread(self, excess: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]] | None:
        """Three planes (H, W) of light that is added everywhere; None where there is none to spread.

        Args:
            excess: Three planes (H, W), red, green and blue, of the light beyond what pixels hold.
        """
        height, width = excess[0].shape
        size = (-(-width // 2), -(-height // 2))
        half = cv2.merge([cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in excess])
        if not half.any():
            return None
        total = np.zeros((size[1], size[0], 3), dtype=np.float32)
        for spread_px, share, color in zip(_SPREADS_PX, self._shares, _COLORS, strict=True):
            sigma = spread_px * self._scale / 2
            # The wider it is, the coarser the grid that it is worked out on.
            step = max(1, 2 ** int(np.log2(max(sigma / 2, 1.0))))
            coarse = (max(1, size[0] // step), max(1, size[1] // step))
            small = half if step == 1 else cv2.resize(half, coarse, interpolation=cv2.INTER_AREA)
            blurred = cv2.GaussianBlur(small, (0, 0), max(sigma / step, 0.5), borderType=cv2.BORDER_CONSTANT)
            if step > 1:
                blurred = cv2.resize(blurred, size, interpolation=cv2.INTER_LINEAR)
            total += blurred * (np.float32(share) * color)
        planes = cv2.split(total)
        return [np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR)) for plane in planes]
