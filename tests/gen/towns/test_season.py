"""Seasons colour plants only, and most of them leave little saturated green."""

import colorsys

import numpy as np
import pytest

from skope.gen.render.materials import MATERIAL_COLORS, USUAL_PALETTE, Palette
from skope.gen.scenery.build import scenery
from skope.gen.towns.town import Town, Variant
from skope.gen.towns.town_style import drawn_season, style


def test_few_seasons_are_of_a_saturated_green() -> None:
    seasons = [drawn_season(np.random.default_rng(seed)) for seed in range(300)]
    green = 0
    for season in seasons:
        assert 0.0 <= season.bare <= 1.0
        hue, saturation, _ = colorsys.rgb_to_hsv(*season.colors["grass"])
        green += saturation > 0.35 and 70 <= 360 * hue <= 170
        assert all(0.0 <= channel <= 1.0 for color in season.colors.values() for channel in color)
    assert green < 0.12 * len(seasons)
    assert len({season.colors["grass"] for season in seasons}) == len(seasons)


@pytest.mark.slow
def test_a_season_changes_plants_and_nothing_else() -> None:
    plain, dressed = (Town("town02", variant=Variant(9, season=season)) for season in (0, 4))
    assert style(plain).season is None
    assert style(dressed).rows == style(plain).rows
    colors = Palette.of(dressed).colors
    assert Palette.of(plain).colors == USUAL_PALETTE.colors == MATERIAL_COLORS
    changed = {name for name in MATERIAL_COLORS if colors[name] != MATERIAL_COLORS[name]}
    assert changed <= {"meadow", "field_green", "grass", "leaves", "leaves_dark", "leaves_pale", "hedge", "woods"}
    assert scenery(plain).bays == scenery(dressed).bays
    assert scenery(plain).buildings == scenery(dressed).buildings
