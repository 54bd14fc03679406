"""Falling snow as a camera sees it: small soft flakes far away, large blurred ones near the glass."""

from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.render.rain import FIELD, fallen
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording
from skope.types import Pixels

_FLAKES: Final = 7000
"""Number of flakes in the field of a 1920x1080 image, in snow of 1 mm/h."""
_FALL: Final = 1.3
"""Speed at which flakes fall, m/s."""
_FLAKE_FOCAL_PX: Final = 1100.0
"""Focal length of the lens that flakes are sized by, pixels of an image 1920 wide."""
_SIZE: Final = 0.013
"""Typical flake, metres."""
_NEAREST: Final = 0.8
"""Nearest flakes to the camera, metres."""
_FARTHEST: Final = 9.0


class Snowfall:
    """The falling snow of one recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        conditions, camera = recording.conditions, recording.camera
        self._field = None
        if conditions.snowfall_mm_h > 0:
            wind = float(recording.rng(Stream.RAIN).uniform(-1.5, 1.5))
            shutter = max(conditions.shutter_s, 0.002)
            self._field = _flake_field((camera.width, camera.height), round(conditions.snowfall_mm_h, 3), wind, shutter)

    def fall(self, rgb: Pixels, frame: int) -> Pixels:
        """The picture (H, W, 3) of a frame with falling snow."""
        if self._field is None:
            return rgb
        return fallen(rgb, self._field, self._recording.rng(Stream.RAIN_IN_FRAME, frame))


@lru_cache(maxsize=2)
def _flake_field(size: tuple[int, int], rate: float, wind: float, shutter: float) -> Pixels:
    """A field of flakes, each as long as it moves while the shutter is open."""
    width, height = (round(FIELD * side) for side in size)
    scale = size[0] / 1920
    rng = np.random.default_rng(19)
    count = int(_FLAKES * rate**0.7)
    # Evenly in the volume before the camera: few are near.
    away = (rng.uniform(_NEAREST**3, _FARTHEST**3, count)) ** (1 / 3)
    radius = _SIZE * rng.uniform(0.4, 1.0, count) * _FLAKE_FOCAL_PX * scale / away / 2
    way = _FLAKE_FOCAL_PX * scale / away * shutter
    x, y = rng.uniform(0, width, count), rng.uniform(0, height, count)
    field: NDArray[Any] = np.zeros((height, width), dtype=np.uint8)
    for near in (False, True):
        layer = np.zeros_like(field)
        for k in np.flatnonzero((away < 3.0) == near).tolist():
            ends = np.array([[x[k], y[k]], [x[k] + wind * way[k], y[k] + _FALL * way[k]]])
            (x0, y0), (x1, y1) = np.rint(ends * 16).astype(int).tolist()
            # What is smaller than a pixel is fainter.
            strength = int(230 * min(1.0, (2 * radius[k]) ** 2 + 0.3) * (0.8 if near else 1.0))
            cv2.line(layer, (x0, y0), (x1, y1), strength, max(1, round(2 * radius[k])), cv2.LINE_AA, 4)
        blur = (2.2 if near else 0.6) * max(scale, 0.5)
        field = cv2.add(field, cv2.GaussianBlur(layer, (0, 0), blur))
    return np.asarray(field, dtype=np.uint8)
