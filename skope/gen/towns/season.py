"""Seasons: the colours of grass and leaves from fresh green to brown, and how many trees are bare."""

import colorsys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.types import Range


@dataclass(frozen=True, eq=False)
class Season:
    """Look of a town's plants in a season."""

    colors: Mapping[str, tuple[float, float, float]]
    """Colours of the materials of plants, sRGB in 0..1."""
    bare: float
    """Share of broad-leaved trees without leaves."""


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """Ranges of hue (degrees), saturation and value (0..1) of sRGB, that a kind of season draws from."""

    share: float
    grass: tuple[Range, Range, Range]
    leaves: tuple[Range, Range, Range]
    bare: Range = (0.0, 0.0)


_SEASON_KINDS: Final = (
    _Kind(  # fresh green
        share=0.08,
        grass=((70, 88), (0.36, 0.48), (0.36, 0.44)),
        leaves=((76, 98), (0.42, 0.58), (0.33, 0.42)),
    ),
    _Kind(  # summer
        share=0.14,
        grass=((64, 80), (0.24, 0.36), (0.36, 0.42)),
        leaves=((72, 92), (0.28, 0.42), (0.30, 0.38)),
    ),
    _Kind(  # grey-green
        share=0.30,
        grass=((55, 80), (0.08, 0.20), (0.34, 0.46)),
        leaves=((60, 110), (0.08, 0.22), (0.24, 0.36)),
        bare=(0.0, 0.15),
    ),
    _Kind(  # dry
        share=0.20,
        grass=((38, 50), (0.16, 0.36), (0.42, 0.58)),
        leaves=((50, 72), (0.12, 0.28), (0.27, 0.37)),
        bare=(0.0, 0.15),
    ),
    _Kind(  # autumn
        share=0.10,
        grass=((44, 60), (0.14, 0.28), (0.34, 0.44)),
        leaves=((22, 48), (0.30, 0.58), (0.30, 0.46)),
        bare=(0.1, 0.6),
    ),
    _Kind(  # winter
        share=0.18,
        grass=((36, 60), (0.06, 0.22), (0.30, 0.44)),
        leaves=((50, 120), (0.05, 0.20), (0.20, 0.30)),
        bare=(0.7, 1.0),
    ),
)
_PLANTS: Final[Mapping[str, tuple[str, float]]] = {
    "meadow": ("grass", 1.08),
    "field_green": ("grass", 0.95),
    "grass": ("grass", 1.0),
    "leaves": ("leaves", 1.0),
    "leaves_dark": ("leaves", 0.72),
    "leaves_pale": ("leaves", 1.2),
    "hedge": ("leaves", 0.72),
    "woods": ("leaves", 0.75),
}
"""The one of a kind's ranges that a material takes its colour from, and how much lighter it is."""
_SPREAD_DEG: Final = 6.0
"""Distance of the hues of materials with one range from each other, degrees."""


def drawn_season(rng: np.random.Generator) -> Season:
    """Draw a season: its kind by the shares, its colours and share of bare trees evenly from the kind's ranges."""
    shares = np.array([kind.share for kind in _SEASON_KINDS])
    kind = _SEASON_KINDS[int(rng.choice(len(_SEASON_KINDS), p=shares / shares.sum()))]
    drawn = {name: [rng.uniform(*span) for span in getattr(kind, name)] for name in ("grass", "leaves")}
    colors = {}
    for material, (name, lighter) in _PLANTS.items():
        hue, saturation, value = drawn[name]
        turned = (hue + rng.uniform(-_SPREAD_DEG, _SPREAD_DEG)) / 360
        colors[material] = colorsys.hsv_to_rgb(turned, saturation, min(1.0, value * lighter))
    colors["leaves_lit"] = colors["leaves_pale"]
    return Season(colors, float(rng.uniform(*kind.bare)))
