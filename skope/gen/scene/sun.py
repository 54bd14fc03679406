"""The sun's position at a time and place on earth."""

import math
from datetime import UTC, datetime
from typing import Final

_EPOCH: Final = datetime(2000, 1, 1, 12, tzinfo=UTC)


def sun_direction(when: datetime, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Direction to the sun at a time and place.

    Formulas: the Astronomical Almanac's low-precision sun (0.01 degrees until 2050), without refraction.

    Args:
        when: The time, with its zone.
        latitude_deg: Degrees north.
        longitude_deg: Degrees east.

    Returns:
        Elevation above the horizon and azimuth counter-clockwise from east (0 to 360), degrees.
    """
    days = (when - _EPOCH).total_seconds() / 86400
    anomaly = math.radians(357.528 + 0.9856003 * days)
    longitude = math.radians(280.460 + 0.9856474 * days + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    tilt = math.radians(23.439 - 4e-7 * days)
    declination = math.asin(math.sin(tilt) * math.sin(longitude))
    ascension = math.atan2(math.cos(tilt) * math.sin(longitude), math.cos(longitude))
    sidereal = math.radians(280.46062 + 360.985647366 * days + longitude_deg)
    return _over_horizon(math.radians(latitude_deg), declination, sidereal - ascension)


def time_of_day(elevation_deg: float, azimuth_deg: float) -> str:
    """The field `time_of_day` of annotations, for a position of the sun."""
    if elevation_deg < 0:
        return "night"
    if elevation_deg < 10:
        return "dawn" if azimuth_deg < 90 or azimuth_deg >= 270 else "dusk"
    return "low_sun" if elevation_deg < 30 else "noon"


def declination_deg(day: float) -> float:
    """Latitude over which the sun stands on a day of the year (1 is the first of January), within 0.1 degrees."""
    g = 2 * math.pi * (day - 1) / 365
    return math.degrees(
        0.006918
        - 0.399912 * math.cos(g)
        + 0.070257 * math.sin(g)
        - 0.006758 * math.cos(2 * g)
        + 0.000907 * math.sin(2 * g)
        - 0.002697 * math.cos(3 * g)
        + 0.00148 * math.sin(3 * g)
    )


def sun_position(latitude_deg: float, day: float, hour: float) -> tuple[float, float]:
    """Direction to the sun on a day of the year, without refraction.

    Args:
        latitude_deg: Degrees north.
        day: Day of the year, from 1.
        hour: Local solar time: the sun crosses the meridian at 12.

    Returns:
        Elevation over the horizon and azimuth counter-clockwise from east (0..360), degrees.
    """
    declination = math.radians(declination_deg(day + (hour - 12) / 24))
    return _over_horizon(math.radians(latitude_deg), declination, math.radians(15 * (hour - 12)))


def _over_horizon(latitude: float, declination: float, turned: float) -> tuple[float, float]:
    """Elevation and azimuth, degrees, of what stands over a latitude `turned` past the meridian; all radians."""
    up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * math.cos(turned)
    east = -math.cos(declination) * math.sin(turned)
    north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(declination) * math.cos(turned)
    return math.degrees(math.asin(max(-1.0, min(1.0, up)))), math.degrees(math.atan2(north, east)) % 360
