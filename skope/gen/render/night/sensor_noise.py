"""Photon and read noise of a dark picture, and what denoising leaves of it.

Noise variance in electrons is the signal's own plus the reading's (EMVA 1288). Cameras average it over frames and
smooth it within areas between edges (Tomasi and Manduchi, Bilateral filtering, 1998). That takes the road's texture
away and leaves blotches of noise a few pixels wide.
"""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.render.night.exposure import Exposure
from skope.gen.scene.conditions import Conditions
from skope.types import Array, Pixels

_READ_ELECTRONS: Final = 2.5
_USUAL_NOISE: Final = 1.75
"""`Conditions.noise` of a usual sensor: others have more or less than the electrons say."""
_OVER_FRAMES: Final = 0.96
"""Share of the frames before in the average of the strongest denoising."""
_EDGE_DEVIATIONS: Final = 4.0
"""Differences of this many standard deviations of the noise are edges, which smoothing keeps."""
_LEAST_EDGE: Final = 32.0
"""Differences from which on they are edges for the strongest denoising, of 255, where noise is low."""
_SMOOTHED_PX: Final = (9, 4.0)
"""Width of the window within which areas are smoothed, and the standard deviation, in pixels of half the resolution."""
_DETAIL_SHARE: Final = 0.5
"""Finer differences than those of half the resolution are taken away up to this share of the least edge."""
BLOTCHES_PX: Final = 1.0
"""Standard deviation of the Gaussian that gives the noise that is left its blotches, pixels."""


def noise_by_value(conditions: Conditions, exposure: Exposure, light: Array, shown: Array) -> NDArray[np.float32]:
    """(256,) standard deviation of the noise at each value of a picture, of 255, after averaging over frames.

    Args:
        conditions: `noise` and `denoising` are used.
        exposure: How the picture is exposed.
        light: (N,) rising amounts of light after the exposure's gains.
        shown: (N,) values from 0 to 1 that the camera's curve shows them as.
    """
    rise = np.gradient(shown, light)
    electrons = light * exposure.electrons
    sigma = 255 * rise * np.sqrt(electrons + _READ_ELECTRONS**2) / exposure.electrons
    before = _OVER_FRAMES * np.sqrt(conditions.denoising)
    sigma *= conditions.noise / _USUAL_NOISE * np.sqrt((1 - before) / (1 + before))
    return np.asarray(np.interp(np.arange(256) / 255, shown, sigma), dtype=np.float32)


def denoised(rgb: Pixels, noise: NDArray[np.float32], conditions: Conditions) -> Pixels:
    """The picture (H, W, 3) without noise, smoothed between edges; `noise` is that of `noise_by_value`.

    It is smoothed at half its resolution. Pixels that differ from that by more than a threshold stay as they are.
    """
    if conditions.denoising <= 0:
        return rgb
    height, width = rgb.shape[:2]
    typical = float(np.median(noise[rgb[::16, ::16, 1]]))
    edge = conditions.denoising * max(_EDGE_DEVIATIONS * typical, _LEAST_EDGE)
    half = cv2.resize(rgb, (-(-width // 2), -(-height // 2)), interpolation=cv2.INTER_AREA)
    window, deviation = _SMOOTHED_PX
    flat = cv2.bilateralFilter(half, window, edge, deviation)
    smooth = cv2.resize(flat, (width, height), interpolation=cv2.INTER_LINEAR)
    red, green, blue = cv2.split(cv2.absdiff(rgb, smooth))
    kept = (cv2.max(cv2.max(red, green), blue) > _DETAIL_SHARE * edge).view(np.uint8)
    return np.asarray(cv2.copyTo(rgb, kept, smooth), dtype=np.uint8)
