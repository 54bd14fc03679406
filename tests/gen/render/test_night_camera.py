"""What a camera makes of a night: metering, exposures, glare, noise; each against what can be worked out."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera
from skope.gen.render.camera_effects import with_metered_noise
from skope.gen.render.daylight import Daylight
from skope.gen.render.night_camera import (
    _SPREAD_COLORS,
    NIGHT_SENSOR,
    NightCamera,
    VeilingGlare,
    curve,
    denoised,
    metered,
)
from tests.gen.scenes import conditions, standing

SIZE = (320, 180)
NIGHT = conditions(sun_elevation_deg=-30.0, shutter_s=0.04, gain_db=48.0, glare=1.0)
DAYLIGHT = replace(Daylight.of(NIGHT), lamplight=np.full(3, 0.05))
CAMERA = Camera.looking([-13, -1.0, 4.0], yaw=0.05, pitch_down=0.22, size=SIZE, fov=np.radians(60))
DEPTH = np.full(SIZE[::-1], 30.0, dtype=np.float32)


def even_light(*rgb: float) -> np.ndarray:
    return np.broadcast_to(np.float32(rgb), (*SIZE[::-1], 3))


def night_camera(light: float = 0.1, **fields: float) -> NightCamera:
    return NightCamera(even_light(light, light, light), DEPTH, replace(NIGHT, **fields), DAYLIGHT)


def picture(camera: NightCamera, light: np.ndarray, full: np.ndarray | float | None = None) -> np.ndarray:
    """A picture for `develop` from light and fullness after the camera's gains."""
    filled = camera.exposure.full if full is None else full
    return np.dstack([light, np.broadcast_to(filled, light.shape[:2])]).astype(np.float32) / camera.gain


def test_a_road_of_any_brightness_is_exposed_alike() -> None:
    levels = [night_camera(light).without_glare(np.full((4, 4, 4), light, np.float32)) for light in (0.02, 0.1, 0.9)]
    wanted = round(255 * float(curve(np.array(NIGHT_SENSOR.road_level))))
    for level in levels:
        assert np.abs(level.astype(int) - wanted).max() <= 1


def test_exposure_ev_doubles_the_light() -> None:
    one, two = (metered(even_light(0.1, 0.1, 0.1), DEPTH, replace(NIGHT, exposure_ev=ev), DAYLIGHT) for ev in (0, 1))
    np.testing.assert_allclose(two.gains, 2 * one.gains)


def test_lamps_and_sky_are_not_metered() -> None:
    light, depth = even_light(0.1, 0.1, 0.1).copy(), DEPTH.copy()
    plain = metered(light, depth, NIGHT, DAYLIGHT)
    light[:100], depth[:100] = 0.001, np.inf
    light[100:104, :300] = 500.0
    np.testing.assert_allclose(metered(light, depth, NIGHT, DAYLIGHT).gains, plain.gains)


def test_the_greatest_gain_leaves_dark_roads_dark() -> None:
    dark = even_light(1e-4, 1e-4, 1e-4)
    weak, strong = (metered(dark, DEPTH, replace(NIGHT, gain_db=db), DAYLIGHT) for db in (20.0, 26.0206))
    np.testing.assert_allclose(strong.gains, 2 * weak.gains, rtol=1e-4)
    assert 1e-4 * strong.gains.mean() < 0.2 * NIGHT_SENSOR.road_level


def test_white_balance_takes_the_lamps_colour_out() -> None:
    warm = even_light(0.16, 0.1, 0.07)
    full, none = (metered(warm, DEPTH, replace(NIGHT, auto_white_balance=share), DAYLIGHT) for share in (1.3, 0.0))
    np.testing.assert_allclose(warm[0, 0] * full.gains, (warm[0, 0] * full.gains).mean(), rtol=1e-5)
    np.testing.assert_allclose(none.gains, none.gains.mean())


def test_electrons_follow_from_luminance_and_shutter() -> None:
    exposure = metered(even_light(0.1, 0.1, 0.1), DEPTH, NIGHT, DAYLIGHT)
    candela = 0.1 / DAYLIGHT.exposure.mean() * NIGHT_SENSOR.candela_per_unit
    electrons = candela * NIGHT.shutter_s * NIGHT_SENSOR.electrons_per_candela_second
    assert exposure.electrons * NIGHT_SENSOR.road_level == pytest.approx(electrons, rel=1e-4)


def test_a_trail_of_the_long_exposure_is_grey_not_white() -> None:
    camera = night_camera(short_exposure=0.4)
    # A red lamp that passed: far too bright for the long exposure, absent from the short one.
    light = even_light(0.0, 0.0, 0.0).copy()
    light[80:90, 100:140] = [300.0, 2.0, 0.1]
    shown = camera.without_glare(picture(camera, light, 0.6))[85, 120]
    plateau = round(255 * float(curve(np.array(0.6))))
    assert shown[0] == shown[1] == pytest.approx(plateau, abs=1)
    assert shown[2] < shown[0] - 40


