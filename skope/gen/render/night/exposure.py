"""Metering: how a camera exposes a dark scene, and how much light its pixels then count.

The camera keeps its shutter and amplifies until the road has the brightness that it aims at, up to the greatest gain.
The figures are those of a common surveillance sensor: pixels of 4 micrometres behind a lens of F1.2 count about 20,000
electrons for each second at 1 cd/m2, and hold 15,000 (EMVA 1288 data of 1/1.8 inch sensors, rounded).
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.gen.render.daylight import Daylight
from skope.gen.scene.conditions import Conditions
from skope.types import Array

CANDELA_PER_UNIT: Final = 200.0
"""Luminance at night of a radiance of 1 in the renderer's units, cd/m2: street lights then give 5 to 25 lux."""
DAY_UNITS: Final = 50.0
"""How many times more luminance a radiance of 1 means by day (a sun of 100,000 lux has 10)."""
ROAD_LEVEL: Final = 0.12
"""Light, where the sensor's range ends at 1, that the road is exposed to at 0 EV: 112 of 255 after the curve."""
ELECTRONS_PER_CANDELA_SECOND: Final = 20_000.0
FULL_WELL_ELECTRONS: Final = 15_000.0
SHORT_EXPOSURE_RANGE: Final = 16.0
"""How much more light than the long exposure the short one takes."""
SINGLE_EXPOSURE_RANGE: Final = 6.0
"""The same for the whole range of a camera that takes one exposure: its curve rolls off to white there."""
_BALANCE: Final = (0.5, 2.0)
"""Least and greatest factor of the white balance: cameras leave a part of sodium lamps' colour."""
_METERED_FROM: Final = 1 / 3
"""Share of the rows above the part that is metered."""
_LAMPS_FROM: Final = 0.95
"""Pixels brighter than this share of the others are lamps, which the metering leaves out."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """How the camera exposes a scene."""

    gains: Array
    """(3,) factors on the light of each channel, after which the range of the long exposure ends at 1."""
    electrons: float
    """Electrons that a pixel counts at a light of 1."""
    short_share: float
    """Share of the short exposure in the blend; 0 for a camera that takes one exposure."""

    @property
    def full(self) -> float:
        """Light, after `gains`, at which the long exposure is full."""
        return 1.0 if self.short_share else SINGLE_EXPOSURE_RANGE

    @property
    def uniforms(self) -> dict[str, Any]:
        """Values for composite.frag.glsl, which works on the light before `gains`."""
        return {
            "u_full": self.full / float(self.gains.mean()),
            "u_short": (self.short_share, SHORT_EXPOSURE_RANGE),
        }


def metered(
    light: NDArray[np.float32], depth: NDArray[np.float32], conditions: Conditions, daylight: Daylight
) -> Exposure:
    """Meter the scenery without vehicles.

    Args:
        light: (H, W, 3) linear light, as `daylight` exposes it.
        depth: (H, W) metres, +inf for the sky.
        conditions: `exposure_ev`, `gain_db`, `shutter_s`, `auto_white_balance` and `short_exposure` are used.
        daylight: The light of the recording.
    """
    rows = slice(int(_METERED_FROM * len(light)), None, 4)
    part, ground = light[rows, ::4], np.isfinite(depth[rows, ::4])
    pixels = part[ground] if ground.any() else part.reshape(-1, 3)
    luminance = pixels.mean(axis=1)
    road = pixels[luminance <= np.quantile(luminance, _LAMPS_FROM)]
    level = max(float(np.median(road.mean(axis=1))), 1e-6)
    wanted = ROAD_LEVEL * 2**conditions.exposure_ev / level
    # Electrons for each unit of light, and with them the gain that `wanted` takes.
    electrons = CANDELA_PER_UNIT / daylight.exposure.mean() * conditions.shutter_s * ELECTRONS_PER_CANDELA_SECOND
    greatest = electrons * 10 ** (conditions.gain_db / 20) / FULL_WELL_ELECTRONS
    gain = min(wanted, greatest)
    color = np.maximum(np.median(road, axis=0), 1e-6)
    balance = np.clip((color.mean() / color) ** min(conditions.auto_white_balance, 1.0), *_BALANCE)
    return Exposure(gain * balance, float(electrons / gain), conditions.short_exposure)
