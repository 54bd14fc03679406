"""Colours of lit materials, sRGB in 0..1, and the palette of a town's scenery.

A palette has these colours, those of a season, or random colours in random patterns.
"""

import colorsys
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.gen.scene.conditions import DARK_DEG, OVERCAST_CLOUDS, Conditions
from skope.gen.towns.town import Town
from skope.gen.towns.town_style import style

COLOR_TYPE = tuple[float, float, float]

MATERIAL_COLORS: Final[dict[str, COLOR_TYPE]] = {
    # ground
    "asphalt": (0.36, 0.36, 0.37),
    "asphalt_worn": (0.372, 0.372, 0.38),
    "asphalt_polished": (0.383, 0.383, 0.388),
    "asphalt_patch": (0.27, 0.27, 0.285),
    "asphalt_old": (0.43, 0.425, 0.42),
    "bitumen": (0.14, 0.14, 0.15),
    "gutter": (0.47, 0.465, 0.45),
    "cover": (0.25, 0.24, 0.23),
    "marking": (0.86, 0.86, 0.83),
    "kerb": (0.64, 0.63, 0.60),
    "sidewalk": (0.57, 0.555, 0.53),
    "paving": (0.60, 0.50, 0.42),
    "tactile": (0.68, 0.62, 0.50),
    "gravel": (0.60, 0.57, 0.51),
    "soil": (0.31, 0.25, 0.19),
    "meadow": (0.42, 0.43, 0.24),
    "field_wheat": (0.58, 0.52, 0.36),
    "field_green": (0.31, 0.36, 0.20),
    "field_ploughed": (0.35, 0.30, 0.25),
    "grass": (0.35, 0.38, 0.24),
    # walls; patterns use the ranges "brick" to "brick_painted", "plaster" to "plaster_grey", "stone" to "sandstone"
    "brick": (0.55, 0.31, 0.24),
    "brick_brown": (0.43, 0.31, 0.25),
    "brick_buff": (0.70, 0.60, 0.44),
    "brick_painted": (0.84, 0.82, 0.77),
    "plaster": (0.83, 0.78, 0.67),
    "plaster_white": (0.87, 0.86, 0.83),
    "plaster_ochre": (0.83, 0.71, 0.50),
    "plaster_rose": (0.80, 0.62, 0.55),
    "plaster_sage": (0.66, 0.71, 0.61),
    "plaster_grey": (0.64, 0.65, 0.66),
    "concrete": (0.62, 0.61, 0.58),
    "dressing": (0.77, 0.74, 0.68),
    "stone": (0.60, 0.58, 0.53),
    "sandstone": (0.72, 0.62, 0.47),
    # sheet metal and boards
    "cladding_white": (0.82, 0.82, 0.80),
    "cladding_grey": (0.60, 0.62, 0.64),
    "cladding_blue": (0.36, 0.45, 0.56),
    "cladding_sand": (0.72, 0.66, 0.54),
    "cladding_red": (0.46, 0.17, 0.14),
    # roofs
    "tiles": (0.52, 0.33, 0.26),
    "tiles_brown": (0.42, 0.31, 0.26),
    "slate": (0.34, 0.36, 0.39),
    "felt": (0.40, 0.40, 0.40),
    # joinery, shops
    "window": (0.20, 0.24, 0.28),
    "shop_window": (0.24, 0.25, 0.26),
    "curtain": (0.66, 0.64, 0.60),
    "blind": (0.72, 0.68, 0.60),
    "frame": (0.88, 0.87, 0.84),
    "frame_dark": (0.20, 0.21, 0.22),
    "door_green": (0.12, 0.28, 0.20),
    "door_red": (0.48, 0.11, 0.10),
    "door_blue": (0.13, 0.22, 0.38),
    "door_oak": (0.45, 0.29, 0.16),
    "shutter_green": (0.22, 0.37, 0.28),
    "shutter_blue": (0.31, 0.42, 0.52),
    "shutter_brown": (0.37, 0.25, 0.17),
    "fascia_red": (0.55, 0.10, 0.10),
    "fascia_green": (0.08, 0.27, 0.18),
    "fascia_blue": (0.17, 0.25, 0.40),
    "fascia_black": (0.10, 0.10, 0.11),
    "fascia_cream": (0.85, 0.80, 0.66),
    "lettering": (0.90, 0.89, 0.85),
    "lettering_gold": (0.80, 0.64, 0.30),
    "lettering_dark": (0.18, 0.14, 0.12),
    "awning_red": (0.58, 0.20, 0.18),
    "awning_blue": (0.16, 0.27, 0.50),
    "awning_green": (0.14, 0.36, 0.24),
    # street furniture
    "pole": (0.45, 0.46, 0.47),
    "zinc": (0.58, 0.60, 0.62),
    "iron": (0.13, 0.13, 0.14),
    "balustrade": (0.55, 0.60, 0.62),
    "timber": (0.46, 0.34, 0.23),
    "cabinet": (0.36, 0.43, 0.37),
    "luminaire": (0.90, 0.89, 0.85),
    "enamel_red": (0.74, 0.08, 0.08),
    "sign_red": (0.74, 0.08, 0.08),
    "sign_white": (0.91, 0.91, 0.90),
    "sign_blue": (0.08, 0.24, 0.58),
    "sign_yellow": (0.93, 0.72, 0.10),
    "sign_green": (0.05, 0.36, 0.22),
    # near roads at night: "lamp_white" to "lamp_red" burn out to white, "lit_white" to "lit_dim" stay readable
    "lamp_white": (0.93, 0.92, 0.89),
    "lamp_warm": (0.93, 0.88, 0.76),
    "lamp_amber": (0.90, 0.55, 0.12),
    "lamp_red": (0.72, 0.06, 0.05),
    "lit_white": (0.90, 0.90, 0.90),
    "lit_warm": (0.92, 0.84, 0.64),
    "lit_amber": (0.92, 0.62, 0.10),
    "lit_yellow": (0.93, 0.76, 0.12),
    "lit_red": (0.76, 0.10, 0.09),
    "lit_green": (0.06, 0.52, 0.16),
    "lit_blue": (0.14, 0.32, 0.72),
    "lit_dim": (0.80, 0.82, 0.83),
    # plants
    "bark": (0.30, 0.24, 0.18),
    "bark_white": (0.74, 0.72, 0.67),
    "leaves": (0.28, 0.36, 0.17),
    "leaves_dark": (0.17, 0.26, 0.15),
    "leaves_lit": (0.36, 0.43, 0.20),
    "leaves_pale": (0.38, 0.44, 0.20),
    "hedge": (0.19, 0.26, 0.12),
    "woods": (0.20, 0.27, 0.14),
    # vehicles; "paint" is the vehicle's own colour, "livery" its second colour
    "livery": (0.80, 0.80, 0.78),
    "trim": (0.09, 0.09, 0.10),
    "gap": (0.045, 0.045, 0.05),
    "glass": (0.12, 0.15, 0.18),
    "glass_tinted": (0.05, 0.06, 0.07),
    "glass_lit": (0.12, 0.15, 0.18),
    "glass_mirror": (0.36, 0.40, 0.44),
    "lamp_clear": (0.36, 0.38, 0.40),
    "lamp_dark": (0.13, 0.135, 0.145),
    "daylight": (0.93, 0.95, 0.96),
    "headlight": (0.86, 0.88, 0.90),
    "taillight": (0.42, 0.012, 0.02),
    "brake_light": (0.70, 0.03, 0.03),
    "indicator_left": (0.80, 0.42, 0.10),
    "indicator_right": (0.80, 0.42, 0.10),
    "marker_white": (0.84, 0.84, 0.82),
    "marker_amber": (0.80, 0.46, 0.14),
    "marker_red": (0.55, 0.03, 0.03),
    "reverse_light": (0.80, 0.80, 0.78),
    "plate": (0.88, 0.87, 0.80),
    "grille": (0.05, 0.05, 0.05),
    "grille_slats": (0.05, 0.05, 0.05),
    "grille_bars": (0.05, 0.05, 0.05),
    "grille_mesh": (0.05, 0.05, 0.05),
    "sign": (0.94, 0.88, 0.62),
    "sign_taxi_red": (0.62, 0.14, 0.12),
    "sign_taxi_green": (0.22, 0.50, 0.30),
    "chrome": (0.74, 0.75, 0.77),
    "under": (0.03, 0.03, 0.03),
    "tyre": (0.07, 0.07, 0.07),
    "rim": (0.60, 0.61, 0.63),
    "disc": (0.22, 0.22, 0.23),
    "rail": (0.30, 0.31, 0.32),
    "box": (0.84, 0.84, 0.82),
    "bed": (0.16, 0.16, 0.17),
    "tarpaulin": (0.24, 0.32, 0.44),
    "display": (0.93, 0.62, 0.10),
    # inside vehicles
    "dashboard": (0.07, 0.07, 0.075),
    "seat": (0.15, 0.15, 0.16),
    "seat_lit": (0.15, 0.15, 0.16),
    "cabin_light": (0.70, 0.70, 0.68),
    "driver_skin": (0.62, 0.45, 0.36),
    "driver_clothes": (0.22, 0.26, 0.34),
    # details of single vehicles; "seam" is a gap between panels, darkened by its share of a distant pixel
    "plate_yellow": (0.86, 0.70, 0.10),
    "seam": (0.16, 0.16, 0.165),
}
MATERIAL_ROUGHNESS: Final[dict[str, float]] = {
    "window": 0.08,
    "shop_window": 0.08,
    "zinc": 0.45,
    "paint": 0.25,
    "livery": 0.3,
    "glass": 0.1,
    "glass_tinted": 0.1,
    "glass_lit": 0.1,
    "glass_mirror": 0.1,
    "lamp_clear": 0.12,
    "lamp_dark": 0.12,
    "daylight": 0.15,
    "headlight": 0.15,
    "taillight": 0.2,
    "brake_light": 0.2,
    "indicator_left": 0.2,
    "indicator_right": 0.2,
    "marker_white": 0.2,
    "marker_amber": 0.2,
    "marker_red": 0.2,
    "reverse_light": 0.2,
    "chrome": 0.2,
    "rim": 0.35,
    "rail": 0.4,
    "disc": 0.45,
    "box": 0.5,
    "trim": 0.6,
    "grille": 0.6,
    "grille_slats": 0.5,
    "grille_bars": 0.5,
    "grille_mesh": 0.5,
    "plate": 0.5,
    "plate_yellow": 0.5,
}
"""Roughness of glossy materials."""


