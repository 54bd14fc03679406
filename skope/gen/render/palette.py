"""The colours of a town's scenery: those of the materials, of a season, or random ones in random patterns."""

import colorsys
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Final

import numpy as np

from skope.gen.render.materials import MATERIALS, RGB, materials_between
from skope.gen.towns.town import Town
from skope.gen.towns.town_style import style


class Motif(IntEnum):
    """Motif of a pattern of two colours; the shaders know them by these numbers."""

    PLAIN = 1
    CHECKS = 2
    STRIPES = 3
    GRADIENT = 4
    NOISE = 5
    SPOTS = 6


@dataclass(frozen=True)
class Pattern:
    """A random pattern in place of a material's own colour."""

    motif: Motif
    first: RGB
    second: RGB
    size_m: float
    """Size of a check, a stripe or a spot, metres."""
    turn: float
    """Its turn, in turns, at least 0 and less than 1."""


@dataclass(frozen=True, eq=False)
class Palette:
    """Colours of materials."""

    colors: Mapping[str, RGB]
    """Colours of all materials, sRGB in 0..1."""
    patterns: Mapping[str, Pattern]
    """Patterns of some of the scenery's materials; vehicles of the same materials do not have them."""

    @classmethod
    def of(cls, town: Town) -> "Palette":
        """The palette of a town or of its variant."""
        return _palette(town)

    @property
    def plain(self) -> Mapping[str, RGB]:
        """Colours of the scenery's materials for a renderer without patterns."""
        return {**self.colors, **{name: pattern.first for name, pattern in self.patterns.items()}}


USUAL: Final = Palette(MATERIALS, {})
"""The materials' own colours."""
_ROAD_MATERIALS: Final = materials_between("asphalt", "bitumen")
"""Materials of the carriageway, which share a pattern and differ in brightness."""
_FURTHER_MATERIALS: Final = (
    *materials_between("gutter", "cover"),
    *materials_between("kerb", "felt"),
    *materials_between("frame", "fascia_cream"),
    *materials_between("awning_red", "awning_green"),
)
"""Further materials that may have a pattern."""
_CHANGED: Final = 0.85
"""Share of materials that have a pattern where there are any."""
_SIZES_M: Final = (0.15, 6.0)


@lru_cache(maxsize=64)
def _palette(town: Town) -> Palette:
    variant = town.variant
    season = style(town).season if variant and variant.season else None
    colors = {**MATERIALS, **season.colors} if season else MATERIALS
    randomised = variant.randomised if variant else 0
    return Palette(colors, _drawn_patterns(np.random.default_rng(randomised)) if randomised else {})


def _drawn_patterns(rng: np.random.Generator) -> Mapping[str, Pattern]:
    road, out = _drawn_pattern(rng), {}
    for name in _ROAD_MATERIALS:
        lighter = sum(MATERIALS[name]) / sum(MATERIALS["asphalt"])
        first, second = (_scaled(color, lighter) for color in (road.first, road.second))
        out[name] = Pattern(road.motif, first, second, road.size_m, road.turn)
    for name in _FURTHER_MATERIALS:
        pattern = _drawn_pattern(rng)
        if rng.random() < _CHANGED:
            out[name] = pattern
    return out


def _drawn_pattern(rng: np.random.Generator) -> Pattern:
    low, high = np.log(_SIZES_M)
    motif = Motif(int(rng.integers(len(Motif))) + 1)
    first, second = _drawn_color(rng), _drawn_color(rng)
    return Pattern(motif, first, second, float(np.exp(rng.uniform(low, high))), float(rng.uniform(0.0, 0.999)))


def _drawn_color(rng: np.random.Generator) -> RGB:
    """A colour that is more often pale than bright."""
    return colorsys.hsv_to_rgb(rng.random(), 0.75 * rng.random() ** 1.5, rng.uniform(0.12, 0.85))


def _scaled(color: RGB, factor: float) -> RGB:
    red, green, blue = (min(1.0, factor * channel) for channel in color)
    return red, green, blue
