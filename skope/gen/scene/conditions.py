"""Conditions of a recording (light, air and camera), the ranges from which they are sampled, and the sun's position."""

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from typing import Final, Self

import numpy as np

from skope.camera.model import Distortion
from skope.errors import UserError, one_of
from skope.types import Range

SUN_EPOCH: Final = datetime(2000, 1, 1, 12, tzinfo=UTC)


def sun_direction(when: datetime, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Compute the direction to the sun at a time and place.

    Source: the low-precision formulas of the Astronomical Almanac (0.01 degrees until 2050), without refraction.

    Args:
        when: Time with its time zone.
        latitude_deg: Latitude, degrees north.
        longitude_deg: Longitude, degrees east.

    Returns:
        Elevation above the horizon and azimuth counter-clockwise from east (0 to 360), degrees.
    """
    days = (when - SUN_EPOCH).total_seconds() / 86400
    anomaly = math.radians(357.528 + 0.9856003 * days)
    longitude = math.radians(280.460 + 0.9856474 * days + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    tilt = math.radians(23.439 - 4e-7 * days)
    declination = math.asin(math.sin(tilt) * math.sin(longitude))
    ascension = math.atan2(math.cos(tilt) * math.sin(longitude), math.cos(longitude))
    sidereal = math.radians(280.46062 + 360.985647366 * days + longitude_deg)
    return _over_horizon(math.radians(latitude_deg), declination, sidereal - ascension)


def time_of_day(elevation_deg: float, azimuth_deg: float) -> str:
    """Return the value of the annotation field `time_of_day` for a position of the sun."""
    if elevation_deg < 0:
        return "night"
    if elevation_deg < 10:
        return "dawn" if azimuth_deg < 90 or azimuth_deg >= 270 else "dusk"
    return "low_sun" if elevation_deg < 30 else "noon"


def declination_deg(day: float) -> float:
    """Return the declination of the sun on a day of the year (1 is 1 January), accurate to 0.1 degrees."""
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
    """Compute the direction to the sun on a day of the year, without refraction.

    Args:
        latitude_deg: Latitude, degrees north.
        day: Day of the year, from 1.
        hour: Local solar time, hours; the sun crosses the meridian at 12.

    Returns:
        Elevation above the horizon and azimuth counter-clockwise from east (0 to 360), degrees.
    """
    declination = math.radians(declination_deg(day + (hour - 12) / 24))
    return _over_horizon(math.radians(latitude_deg), declination, math.radians(15 * (hour - 12)))


def _over_horizon(latitude: float, declination: float, turned: float) -> tuple[float, float]:
    """Return elevation and azimuth of the sun, degrees; the arguments (`turned`: hour angle) are in radians."""
    up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * math.cos(turned)
    east = -math.cos(declination) * math.sin(turned)
    north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(declination) * math.cos(turned)
    return math.degrees(math.asin(max(-1.0, min(1.0, up)))), math.degrees(math.atan2(north, east)) % 360


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Conditions of a recording: light, weather, lens and sensor. The defaults are a dry road and a plain camera."""

    sun_elevation_deg: float
    """Elevation of the sun above the horizon, degrees."""
    sun_azimuth_deg: float
    """Direction of the sun, degrees counter-clockwise from east."""
    latitude_deg: float = 45.0
    """Latitude, degrees north of the equator."""
    day: float = 172.0
    """Day of the year; 1 is 1 January."""
    hour: float = 12.0
    """Local solar time at the start of the recording, hours."""
    clouds: float
    """Cloud cover: fraction of the sky covered by clouds, 0 to 1."""
    visibility_m: float
    """Meteorological optical range: distance at which contrast has fallen to 5%, metres."""
    rain_mm_h: float = 0.0
    """Rainfall rate, mm/h."""
    wetness: float = 0.0
    """Wetness of the ground, from 0 (dry) to 1 (a closed film of water)."""
    puddles: float = 0.0
    """Fraction of the wet ground that is covered by puddles, 0 to 1."""
    street_lighting: float = 1.0
    """Relative brightness of the street lights, which are lit when it is dark; 0 for off."""
    street_light_k: float = 3000.0
    """Colour temperature of the street lights, kelvins."""
    lit_windows: float = 0.3
    """Fraction of the rooms that are lit when it is dark, 0 to 1."""
    exposure_ev: float
    """Exposure compensation relative to automatic exposure, stops; positive values brighten the image."""
    white_balance_k: float = 6500.0
    """Colour temperature of the light that the camera renders as white, kelvins."""
    shutter_s: float = 0.001
    """Exposure time of a frame, seconds; the image shows the middle of the exposure."""
    gain_db: float = 0.0
    """Gain of the sensor, decibels; it amplifies the signal and the noise."""
    noise: float
    """Standard deviation of the sensor noise without gain, in grey levels (0 to 255)."""
    infrared: float = 0.0
    """1 for a grey image lit by the camera's own infrared lamp when it is dark, 0 for none."""
    vignetting: float
    """Fraction of the light that is lost at 45 degrees from the optical axis."""
    k1: float
    """First radial coefficient of the lens distortion (OpenCV models); negative for barrel distortion, 0 for none."""
    fisheye: float = 0.0
    """1 for a fisheye lens (equidistant, except for k1), 0 for a lens of the Brown model."""
    screen_text: float = 0.0
    """1 to overlay the site's name, the date and the time on the image, 0 for no text."""
    rescale: float = 1.0
    """Resolution of the video stream, as a fraction of the image's resolution."""
    compression_quality: float = 100.0
    """JPEG quality of the compressed stream; 100 for no compression."""
    contrast: float = 1.0
    """Factor on deviations from middle grey."""
    black_level: float = 0.0
    """Grey level (0 to 255) of image areas that receive no light."""
    saturation: float = 1.0
    """Factor on the saturation of colours."""
    sharpening: float = 0.0
    """Strength of the camera's sharpening: fraction of the finest detail that is added to the image."""
    glare: float = 1.0
    """Light that lens and sensor spread around lamps, relative to a good lens."""
    street_lights_lit: float = 1.0
    """Fraction of the street lights that are lit when it is dark; the others leave unlit stretches."""
    snowfall_mm_h: float = 0.0
    """Snowfall rate as liquid water, mm/h."""
    snow_cover: float = 0.0
    """Fraction of level ground covered by snow, 0 to 1; carriageways have less."""
    spray: float = 0.0
    """Amount of spray behind vehicles on a wet road; 1 is the spray from a closed film of water."""
    screen_graphics: float = 0.0
    """Number of graphics (logos, letters, clocks, arrows) that are overlaid on the image."""
    short_exposure: float = 0.0
    """Weight at night of a second, short exposure in the image, 0 to 1; 0 for a single exposure.

    The short exposure shows moving vehicles sharply at the end of their motion blur."""
    denoising: float = 0.0
    """Strength of the camera's denoising at night, from 0 (none) to 1 (no texture left)."""
    auto_white_balance: float = 0.0
    """Fraction of the street lights' colour on the road that white balance removes at night; from 1 all of it."""
    lens_dirt: float = 0.0
    """Dirt and dried drops on the glass in front of the lens, from 0 (clean) to 1 (much of the image is blurred)."""

    @classmethod
    def drawn(cls, ranges: Mapping[str, Range], rng: np.random.Generator) -> Self:
        """Sample each field uniformly from its range, rounded so that the values can be written and set again exactly.

        If `ranges` has no sun, its position follows from latitude, day and hour.
        """
        names = [f.name for f in fields(cls) if f.name in ranges]
        values = {name: _rounded(name, rng.uniform(*ranges[name])) for name in names}
        if not values.keys() >= set(SUN_FIELDS):
            position = sun_position(*(values[name] for name in CLOCK_FIELDS))
            values |= {name: float(f"{angle:.5g}") for name, angle in zip(SUN_FIELDS, position, strict=True)}
        return cls(**values)

    @property
    def distortion(self) -> Distortion | None:
        """Lens distortion; None for a pinhole camera."""
        if self.fisheye:
            return Distortion("fisheye", (self.k1, 0.0, 0.0, 0.0))
        return Distortion("brown", (self.k1, 0.0, 0.0, 0.0)) if self.k1 else None

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


def _rounded(name: str, value: float) -> float:
    return float(round(value)) if name in _WHOLE_NUMBERED else float(f"{value:.5g}")


OVERCAST_CLOUDS: Final = 0.9
"""Cloud cover above which no object casts a shadow."""
DARK_DEG: Final = 1.0
"""Elevation of the sun below which street lights and windows are lit, degrees."""
CONDITION_LIMITS: Final[Mapping[str, Range]] = {
    "sun_elevation_deg": (-90.0, 90.0),
    "sun_azimuth_deg": (0.0, 360.0),
    "latitude_deg": (-90.0, 90.0),
    "day": (1.0, 366.0),
    "hour": (0.0, 24.0),
    "clouds": (0.0, 1.0),
    "visibility_m": (20.0, 1e5),
    "rain_mm_h": (0.0, 100.0),
    "wetness": (0.0, 1.0),
    "puddles": (0.0, 1.0),
    "street_lighting": (0.0, 4.0),
    "street_light_k": (1800.0, 10000.0),
    "lit_windows": (0.0, 1.0),
    "exposure_ev": (-5.0, 5.0),
    "white_balance_k": (2000.0, 15000.0),
    "shutter_s": (0.0, 0.1),
    "gain_db": (0.0, 48.0),
    "noise": (0.0, 50.0),
    "infrared": (0.0, 1.0),
    "vignetting": (0.0, 0.5),
    "k1": (-1.0, 1.0),
    "fisheye": (0.0, 1.0),
    "screen_text": (0.0, 1.0),
    "rescale": (0.1, 1.0),
    "compression_quality": (1.0, 100.0),
    "contrast": (0.3, 3.0),
    "black_level": (0.0, 100.0),
    "saturation": (0.0, 2.0),
    "sharpening": (0.0, 5.0),
    "glare": (0.0, 20.0),
    "street_lights_lit": (0.0, 1.0),
    "snowfall_mm_h": (0.0, 20.0),
    "snow_cover": (0.0, 1.0),
    "spray": (0.0, 2.0),
    "screen_graphics": (0.0, 8.0),
    "short_exposure": (0.0, 0.8),
    "denoising": (0.0, 1.0),
    "auto_white_balance": (0.0, 2.0),
    "lens_dirt": (0.0, 1.0),
}
"""Minimum and maximum of each condition that can be set."""
SUN_FIELDS: Final = ("sun_elevation_deg", "sun_azimuth_deg")
CLOCK_FIELDS: Final = ("latitude_deg", "day", "hour")
_WHOLE_NUMBERED: Final = ("day", "infrared", "screen_text", "screen_graphics", "fisheye")
_SURROUNDINGS_RANGES: Final[Mapping[str, Range]] = {
    "latitude_deg": (35.0, 55.0),
    "day": (1.0, 365.0),
    "street_lighting": (0.8, 1.25),
    "street_light_k": (2200.0, 4200.0),
    "street_lights_lit": (1.0, 1.0),
    "lit_windows": (0.15, 0.5),
    "snowfall_mm_h": (0.0, 0.0),
    "snow_cover": (0.0, 0.0),
    "spray": (0.0, 0.0),
}
_CAMERA_RANGES: Final[Mapping[str, Range]] = {
    "exposure_ev": (-0.25, 0.25),
    "noise": (1.0, 2.5),
    "infrared": (0.0, 0.0),
    "vignetting": (0.04, 0.14),
    "k1": (0.0, 0.0),
    "fisheye": (0.0, 0.0),
    "screen_text": (0.0, 0.0),
    "rescale": (1.0, 1.0),
    "compression_quality": (100.0, 100.0),
    "contrast": (1.0, 1.0),
    "black_level": (0.0, 0.0),
    "saturation": (1.0, 1.0),
    "sharpening": (0.0, 0.0),
    "glare": (1.0, 1.0),
    "screen_graphics": (0.0, 0.0),
    "short_exposure": (0.0, 0.0),
    "denoising": (0.0, 0.0),
    "auto_white_balance": (0.0, 0.0),
    "lens_dirt": (0.0, 0.0),
}
DRY_ROAD: Final[Mapping[str, Range]] = {"rain_mm_h": (0.0, 0.0), "wetness": (0.0, 0.0), "puddles": (0.0, 0.0)}
WEATHER_RANGES: Final[Mapping[str, Mapping[str, Range]]] = {
    "clear": {**DRY_ROAD, "clouds": (0.0, 0.3), "visibility_m": (6e3, 2e4)},
    "cloudy": {**DRY_ROAD, "clouds": (0.4, 0.8), "visibility_m": (5e3, 1.5e4)},
    "overcast": {**DRY_ROAD, "clouds": (1.0, 1.0), "visibility_m": (3e3, 1e4)},
    "rain": {
        "clouds": (1.0, 1.0),
        "visibility_m": (700.0, 3e3),
        "rain_mm_h": (2.0, 25.0),
        "wetness": (0.85, 1.0),
        "puddles": (0.1, 0.45),
    },
    "after_rain": {
        "clouds": (0.2, 1.0),
        "visibility_m": (3e3, 1.5e4),
        "rain_mm_h": (0.0, 0.0),
        "wetness": (0.5, 0.95),
        "puddles": (0.1, 0.4),
    },
    "fog": {**DRY_ROAD, "wetness": (0.0, 0.4), "clouds": (1.0, 1.0), "visibility_m": (120.0, 500.0)},
    "snow": {
        **DRY_ROAD,
        "clouds": (1.0, 1.0),
        "visibility_m": (250.0, 2e3),
        "wetness": (0.2, 0.7),
        "snowfall_mm_h": (0.3, 4.0),
        "snow_cover": (0.1, 1.0),
    },
}
DAY_RANGES: Final[Mapping[str, Range]] = {
    "white_balance_k": (6000.0, 7000.0),
    "shutter_s": (0.0005, 0.002),
    "gain_db": (0.0, 3.0),
}
TWILIGHT_RANGES: Final[Mapping[str, Range]] = {
    "white_balance_k": (5200.0, 7200.0),
    "shutter_s": (0.01, 0.04),
    "gain_db": (15.0, 30.0),
    "denoising": (0.2, 0.8),
    "short_exposure": (0.0, 0.5),
    "auto_white_balance": (0.4, 1.6),
}
HOUR_RANGES: Final[Mapping[str, Mapping[str, Range]]] = {
    "noon": {**DAY_RANGES, "hour": (11.0, 13.0), "sun_elevation_deg": (45.0, 62.0), "sun_azimuth_deg": (225.0, 315.0)},
    "low_sun": {
        **DAY_RANGES,
        "hour": (15.5, 17.0),
        "sun_elevation_deg": (8.0, 20.0),
        "sun_azimuth_deg": (150.0, 350.0),
    },
    "dawn": {**TWILIGHT_RANGES, "hour": (5.0, 7.0), "sun_elevation_deg": (-4.0, 3.0), "sun_azimuth_deg": (0.0, 40.0)},
    "dusk": {
        **TWILIGHT_RANGES,
        "hour": (18.0, 20.0),
        "sun_elevation_deg": (-4.5, 1.0),
        "sun_azimuth_deg": (150.0, 215.0),
    },
    "night": {
        "hour": (21.0, 24.0),
        "sun_elevation_deg": (-40.0, -14.0),
        "sun_azimuth_deg": (30.0, 150.0),
        "white_balance_k": (4500.0, 6500.0),
        "shutter_s": (0.02, 0.05),
        "gain_db": (27.0, 40.0),
        "noise": (0.8, 2.2),
        "contrast": (0.9, 1.15),
        "black_level": (4.0, 26.0),
        "sharpening": (0.2, 1.0),
        "compression_quality": (62.0, 88.0),
        "short_exposure": (0.0, 0.65),
        "denoising": (0.4, 1.0),
        "auto_white_balance": (0.4, 1.6),
    },
}
TIMES_OF_DAY: Final = tuple(HOUR_RANGES)


def ranges(weather: str, time_of_day: str, overrides: Mapping[str, Range] | None = None) -> dict[str, Range]:
    """Return the ranges of all conditions for a weather and an hour.

    Args:
        weather: Weather from the table, such as "clear".
        time_of_day: Hour from the table, such as "noon".
        overrides: Ranges to use instead. If they set latitude, day or hour but not the sun, the result has no range for
            the sun. Its position then follows from them.

    Raises:
        UserError: The weather or the hour is unknown.
    """
    replaced = overrides or {}
    spans = {
        **_SURROUNDINGS_RANGES,
        **_CAMERA_RANGES,
        **WEATHER_RANGES[one_of("weather", weather, tuple(WEATHER_RANGES))],
        **HOUR_RANGES[one_of("time_of_day", time_of_day, TIMES_OF_DAY)],
        **replaced,
    }
    follows = replaced.keys() & set(CLOCK_FIELDS) and not replaced.keys() & set(SUN_FIELDS)
    return {name: span for name, span in spans.items() if not (follows and name in SUN_FIELDS)}


SETTING_PATTERN: Final = re.compile(r"(\w+)=(.+?)(?:\.\.(.+))?")


def parse_settings(settings: list[str]) -> dict[str, Range]:
    """Parse flags like "noise=2" or "exposure_ev=-1..1". Raises UserError with the first invalid flag."""
    out = {}
    for setting in settings:
        match = SETTING_PATTERN.fullmatch(setting)
        try:
            name, low, high = match.groups() if match else ("", "", "")
            values = float(low), float(high if high is not None else low)
        except ValueError:
            raise UserError(f"--set {setting}: expected NAME=VALUE or NAME=LOW..HIGH with numbers") from None
        out[name] = values
    return check_settings(out)


def check_settings(settings: Mapping[str, Range]) -> dict[str, Range]:
    """Return the settings if every field is known and within its limits. Otherwise raise a UserError."""
    for name, (low, high) in settings.items():
        least, most = CONDITION_LIMITS[one_of("--set", name, tuple(CONDITION_LIMITS))]
        if not (math.isfinite(low) and math.isfinite(high) and least <= low <= high <= most):
            raise UserError(f"--set {name}: expected a range within {least:g}..{most:g}, got {low:g}..{high:g}")
    return dict(settings)
