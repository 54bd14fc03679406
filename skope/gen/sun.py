"""Where the sun stands: closed formulae after Spencer (1971), as NOAA's solar calculator uses them."""

import math


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
    """Elevation over the horizon and azimuth counter-clockwise from east (0..360), degrees, without refraction.

    `hour` is local solar time: the sun crosses the meridian at 12.
    """
    latitude, turned = math.radians(latitude_deg), math.radians(15 * (hour - 12))
    declination = math.radians(declination_deg(day + (hour - 12) / 24))
    up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * math.cos(turned)
    east = -math.cos(declination) * math.sin(turned)
    north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(declination) * math.cos(turned)
    return math.degrees(math.asin(max(-1.0, min(1.0, up)))), math.degrees(math.atan2(north, east)) % 360
