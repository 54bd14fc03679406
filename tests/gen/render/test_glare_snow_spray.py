"""Glare, street lights that are out, snow, spray, dirt, graphics: pictures show them, labels know nothing of them."""

from dataclasses import replace

import numpy as np
import pytest

from skope.gen.render import screen_graphics
from skope.gen.render.frame import RenderedFrame
from skope.gen.render.lit_lamps import burning_street_lights
from skope.gen.render.screen_graphics import _GRAPHIC_KINDS, ScreenGraphics
from skope.gen.render.spray import Spray
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import LAMP_BITS
from tests.gen.render.test_weather import CAMERA, SIZE, in_studio, luminance, scene, view
from tests.gen.scenes import conditions

DARK = {"sun_elevation_deg": -30.0, "street_lighting": 0.3, "shutter_s": 0.04, "gain_db": 36.0}


@pytest.fixture(scope="module")
def day() -> RenderedFrame:
    return view(in_studio())


def same_labels(shown: RenderedFrame, other: RenderedFrame) -> None:
    np.testing.assert_array_equal(shown.ids, other.ids)
    np.testing.assert_array_equal(shown.depth, other.depth)


def test_more_glare_makes_more_of_the_picture_bright_around_lamps_and_none_makes_none() -> None:
    bright = []
    for glare in (0.0, 1.0, 8.0):
        shown = view(replace(in_studio(lamps=LAMP_BITS["low_beam"], glare=glare, **DARK)))
        bright.append(int((shown.rgb.max(axis=-1) > 90).sum()))
    assert bright[0] < bright[1] < bright[2]


def test_street_lights_fail_in_stretches_and_the_same_ones_each_time() -> None:
    x, y = np.meshgrid(np.arange(40) * 20.0, [0.0, 300.0])
    lamps = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 8.0)])
    assert burning_street_lights(lamps, 1.0) is lamps
    assert len(burning_street_lights(lamps, 0.0)) == 0
    half = burning_street_lights(lamps, 0.5)
    assert len(half) == len(lamps) // 2
    np.testing.assert_array_equal(half, burning_street_lights(lamps, 0.5))
    lit = np.array([(lamp == half).all(axis=1).any() for lamp in lamps]).reshape(2, 40)
    changes = (lit[:, 1:] != lit[:, :-1]).mean()
    # Drawn one by one half of the neighbours would differ.
    assert changes < 0.42
    # Fewer are a part of more.
    assert {tuple(lamp) for lamp in burning_street_lights(lamps, 0.3)} < {tuple(lamp) for lamp in half}


def test_a_street_whose_lights_are_out_is_darker_and_none_of_them_glows() -> None:
    dark = {**DARK, "street_lighting": 1.0, "lit_windows": 0.0, "gain_db": 12.0}
    on, off = (view(scene(street_lights_lit=share, **dark)) for share in (1.0, 0.0))
    assert luminance(off) < 0.5 * luminance(on)
    same_labels(on, off)


def test_snow_whitens_level_ground_and_leaves_labels_alone(day: RenderedFrame) -> None:
    snow = view(in_studio(snow_cover=1.0))
    same_labels(snow, day)
    ground = day.ids == 0
    saturation = [float(np.ptp(shown.rgb[ground].astype(int), axis=-1).mean()) for shown in (day, snow)]
    brightness = [float(shown.rgb[ground].mean() / shown.rgb[day.ids > 0].mean()) for shown in (day, snow)]
    assert brightness[1] > 1.3 * brightness[0]
    assert saturation[1] < saturation[0] + 12


def test_falling_snow_differs_from_frame_to_frame_only_by_its_window(day: RenderedFrame) -> None:
    falling = in_studio(snowfall_mm_h=4.0)
    shown = view(falling)
    same_labels(shown, day)
    np.testing.assert_array_equal(shown.rgb, view(falling).rgb)
    changed = (np.abs(shown.rgb.astype(int) - day.rgb) > 6).any(axis=-1)
    assert 0.002 < changed.mean() < 0.4


def test_spray_stands_behind_a_vehicle_on_a_wet_road_that_moves() -> None:
    recording = scene(speed=20.0)
    moment = recording.moment(0)
    grey = np.full((SIZE[1], SIZE[0], 3), 60, dtype=np.uint8)
    grey[:20] = 220
    far = np.full((SIZE[1], SIZE[0]), 500.0, dtype=np.float32)

    def changed(depth: np.ndarray, **fields: float) -> np.ndarray:
        spray = Spray(CAMERA, conditions(**fields))
        return (spray.drift(grey.copy(), depth, moment, 0) != grey).any(axis=-1)

    assert not changed(far, spray=0.0, wetness=1.0).any()
    assert not changed(far, spray=1.0, wetness=0.0).any()
    there = changed(far, spray=1.0, wetness=1.0)
    rear = moment.T_world_chassis[1] @ [-3.5, 0.0, 0.6, 1.0]
    column, row = CAMERA.project(rear[None, :3])[0][0].astype(int)
    assert there[row, column]
    # The car that stands throws up nothing, and what stands before the plume is not veiled.
    still = moment.T_world_chassis[0] @ [-3.5, 0.0, 0.6, 1.0]
    column, row = CAMERA.project(still[None, :3])[0][0].astype(int)
    assert not there[row, column]
    assert not changed(np.full_like(far, 2.0), spray=1.0, wetness=1.0).any()