def spread_of(glare: VeilingGlare, excess: np.ndarray) -> np.ndarray:
    spread = glare.spread(cv2.split(excess))
    assert spread is not None
    return np.dstack(spread)


def test_glare_spreads_its_share_of_the_light_and_no_more() -> None:
    glare = VeilingGlare(1920, NIGHT)
    excess = np.zeros((540, 960, 3), dtype=np.float32)
    excess[270, 480] = 1000.0
    spread = spread_of(glare, excess)
    shares = glare._shares @ _SPREAD_COLORS
    np.testing.assert_allclose(spread.sum(axis=(0, 1)), 1000 * shares, rtol=0.02)
    np.testing.assert_allclose(spread_of(glare, 2 * excess), 2 * spread, rtol=1e-5)
    assert glare.spread(cv2.split(np.zeros_like(excess))) is None


def test_glare_falls_off_on_all_sides_alike() -> None:
    excess = np.zeros((400, 400, 3), dtype=np.float32)
    excess[199:201, 199:201] = 1000.0
    spread = spread_of(VeilingGlare(1920, NIGHT), excess)[..., 1]
    np.testing.assert_allclose(spread, spread[::-1], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(spread, spread.T, rtol=1e-3, atol=1e-4)
    profile = spread[200, 204:300:4]
    assert (np.diff(profile) < 0).all()


def test_glare_whitens_what_is_around_a_lamp() -> None:
    camera = night_camera()
    light = even_light(NIGHT_SENSOR.road_level, NIGHT_SENSOR.road_level, NIGHT_SENSOR.road_level).copy()
    light[88:92, 158:162] = 4000.0
    shown = camera.develop(picture(camera, light))
    assert shown[90, 160].min() > 225
    assert shown[90, 166].min() > shown[90, 200].max() + 5
    assert shown[90, 300].max() - shown[20, 20].max() <= 2


def test_noise_is_that_of_counted_electrons() -> None:
    """Against frames of drawn electrons, averaged recursively as the camera does, and put through its curve."""
    denoising = 0.6
    camera = night_camera(denoising=denoising, noise=1.75)
    rng = np.random.default_rng(0)
    for light in (0.05, 0.125, 0.4):
        mean = light * camera.exposure.electrons
        before, average = 0.96 * np.sqrt(denoising), None
        for _ in range(60):
            counted = rng.poisson(mean, 20_000) + 2.5 * rng.standard_normal(20_000)
            average = counted if average is None else before * average + (1 - before) * counted
        shown = 255 * curve(np.maximum(average / camera.exposure.electrons, 0))
        value = round(255 * float(curve(np.array(light))))
        assert camera.noise[value] == pytest.approx(shown.std(), rel=0.06)


@pytest.mark.parametrize("infrared", [0.0, 1.0])
def test_pictures_have_the_noise_of_the_table(infrared: float) -> None:
    recording = replace(standing(CAMERA, []), conditions=replace(NIGHT, infrared=infrared))
    clean = np.full((*SIZE[::-1], 3), 120, dtype=np.uint8)
    noisy = with_metered_noise(clean, np.full(256, 6.0, dtype=np.float32), recording, 0)
    np.testing.assert_allclose(noisy.std(axis=(0, 1)), 6.0, rtol=0.03)


def test_denoising_keeps_edges_and_takes_noise() -> None:
    rng = np.random.default_rng(1)
    clean = np.full((120, 200, 3), 60, dtype=np.uint8)
    clean[:, 100:] = 160
    noise = np.full(256, 5.0, dtype=np.float32)
    noisy = np.clip(clean + rng.normal(0, 5, clean.shape), 0, 255).astype(np.uint8)
    smooth = denoised(noisy, noise, replace(NIGHT, denoising=1.0))
    assert smooth[:, :90].std() < 0.55 * noisy[:, :90].std()
    assert (smooth[:, 100:103].mean() - smooth[:, 97:100].mean()) > 88
    assert denoised(noisy, noise, replace(NIGHT, denoising=0.0)) is noisy


def test_two_exposures_hold_brighter_light_than_one() -> None:
    one, two = night_camera(), night_camera(short_exposure=0.5)
    assert two.exposure.full * 0.5 + 0.5 * NIGHT_SENSOR.short_exposure_range > one.exposure.full
    bright = np.full((2, 2, 3), 3.0, np.float32)
    assert (one.without_glare(picture(one, bright)) < 255).all()
    assert cv2.mean(two.without_glare(picture(two, bright, 0.5 + 0.5 * 3.0)))[0] < 255
