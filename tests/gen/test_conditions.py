import numpy as np
import pytest

from skope.errors import UserError
from skope.gen.conditions import LIMITS, Conditions, check_settings, parse_settings, ranges
from skope.gen.render.daylight import Daylight
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


@pytest.mark.parametrize("weather", ["clear", "overcast"])
@pytest.mark.parametrize("hour", ["noon", "low_sun", "dusk"])
def test_every_default_range_can_be_set(weather: str, hour: str) -> None:
    spans = ranges(weather, hour)
    assert spans.keys() == LIMITS.keys()
    assert check_settings(spans) == spans


def test_light_is_finite_and_positive_whatever_is_set() -> None:
    for elevation in (-30.0, 0.0, 5.0, 90.0):
        for clouds in (0.0, 0.5, 0.89, 0.91, 1.0):
            light = Daylight.of(conditions(sun_elevation_deg=elevation, clouds=clouds))
            values = np.concatenate([light.sun, light.zenith, light.horizon, [light.exposure]])
            assert np.isfinite(values).all()
            assert (values > 0).all()
            np.testing.assert_allclose(np.linalg.norm(light.sun_direction), 1)


def test_stops_double_the_exposure_and_visibility_is_where_contrast_is_5_percent() -> None:
    light, brighter = (Daylight.of(conditions(exposure_ev=ev, visibility_m=500.0)) for ev in (0.0, 1.0))
    assert brighter.exposure == pytest.approx(2 * light.exposure)
    assert np.exp(-500.0 * light.haze_density) == pytest.approx(0.05)
