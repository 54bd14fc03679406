"""From the linear light of a night to the picture: exposures, veiling glare, curve."""

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.render.daylight import Daylight
from skope.gen.render.night.exposure import SHORT_EXPOSURE_RANGE, metered
from skope.gen.render.night.sensor_noise import noise_by_value
from skope.gen.render.night.veiling_glare import VeilingGlare
from skope.gen.scene.conditions import Conditions
from skope.types import Array, Pixels

_STEPS: Final = 4096
_BRIGHTEST: Final = 1.0 + SHORT_EXPOSURE_RANGE
"""Light at which the curve's table ends; the picture is white long before."""


class NightCamera:
    """A recording's camera, which meters the scenery once and develops each frame alike."""

    def __init__(
        self,
        light: NDArray[np.float32],
        depth: NDArray[np.float32],
        conditions: Conditions,
        daylight: Daylight,
    ) -> None:
        """`light` (H, W, 3) is the scenery's linear light without vehicles, `depth` (H, W) its depth, metres."""
        self.exposure = metered(light, depth, conditions, daylight)
        self._glare = VeilingGlare(light.shape[1], conditions)
        self._gains = np.append(self.exposure.gains, self.exposure.gains.mean()).astype(np.float32)
        steps = (np.arange(_STEPS) / (_STEPS - 1)) ** 2 * _BRIGHTEST
        shown = curve(steps)
        self._table = np.rint(255 * shown).astype(np.uint8)
        self.noise = noise_by_value(conditions, self.exposure, steps, shown)
        """(256,) standard deviation of the noise at each value of the picture, of 255."""

    @property
    def gain(self) -> float:
        """Mean factor on the light before it is developed."""
        return float(self._gains[3])

    @property
    def uniforms(self) -> dict[str, Any]:
        """Values for composite.frag.glsl."""
        return self.exposure.uniforms

    def without_glare(self, picture: NDArray[np.float32]) -> Pixels:
        """(h, w, 3) what a part of the picture shows without veiling glare; see `develop`."""
        *light, full = self._exposed(picture)
        return _merged([self._shown(np.minimum(one, full)) for one in light])

    def develop(self, picture: NDArray[np.float32]) -> Pixels:
        """(H, W, 3) the picture of a frame.

        Args:
            picture: (H, W, 4) linear light of the blended exposures, and the light at which their blend is full.
        """
        *light, full = self._exposed(picture)
        kept = [np.minimum(one, full) for one in light]
        veil = self._glare.spread([one - part for one, part in zip(light, kept, strict=True)])
        if veil is None:
            return _merged([self._shown(part) for part in kept])
        # What it adds to each exposure ends where that is full.
        share, shown = self.exposure.short_share, []
        for part, more in zip(kept, veil, strict=True):
            room = np.maximum(np.float32(self.exposure.full) - part, 0)
            added = (1 - share) * np.minimum(more, room)
            if share:
                added += share * np.minimum(more, np.float32(SHORT_EXPOSURE_RANGE))
            shown.append(self._shown(np.asarray(part + added, dtype=np.float32)))
        return _merged(shown)

    def _exposed(self, picture: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """The four planes of a picture after the camera's gains: OpenCV and numpy are fastest plane by plane."""
        planes = cv2.split(np.ascontiguousarray(picture))
        return [np.asarray(plane) * gain for plane, gain in zip(planes, self._gains, strict=True)]

    def _shown(self, light: NDArray[np.float32]) -> Pixels:
        """(h, w) values of a plane of light."""
        steps = np.asarray(cv2.sqrt(light * np.float32((_STEPS - 1) ** 2 / _BRIGHTEST)))
        return np.asarray(self._table[np.minimum(steps, _STEPS - 1).astype(np.uint16)])


def _merged(planes: Sequence[Pixels]) -> Pixels:
    return np.asarray(cv2.merge(planes), dtype=np.uint8)


def curve(light: Array) -> Array:
    """Values from 0 to 1 of a picture: Narkowicz' fit of the ACES filmic curve, then sRGB's, as display.glsl has it."""
    film = np.clip(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), 0, 1)
    return np.asarray(np.where(film <= 0.0031308, 12.92 * film, 1.055 * film ** (1 / 2.4) - 0.055))
