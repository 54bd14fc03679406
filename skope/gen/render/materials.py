"""Colours of materials, lit: sRGB in 0..1."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.gen.conditions import OVERCAST, Conditions

RGB = tuple[float, float, float]

MATERIALS: Final[dict[str, RGB]] = {
    # ground
    "asphalt": (0.35, 0.35, 0.36),
    "marking": (0.86, 0.86, 0.83),
    "kerb": (0.62, 0.61, 0.58),
    "sidewalk": (0.56, 0.54, 0.51),
    "grass": (0.30, 0.38, 0.20),
    # scenery
    "brick": (0.47, 0.27, 0.21),
    "plaster": (0.79, 0.75, 0.66),
    "stone": (0.58, 0.56, 0.52),
    "tiles": (0.45, 0.24, 0.18),
    "slate": (0.30, 0.31, 0.34),
    "window": (0.20, 0.25, 0.30),
    "bark": (0.27, 0.21, 0.15),
    "leaves": (0.20, 0.33, 0.14),
    "pole": (0.45, 0.46, 0.47),
    # vehicles; "paint" is the vehicle's own colour
    "trim": (0.09, 0.09, 0.10),
    "glass": (0.12, 0.15, 0.18),
    "headlight": (0.90, 0.91, 0.90),
    "taillight": (0.52, 0.05, 0.05),
    "plate": (0.88, 0.87, 0.80),
    "grille": (0.05, 0.05, 0.05),
    "chrome": (0.74, 0.75, 0.77),
    "under": (0.03, 0.03, 0.03),
    "tyre": (0.07, 0.07, 0.07),
    "rim": (0.60, 0.61, 0.63),
}
GLOSS: Final[dict[str, float]] = {
    "paint": 0.25,
    "glass": 0.1,
    "headlight": 0.15,
    "taillight": 0.2,
    "chrome": 0.2,
    "rim": 0.35,
    "trim": 0.6,
    "grille": 0.6,
    "plate": 0.5,
}
"""Roughness of the materials that shine."""
BRAKE_LIGHT: Final = (1.0, 0.16, 0.12)
GROUND: Final = ("asphalt", "marking", "kerb", "sidewalk", "grass")


@dataclass(frozen=True)
class Light:
    """Sun and sky as a renderer without physics needs them."""

    direction: tuple[float, float, float]
    """Unit vector from the scene to the sun."""
    sun: float
    """Strength of the direct light."""
    ambient: float
    tint: RGB
    zenith: RGB
    horizon: RGB

    @classmethod
    def of(cls, conditions: Conditions) -> "Light":
        """Sun and sky under a recording's conditions."""
        elevation, azimuth = np.radians([conditions.sun_elevation_deg, conditions.sun_azimuth_deg])
        low = float(np.clip(1 - conditions.sun_elevation_deg / 35, 0, 1))
        if conditions.clouds > OVERCAST:
            level = 1 - 0.3 * low
            grey: RGB = (0.80 * level, 0.82 * level, 0.85 * level)
            return cls(
                (0.0, 0.0, 1.0), 0.25, 0.72 * level, (0.97, 0.99, 1.0), grey, (0.9 * level, 0.9 * level, 0.9 * level)
            )
        direction = (
            float(np.cos(elevation) * np.cos(azimuth)),
            float(np.cos(elevation) * np.sin(azimuth)),
            float(np.sin(elevation)),
        )
        tint = (1.0, 1.0 - 0.10 * low, 1.0 - 0.28 * low)
        zenith, horizon = (
            (0.38 - 0.1 * low, 0.58 - 0.14 * low, 0.86 - 0.2 * low),
            (0.80, 0.86 - 0.08 * low, 0.92 - 0.24 * low),
        )
        return cls(direction, 0.62 - 0.1 * low, 0.50 - 0.10 * low, tint, zenith, horizon)


def grain(positions: NDArray[np.float64]) -> NDArray[np.float32]:
    """Uneven brightness (H, W) around 1 at ground positions (H, W, 2), metres: worn and patched surfaces."""
    import cv2

    rng = np.random.default_rng(7)
    tile = np.zeros((512, 512), dtype=np.float32)
    for cells, amount in ((8, 0.05), (32, 0.04), (256, 0.05)):
        noise = rng.standard_normal((cells, cells)).astype(np.float32)
        tile += (
            amount * cv2.resize(np.tile(noise, (2, 2)), (1024, 1024), interpolation=cv2.INTER_CUBIC)[256:768, 256:768]
        )
    at = (positions * 16.0).astype(np.float32) % 512  # a tile is 32 m wide
    return np.asarray(1 + cv2.remap(tile, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))