@dataclass(frozen=True)
class MaterialPatterns:
    """Brake light, and random patterns of materials."""

    brake_light: tuple[float, float, float] = (1.0, 0.16, 0.12)
    """Colour of a lit brake lamp."""
    changed_share: float = 0.85
    """Share of materials that have a pattern in towns with patterns."""
    sizes_m: tuple[float, float] = (0.15, 6.0)
    """Minimum and maximum size of a pattern, metres."""


MATERIAL_PATTERNS: Final = MaterialPatterns()

GROUND_MATERIALS: Final = tuple(MATERIAL_COLORS)[: list(MATERIAL_COLORS).index("grass") + 1]
"""Materials that lie on the ground: the first entries of the table."""


def materials_between(first: str, last: str) -> tuple[str, ...]:
    """Return the names of the materials from `first` to `last` in the order of the table, both included."""
    order = list(MATERIAL_COLORS)
    return tuple(order[order.index(first) : order.index(last) + 1])


def named_color(material: str) -> COLOR_TYPE | None:
    """Return the colour in a material's name, such as "#a0b4c8"; None for a material of the table."""
    if not material.startswith("#"):
        return None
    red, green, blue = (int(material[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


@dataclass(frozen=True)
class Light:
    """Sun and sky for a renderer without a physical light model."""

    direction: tuple[float, float, float]
    """Unit vector from the scene to the sun."""
    sun: float
    """Strength of the direct light."""
    ambient: float
    tint: COLOR_TYPE
    zenith: COLOR_TYPE
    horizon: COLOR_TYPE
    shadows: bool = True
    haze_density: float = 0.0
    """Extinction of the air, 1/m."""

    @classmethod
    def of(cls, conditions: Conditions) -> "Light":
        """Return sun and sky under a recording's conditions."""
        light = cls._by_night(conditions) if conditions.sun_elevation_deg < DARK_DEG else cls._by_day(conditions)
        return replace(light, haze_density=-math.log(0.05) / conditions.visibility_m)

    @classmethod
    def _by_night(cls, conditions: Conditions) -> "Light":
        """Return even light from above, bluer and weaker the lower the sun is."""
        share = float(np.clip((DARK_DEG - conditions.sun_elevation_deg) / 12, 0, 1))
        level = 0.62 - 0.26 * share
        tint = (0.92 - 0.1 * share, 0.95 - 0.03 * share, 1.0)
        zenith = (0.5 * level * tint[0], 0.55 * level * tint[1], 0.75 * level)
        horizon = (0.8 * level, 0.72 * level, 0.72 * level)
        return cls((0.0, 0.0, 1.0), 0.2 * level, 0.8 * level, tint, zenith, horizon, shadows=False)

    @classmethod
    def _by_day(cls, conditions: Conditions) -> "Light":
        elevation, azimuth = np.radians([conditions.sun_elevation_deg, conditions.sun_azimuth_deg])
        low = float(np.clip(1 - conditions.sun_elevation_deg / 35, 0, 1))
        if conditions.clouds > OVERCAST_CLOUDS:
            level = 1 - 0.3 * low
            grey: COLOR_TYPE = (0.80 * level, 0.82 * level, 0.85 * level)
            horizon: COLOR_TYPE = (0.9 * level, 0.9 * level, 0.9 * level)
            return cls((0.0, 0.0, 1.0), 0.25, 0.72 * level, (0.97, 0.99, 1.0), grey, horizon, shadows=False)
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
    """Return the brightness (H, W) around 1 of worn and patched surfaces at ground positions (H, W, 2), metres."""
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


class Motif(IntEnum):
    """Motif of a two-colour pattern; the shaders use these numbers."""

    PLAIN = 1
    CHECKS = 2
    STRIPES = 3
    GRADIENT = 4
    NOISE = 5
    SPOTS = 6


@dataclass(frozen=True)
class Pattern:
    """Random pattern that replaces a material's own colour."""

    motif: Motif
    first: COLOR_TYPE
    second: COLOR_TYPE
    size_m: float
    """Size of a check, stripe or spot, metres."""
    turn: float
    """Rotation in turns, at least 0 and less than 1."""


@dataclass(frozen=True, eq=False)
class Palette:
    """Colours and patterns of materials."""

    colors: Mapping[str, COLOR_TYPE]
    """Colours of all materials, sRGB in 0..1."""
    patterns: Mapping[str, Pattern]
    """Patterns of some of the scenery's materials; not used for vehicles of the same materials."""

    @classmethod
    def of(cls, town: Town) -> "Palette":
        """Return the palette of a town or of its variant."""
        return _palette(town)

    @property
    def plain(self) -> Mapping[str, COLOR_TYPE]:
        """Return the colours of the scenery's materials for a renderer without patterns."""
        return {**self.colors, **{name: pattern.first for name, pattern in self.patterns.items()}}


USUAL_PALETTE: Final = Palette(MATERIAL_COLORS, {})
"""The materials' own colours."""
_ROAD_MATERIALS: Final = materials_between("asphalt", "bitumen")
"""Materials of the carriageway, which share a pattern and differ in brightness."""
_FURTHER_MATERIALS: Final = (
    *materials_between("gutter", "cover"),
    *materials_between("kerb", "felt"),
    *materials_between("frame", "fascia_cream"),
    *materials_between("awning_red", "awning_green"),
)
"""Other materials that may have a pattern."""


@lru_cache(maxsize=64)
def _palette(town: Town) -> Palette:
    variant = town.variant
    season = style(town).season if variant and variant.season else None
    colors = {**MATERIAL_COLORS, **season.colors} if season else MATERIAL_COLORS
    randomised = variant.randomised if variant else 0
    return Palette(colors, _drawn_patterns(np.random.default_rng(randomised)) if randomised else {})


def _drawn_patterns(rng: np.random.Generator) -> Mapping[str, Pattern]:
    road, out = _drawn_pattern(rng), {}
    for name in _ROAD_MATERIALS:
        lighter = sum(MATERIAL_COLORS[name]) / sum(MATERIAL_COLORS["asphalt"])
        first, second = (_scaled(color, lighter) for color in (road.first, road.second))
        out[name] = Pattern(road.motif, first, second, road.size_m, road.turn)
    for name in _FURTHER_MATERIALS:
        pattern = _drawn_pattern(rng)
        if rng.random() < MATERIAL_PATTERNS.changed_share:
            out[name] = pattern
    return out


def _drawn_pattern(rng: np.random.Generator) -> Pattern:
    low, high = np.log(MATERIAL_PATTERNS.sizes_m)
    motif = Motif(int(rng.integers(len(Motif))) + 1)
    first, second = _drawn_color(rng), _drawn_color(rng)
    return Pattern(motif, first, second, float(np.exp(rng.uniform(low, high))), float(rng.uniform(0.0, 0.999)))


def _drawn_color(rng: np.random.Generator) -> COLOR_TYPE:
    """Return a random colour, more often pale than bright."""
    return colorsys.hsv_to_rgb(rng.random(), 0.75 * rng.random() ** 1.5, rng.uniform(0.12, 0.85))


def _scaled(color: COLOR_TYPE, factor: float) -> COLOR_TYPE:
    red, green, blue = (min(1.0, factor * channel) for channel in color)
    return red, green, blue
