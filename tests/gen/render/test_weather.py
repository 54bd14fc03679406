"""Every hour and weather: what pictures show of it, and that labels know nothing of it."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera
from skope.gen.mesh import flat
from skope.gen.render.camera_effects import hidden_below, sigma_of
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import STATIC_ID, RenderedFrame
from skope.gen.render.gl import background, renderer
from skope.gen.render.gl.light import LIGHT_SAMPLING, _signed_water
from skope.gen.render.lit_lamps import lamps_of, lit_lamps
from skope.gen.scene.conditions import Conditions, ranges
from skope.gen.scene.recording import LAMP_BITS, Recording, body_of
from skope.gen.scenery.build import STUDIO_TOWN, Scenery, scenery
from skope.gen.towns.town import Town, Variant
from tests.gen.scenes import conditions, standing

SIZE = (320, 180)
CAMERA = Camera.looking([-13, -1.0, 4.0], yaw=0.05, pitch_down=0.22, size=SIZE, fov=np.radians(60))
NIGHT = {"sun_elevation_deg": -30.0, "noise": 0.0, "shutter_s": 0.04, "gain_db": 36.0}
WET = {"wetness": 1.0, "puddles": 0.3}


def scene(lamps: int = 0, *, speed: float = 0.0, **fields: float) -> Recording:
    """A car seen from behind on a street of town 01, and one that stands across."""
    recording = standing(CAMERA, [("sedan", 0.0, -1.5, 0.0), ("van", 14.0, 3.5, 1.6)])
    count = len(recording.vehicles)
    velocity = np.zeros((count, 3))
    velocity[1] = [0.0, speed, 0.0]
    return replace(
        recording,
        conditions=conditions(**{"noise": 0.0, **fields}),
        lamps=np.full(count, lamps, dtype=np.uint8),
        velocity=velocity,
    )


def in_studio(**fields: float) -> Recording:
    """The same on an empty floor, which is lit fast."""
    return replace(scene(**fields), town=STUDIO_TOWN)


def view(recording: Recording, renderer: str = "gl") -> RenderedFrame:
    return make_renderer(renderer, recording).render(0)


def luminance(shown: RenderedFrame) -> float:
    return float(shown.rgb.mean())


@pytest.fixture(scope="module")
def noon() -> RenderedFrame:
    return view(scene())


@pytest.fixture(scope="module")
def plain() -> RenderedFrame:
    return view(in_studio())


@pytest.fixture(scope="module")
def unlit() -> RenderedFrame:
    return view(scene(**NIGHT))


@pytest.fixture(scope="module")
def lit() -> RenderedFrame:
    return view(scene(LAMP_BITS["low_beam"] | LAMP_BITS["brake"], **NIGHT))


def same_labels(a: RenderedFrame, b: RenderedFrame) -> None:
    np.testing.assert_array_equal(a.ids, b.ids)
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_array_equal(a.slope, b.slope)
    for one, other in zip(a.silhouettes, b.silhouettes, strict=True):
        assert (one.x, one.y) == (other.x, other.y)
        np.testing.assert_array_equal(one.mask, other.mask)


def redness(rgb: np.ndarray) -> np.ndarray:
    return rgb[..., 0].astype(float) - rgb[..., 1:].max(axis=-1)


def test_the_camera_lifts_a_lit_night_as_far_as_its_gain_goes(unlit: RenderedFrame) -> None:
    weak = view(scene(**{**NIGHT, "gain_db": 6.0}))
    assert luminance(weak) < luminance(unlit) - 20
    assert 70 < np.median(unlit.rgb[60:]) < 150


def test_tail_lamps_glow_red(unlit: RenderedFrame, lit: RenderedFrame) -> None:
    recording = scene()
    moment = recording.moment(0)
    tail = [lamp.center for lamp in lamps_of(body_of(recording.vehicles[0])) if lamp.material == "taillight"]
    assert len(tail) == 2
    T = moment.T_world_chassis[0]
    pixels, _, valid = CAMERA.project(np.array(tail) @ T[:3, :3].T + T[:3, 3])
    assert valid.all()
    for column, row in pixels.astype(int):
        # The lamp itself burns out; the lens spreads its red light around it.
        assert lit.rgb[row, column].min() > unlit.rgb[row, column].min() + 40
        around = np.s_[row - 9 : row - 5, column - 3 : column + 4]
        assert redness(lit.rgb[around]).mean() > redness(unlit.rgb[around]).mean() + 5


def test_headlights_light_the_road_ahead(unlit: RenderedFrame, lit: RenderedFrame) -> None:
    pixels, _, _ = CAMERA.project(np.array([[9.0, -4.2, 0.0]]))
    column, row = pixels[0].astype(int)
    assert lit.ids[row, column] == STATIC_ID
    window = np.s_[row - 2 : row + 3, column - 4 : column + 5]
    assert lit.rgb[window].mean() > unlit.rgb[window].mean() + 15


def test_lamps_are_found_and_lit_by_their_bits() -> None:
    def names(lamps: int) -> list[tuple[float, ...]]:
        return [lamp.color for lamp in lit_lamps(scene(lamps).moment(0)) if lamp.index == 0]

    assert names(0) == []
    assert len(names(LAMP_BITS["low_beam"])) == 4
    assert len(set(names(LAMP_BITS["low_beam"] | LAMP_BITS["indicator_left"]))) == 3
    sedan = body_of(scene().vehicles[0])
    assert all(lamp.center[0] * lamp.facing[0] > 0 for lamp in lamps_of(sedan) if lamp.material != "indicator_left")


@pytest.mark.slow
def test_a_wet_road_mirrors_lamps_and_is_darker(noon: RenderedFrame, unlit: RenderedFrame, lit: RenderedFrame) -> None:
    # Where a mirror on the road shows the left tail lamp, 0.9 m high at x = -2.3.
    below, _, _ = CAMERA.project(np.array([[-4.3, -0.9, 0.0]]))
    column, row = below[0].astype(int)
    window = np.s_[row - 5 : row + 6, column - 4 : column + 5]
    assert (lit.ids[window] == STATIC_ID).all()
    dry = redness(lit.rgb[window]).mean() - redness(unlit.rgb[window]).mean()
    wet = redness(view(scene(LAMP_BITS["low_beam"] | LAMP_BITS["brake"], **NIGHT, **WET)).rgb[window]).mean()
    assert wet - redness(view(scene(**NIGHT, **WET)).rgb[window]).mean() > dry + 4
    asphalt = np.s_[140:175, 200:300]
    assert (noon.ids[asphalt] == STATIC_ID).all()
    assert view(scene(wetness=1.0)).rgb[asphalt].mean() < 0.85 * noon.rgb[asphalt].mean()


def drawn(weather: str, hour: str, **fields: float) -> Conditions:
    return replace(Conditions.drawn(ranges(weather, hour), np.random.default_rng(2)), **fields)


@pytest.mark.parametrize(("weather", "hour"), [("rain", "night"), ("fog", "dusk")])
def test_labels_are_those_of_a_clear_noon(noon: RenderedFrame, weather: str, hour: str) -> None:
    recording = replace(scene(LAMP_BITS["low_beam"], speed=12.0), conditions=drawn(weather, hour, shutter_s=0.05))
    shown = view(recording)
    same_labels(shown, noon)
    np.testing.assert_array_equal(view(recording).rgb, shown.rgb)


def test_what_moves_is_blurred_along_its_way_only(plain: RenderedFrame) -> None:
    moved = view(in_studio(speed=12.0, shutter_s=0.03))
    same_labels(moved, plain)
    sedan, van = ((plain.ids == number) for number in (1, 2))
    changed = np.abs(moved.rgb.astype(int) - plain.rgb).max(axis=-1)
    assert changed[sedan].max() == 0
    assert changed[van].mean() > 3
    across, along = (np.abs(np.diff(moved.rgb.astype(int), axis=axis)).mean(axis=-1) for axis in (0, 1))
    before = [np.abs(np.diff(plain.rgb.astype(int), axis=axis)).mean(axis=-1) for axis in (0, 1)]
    loss = [after[van[: after.shape[0], : after.shape[1]]].mean() for after in (across, along)]
    was = [after[van[: after.shape[0], : after.shape[1]]].mean() for after in before]
    assert loss[1] / was[1] < 0.8 * loss[0] / was[0]


def test_fog_takes_contrast(plain: RenderedFrame) -> None:
    thick = view(in_studio(visibility_m=60.0))
    assert thick.contrast[1] < 0.8 * plain.contrast[1]


def test_infrared_is_grey_by_night_only() -> None:
    shown = view(in_studio(**{**NIGHT, "noise": 2.0}, infrared=1.0)).rgb
    assert (shown == shown[..., :1]).all()
    assert shown.mean() > 15
    by_day = view(in_studio(infrared=1.0)).rgb
    assert (by_day != by_day[..., :1]).any()


def test_gain_brings_noise(plain: RenderedFrame) -> None:
    quiet, loud = (conditions(noise=2.0, gain_db=gain) for gain in (0.0, 24.0))
    assert sigma_of(quiet) == 2.0
    assert 2 * sigma_of(quiet) < sigma_of(loud) < 8 * sigma_of(quiet)
    noisy = view(in_studio(noise=2.0, gain_db=24.0))
    difference = noisy.rgb.astype(float) - plain.rgb
    inside = (plain.rgb > 40) & (plain.rgb < 215)
    assert difference[inside].std() == pytest.approx(sigma_of(loud), rel=0.1)
    np.testing.assert_allclose(noisy.contrast, plain.contrast * 0.3 / sigma_of(loud))


def test_text_and_compression(plain: RenderedFrame) -> None:
    text = view(in_studio(screen_text=1.0)).rgb.astype(int)
    changed = np.abs(text - plain.rgb).max(axis=-1) > 0
    assert 100 < changed.sum() < 0.1 * changed.size
    assert not changed[60:120].any()
    fine = np.abs(np.diff(plain.rgb.astype(int), axis=1)).mean()
    for fields in ({"compression_quality": 12.0}, {"rescale": 0.4}):
        poor = view(in_studio(**fields)).rgb
        assert poor.shape == plain.rgb.shape
        assert np.abs(np.diff(poor.astype(int), axis=1)).mean() < 0.9 * fine
        assert np.abs(poor.astype(int) - plain.rgb).mean() < 15


@pytest.mark.parametrize("quality", [8, 25, 40])
@pytest.mark.parametrize("contrast", [1.0, 1.5])
def test_what_compression_hides_is_what_jpeg_rounds_away(quality: int, contrast: float) -> None:
    least = hidden_below(conditions(noise=0.0, compression_quality=quality, contrast=contrast)) * contrast
    for difference in (math.ceil(least / 2) - 1, math.floor(least / 2) + 1):
        picture = np.full((48, 48), 128, dtype=np.uint8)
        picture[16:32, 16:32] += difference
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        seen = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        assert (seen[16:32, 16:32].mean() != 128) == (difference > least / 2)


def test_noise_hides_more_than_good_compression() -> None:
    assert hidden_below(conditions(noise=3.0, compression_quality=90)) == pytest.approx(3.0)
    assert hidden_below(conditions(noise=0.0, compression_quality=100)) == pytest.approx(0.3)


def test_street_lights_hang_over_the_ground() -> None:
    lamps = scenery(Town("town01")).lamps
    assert len(lamps) > 10
    np.testing.assert_allclose(lamps[:, 2], 8.05, atol=0.01)


def test_the_fallback_draws_them_too() -> None:
    small = Camera.looking([-13, -1.0, 4.0], yaw=0.05, pitch_down=0.22, size=(96, 54), fov=np.radians(60))
    kinds = [("clear", "noon"), ("after_rain", "dusk"), ("rain", "night"), ("fog", "noon")]
    recording = replace(scene(LAMP_BITS["low_beam"]), camera=small)
    noon, dusk, night, fog = (view(replace(recording, conditions=drawn(*kind)), "pybullet") for kind in kinds)
    assert luminance(noon) > luminance(dusk) > luminance(night) > 5
    for other in (dusk, night, fog):
        same_labels(other, noon)
    assert fog.contrast[1] < noon.contrast[1]


@pytest.mark.parametrize("standing", [0, 1, 11, 12, 13, 23, 24])
def test_edges_of_puddles_mirror_as_much_as_what_is_beside_them(standing: int) -> None:
    """Samples with and without standing water, averaged as the device does in single precision."""
    water = np.random.default_rng(standing).uniform(0.0, 1.0, (24, 50)).astype(np.float32)
    sums = np.zeros(50, dtype=np.float32)
    for k, sample in enumerate(water):
        sums += (sample + np.float32(LIGHT_SAMPLING.standing_water if k < standing else 0)) * np.float32(1 / 24)
    share = _signed_water(sums, 24)
    np.testing.assert_allclose(np.abs(share), water.mean(axis=0), atol=2e-5)
    assert (share < 0).all() == (standing > 12)
    assert (share >= 0).all() == (standing <= 12)


def test_normals_that_cancel_out_leave_no_pixel_without_a_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Glare would spread it over the picture."""
    ground = flat([[(-60, -60, 0), (60, -60, 0), (60, 60, 0), (-60, 60, 0)]], "asphalt")
    made = Scenery(
        replace(ground, normals=np.zeros_like(ground.normals)), (), lamps=np.array([[4.0, 3.0, 9.0, 0.0, 0.0]])
    )
    for module in (background, renderer):
        monkeypatch.setattr(module, "scenery", lambda _: made)
    shown = view(replace(scene(**NIGHT), signals=({},), town=Town("town01", variant=Variant(9, ()))))
    assert (shown.rgb.max(axis=-1) > 0).mean() > 0.99
