"""Random colours: of the scenery's materials only, the same for the same variant, none without it."""

import numpy as np

from skope.gen.render.gl.context import albedo_table, pattern_tables
from skope.gen.render.materials import MATERIAL_COLORS, USUAL_PALETTE, Palette
from skope.gen.towns.town import Town, Variant


def test_towns_have_the_materials_own_colours() -> None:
    for town in (Town("town01"), Town("town01", variant=Variant(5))):
        palette = Palette.of(town)
        assert palette.colors == MATERIAL_COLORS
        assert not palette.patterns
        assert np.array_equal(albedo_table(palette), albedo_table(USUAL_PALETTE))
        assert not np.any(pattern_tables(palette))


def test_random_colours_are_those_of_roads_and_walls() -> None:
    one, same, other = (
        Palette.of(Town("town01", variant=Variant(seed, randomised=r))) for seed, r in ((5, 3), (6, 3), (5, 4))
    )
    assert one.patterns == same.patterns
    assert one.patterns != other.patterns
    assert one.colors == MATERIAL_COLORS  # which vehicles have
    assert {"asphalt", "asphalt_worn"} <= one.patterns.keys()
    assert not one.patterns.keys() & {"marking", "leaves", "window", "paint", "glass", "tyre", "livery"}
    first, second = pattern_tables(one)
    chosen = second[:, 3] > 0
    assert chosen.sum() == len(one.patterns)
    assert (first[chosen, 3] > 0.1).all()
    assert ((second[chosen, 3].astype(int) >= 1) & (second[chosen, 3].astype(int) <= 6)).all()
