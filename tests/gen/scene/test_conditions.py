import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from skope.errors import UserError
from skope.gen.render.daylight import Daylight, temperature_color
from skope.gen.scene.conditions import (
    CONDITION_LIMITS,
    TIMES_OF_DAY,
    Conditions,
    check_settings,
    parse_settings,
    ranges,
    sun_position,
)
from skope.gen.simulation.simulate import lamps_on
from skope.schema import WEATHER_NAMES
from tests.gen.scenes import conditions


def test_settings_are_values_or_ranges() -> None:
    settings = parse_settings(["noise=2", "exposure_ev=-1..1.5", "k1=-.05..0", "visibility_m=1e3"])
    assert settings == {
        "noise": (2, 2),
        "exposure_ev": (-1, 1.5),
        "k1": (-0.05, 0),
        "visibility_m": (1000, 1000),
    }


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("noise", "--set noise: expected NAME=VALUE or NAME=LOW..HIGH"),
        ("noise=much", "--set noise=much: expected NAME=VALUE"),
        ("noise=1..", "--set noise=1..: expected"),
        ("nois=1", "--set: 'nois' is not one of sun_elevation_deg"),
        ("clouds=0..2", r"--set clouds: expected a range within 0\.\.1, got 0\.\.2"),
        ("noise=3..1", r"got 3\.\.1"),
        ("noise=nan", "--set noise: expected a range"),
    ],
)
def test_wrong_settings_are_refused(setting: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        parse_settings([setting])


def test_drawn_from_the_seed_within_the_ranges_or_set() -> None:
    spans = ranges("clear", "low_sun", {"noise": (4.0, 4.0)})
    draws = [Conditions.drawn(spans, np.random.default_rng(seed)).to_dict() for seed in range(50)]
    assert draws[3] == Conditions.drawn(spans, np.random.default_rng(3)).to_dict()
    for name, (low, high) in spans.items():
        values = np.array([draw[name] for draw in draws])
        assert ((values >= low) & (values <= high)).all()
        assert (np.ptp(values) > 0.8 * (high - low)) == (high > low)
    assert {draw["noise"] for draw in draws} == {4.0}


@pytest.mark.parametrize("weather", WEATHER_NAMES)
@pytest.mark.parametrize("hour", TIMES_OF_DAY)
def test_every_default_range_can_be_set(weather: str, hour: str) -> None:
    spans = ranges(weather, hour)
    assert spans.keys() == CONDITION_LIMITS.keys()
    assert check_settings(spans) == spans


def test_the_sun_stands_where_latitude_day_and_hour_put_it() -> None:
    spans = ranges("clear", "noon", parse_settings(["latitude_deg=50", "day=355", "hour=15..16"]))
    assert spans.keys() == CONDITION_LIMITS.keys() - {"sun_elevation_deg", "sun_azimuth_deg"}
    drawn = Conditions.drawn(spans, np.random.default_rng(0))
    elevation, azimuth = sun_position(50.0, 355.0, drawn.hour)
    assert (drawn.sun_elevation_deg, drawn.sun_azimuth_deg) == pytest.approx((elevation, azimuth), rel=1e-3)
    assert 0 < drawn.sun_elevation_deg < 7
    # Who sets the sun itself gets that.
    own = Conditions.drawn(ranges("clear", "noon", {"hour": (3.0, 3.0), "sun_elevation_deg": (30.0, 30.0)}), rng())
    assert own.sun_elevation_deg == 30


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def test_switches_are_on_or_off() -> None:
    spans = ranges("clear", "night", parse_settings(["infrared=0..1", "screen_text=0..1", "day=1..365"]))
    draws = [Conditions.drawn(spans, np.random.default_rng(seed)) for seed in range(30)]
    assert {draw.infrared for draw in draws} == {draw.screen_text for draw in draws} == {0.0, 1.0}
    assert all(draw.day == int(draw.day) for draw in draws)


def test_vehicles_light_their_lamps_in_the_dark_in_rain_and_in_fog() -> None:
    drawn = {(w, h): Conditions.drawn(ranges(w, h), rng()) for w in WEATHER_NAMES for h in TIMES_OF_DAY}
    without = {key for key, value in drawn.items() if not lamps_on(value)}
    assert without >= {("clear", "noon"), ("overcast", "noon"), ("after_rain", "noon")}
    assert all(weather not in ("rain", "fog") and hour in ("noon", "low_sun") for weather, hour in without)


def test_a_wrong_setting_is_one_line(tmp_path: Path) -> None:
    for setting, message in (("wetness=2", "within 0..1, got 2..2"), ("rain_mm_h=a", "expected NAME=VALUE")):
        command = ["gen", "--out", str(tmp_path / "d"), "--set", setting]
        done = subprocess.run([sys.executable, "-m", "skope", *command], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1


def test_less_light_is_shown_darker() -> None:
    def shown(**fields: float) -> float:
        light = Daylight.of(conditions(**fields))
        lit = replace(light, lamplight=0.0023 * light.street_light)
        return float((lit.ground_irradiance * lit.exposure).mean())

    shares = [shown(sun_elevation_deg=elevation) for elevation in (55.0, 8.0, 2.0, -3.0, -25.0)]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] > 0.3 * shares[0]


def test_white_balance_shows_its_light_white() -> None:
    for kelvin in (2700.0, 4000.0, 9000.0):
        gains = Daylight.of(conditions(white_balance_k=kelvin)).gains
        shown = gains * temperature_color(kelvin)
        np.testing.assert_allclose(shown, shown.mean(), rtol=1e-9)
    warm, cold = temperature_color(2700.0), temperature_color(9000.0)
    assert warm[0] > warm[1] > warm[2]
    assert cold[0] < cold[1] < cold[2]


def test_light_is_finite_and_positive_whatever_is_set() -> None:
    for elevation in (-30.0, 0.0, 5.0, 90.0):
        for clouds in (0.0, 0.5, 0.89, 0.91, 1.0):
            light = Daylight.of(conditions(sun_elevation_deg=elevation, clouds=clouds))
            values = np.concatenate([light.sun, light.zenith, light.horizon, light.exposure])
            assert np.isfinite(values).all()
            assert (values > 0).all()
            np.testing.assert_allclose(np.linalg.norm(light.sun_direction), 1)


def test_stops_double_the_exposure_and_visibility_is_where_contrast_is_5_percent() -> None:
    light, brighter = (Daylight.of(conditions(exposure_ev=ev, visibility_m=500.0)) for ev in (0.0, 1.0))
    np.testing.assert_allclose(brighter.exposure, 2 * light.exposure)
    assert np.exp(-500.0 * light.haze_density) == pytest.approx(0.05)


def test_fields_keep_their_order() -> None:
    """`Conditions.drawn` draws in the order of the fields: with another order, every seed would give other datasets."""
    order = """
sun_elevation_deg sun_azimuth_deg latitude_deg day hour clouds visibility_m rain_mm_h wetness puddles
street_lighting street_light_k lit_windows exposure_ev white_balance_k shutter_s gain_db noise infrared
vignetting k1 fisheye screen_text rescale compression_quality contrast black_level saturation sharpening glare
street_lights_lit snowfall_mm_h snow_cover spray screen_graphics short_exposure denoising auto_white_balance
lens_dirt
"""
    assert [field.name for field in fields(Conditions)] == order.split()
