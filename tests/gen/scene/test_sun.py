import pytest

from skope.gen.scene.conditions import declination_deg, sun_position

EAST, NORTH, WEST, SOUTH = 0.0, 90.0, 180.0, 270.0
MARCH_EQUINOX, JUNE_SOLSTICE, DECEMBER_SOLSTICE = 79.6, 172.0, 355.0


def apart(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


@pytest.mark.parametrize(
    ("day", "declination"),
    [(MARCH_EQUINOX, 0.0), (JUNE_SOLSTICE, 23.44), (266.0, 0.0), (DECEMBER_SOLSTICE, -23.44)],
)
def test_declination_over_the_year(day: float, declination: float) -> None:
    assert declination_deg(day) == pytest.approx(declination, abs=0.35)


@pytest.mark.parametrize(
    ("latitude", "day", "hour", "elevation", "azimuth"),
    [
        (40.0, JUNE_SOLSTICE, 12.0, 73.44, SOUTH),
        (51.5, DECEMBER_SOLSTICE, 12.0, 15.06, SOUTH),
        (-35.0, DECEMBER_SOLSTICE, 12.0, 78.44, NORTH),
        (-35.0, JUNE_SOLSTICE, 12.0, 31.56, NORTH),
        (45.0, MARCH_EQUINOX, 6.0, 0.0, EAST),
        (45.0, MARCH_EQUINOX, 18.0, 0.0, WEST),
        (45.0, MARCH_EQUINOX + 0.5, 0.0, -45.0, NORTH),
        # asin(sin 40 sin 23.44 + cos 40 cos 23.44 cos 45); the azimuth from its cosine law.
        (40.0, JUNE_SOLSTICE, 15.0, 48.83, 189.8),
        (70.0, JUNE_SOLSTICE, 0.0, 3.44, NORTH),
    ],
)
def test_where_the_sun_stands(latitude: float, day: float, hour: float, elevation: float, azimuth: float) -> None:
    found = sun_position(latitude, day, hour)
    assert found[0] == pytest.approx(elevation, abs=0.35)
    assert apart(found[1], azimuth) < 0.6


def test_mornings_and_afternoons_mirror_each_other() -> None:
    for hours in (1.0, 3.5, 7.0):
        before, after = (sun_position(48.0, 172.0, 12 + sign * hours) for sign in (-1, 1))
        assert before[0] == pytest.approx(after[0], abs=0.1)
        assert apart(before[1], 180 - after[1]) < 0.2