@pytest.mark.parametrize("size", [(322, 181), (320, 180), (17, 19)])
def test_spray_is_drawn_on_images_of_any_size(size: tuple[int, int]) -> None:
    width, height = size
    picture = np.full((height, width, 3), 90, dtype=np.uint8)
    depth = np.full((height, width), 100.0, dtype=np.float32)
    shown = Spray(CAMERA, conditions(spray=1.0, wetness=1.0)).drift(picture, depth, scene(speed=20.0).moment(0), 3)
    assert shown.shape == picture.shape


def test_dirt_stays_where_it_is_and_takes_detail(day: RenderedFrame) -> None:
    recording = in_studio(lens_dirt=1.0)
    dirty = view(recording)
    same_labels(dirty, day)
    np.testing.assert_array_equal(dirty.rgb, view(recording).rgb)
    detail = [float(np.abs(np.diff(shown.rgb.astype(int), axis=1)).mean()) for shown in (day, dirty)]
    assert detail[1] < detail[0]
    assert abs(luminance(dirty) - luminance(day)) < 25


def test_graphics_stay_in_place_and_cover_what_is_behind_them(day: RenderedFrame) -> None:
    recording = in_studio(screen_graphics=6.0)
    drawn = view(recording)
    same_labels(drawn, day)
    np.testing.assert_array_equal(drawn.rgb, view(recording).rgb)
    changed = (np.abs(drawn.rgb.astype(int) - day.rgb) > 20).any(axis=-1).mean()
    assert 0.005 < changed < 0.6


def test_every_kind_of_graphics_is_drawn_on_images_of_any_size() -> None:
    for draw in _GRAPHIC_KINDS:
        for size in ((180, 320), (64, 48), (1080, 1920)):
            ink, mark = np.zeros((*size, 3), dtype=np.uint8), np.zeros(size, dtype=np.uint8)
            draw(ink, mark, np.random.default_rng(4))
            assert mark.any()


def test_names_of_places_lie_over_what_else_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """They have draws of their own: logos and letters stay what they are, and no graphics means no names."""
    grey = np.full((180, 320, 3), 120, dtype=np.uint8)
    drawn = []
    for share in (0.0, 1.0):
        monkeypatch.setattr(
            screen_graphics, "OVERLAY_STYLE", replace(screen_graphics.OVERLAY_STYLE, captioned_share=share)
        )
        drawn.append(ScreenGraphics(in_studio(screen_graphics=1.0)).draw(grey))
        assert ScreenGraphics(in_studio()).draw(grey) is grey
    plain, captioned = drawn
    changed = (plain != captioned).any(axis=-1)
    assert 0.001 < changed.mean() < 0.4
    ink, cover = np.zeros_like(grey), np.zeros(grey.shape[:2], dtype=np.uint8)
    own = in_studio().rng(Stream.PLACE_NAMES)
    own.random()  # whether there are any
    screen_graphics._place_names(ink, cover, own)
    assert not changed[cover == 0].any()


@pytest.mark.parametrize("size", [(180, 320), (64, 48), (1080, 1920)])
def test_names_of_places_are_bright_on_images_of_any_size(size: tuple[int, int]) -> None:
    for seed in range(6):
        ink, cover = np.zeros((*size, 3), dtype=np.uint8), np.zeros(size, dtype=np.uint8)
        screen_graphics._place_names(ink, cover, np.random.default_rng(seed))
        assert ink[cover > 0].max() > 140
        again = np.zeros_like(ink)
        screen_graphics._place_names(again, np.zeros_like(cover), np.random.default_rng(seed))
        np.testing.assert_array_equal(ink, again)


def test_the_fallback_draws_them_too(day: RenderedFrame) -> None:
    fields = {"spray": 1.0, "wetness": 1.0, "snowfall_mm_h": 2.0, "lens_dirt": 0.5}
    plain, shown = (view(in_studio(speed=15.0, **more), "pybullet") for more in ({"wetness": 1.0}, fields))
    same_labels(plain, shown)
    assert (plain.rgb != shown.rgb).any()
