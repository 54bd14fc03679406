"""Light, air and camera of a recording: one dataclass of numbers, and the ranges that they are drawn from."""

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Final, Self

import numpy as np

from skope.errors import UserError, one_of

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What a recording was made in and with."""

    sun_elevation_deg: float
    """Above the horizon."""
    sun_azimuth_deg: float
    """Counter-clockwise from east."""
    clouds: float
    """Share of the sky that they cover, 0 to 1."""
    visibility_m: float
    """Meteorological optical range: the distance at which contrast has fallen to 5%."""
    exposure_ev: float
    """Stops over what an automatic exposure takes."""
    noise: float
    """Standard deviation of the sensor's noise, of 255."""
    vignetting: float
    """Share of the light that is lost 45 degrees off the optical axis."""
    k1: float
    """First radial coefficient of the lens' distortion (OpenCV's model): negative for a barrel, 0 for none."""

    @classmethod
    def drawn(cls, ranges: Mapping[str, Range], rng: np.random.Generator) -> Self:
        """Even draws from a range for each field, rounded so that they can be written down and set again."""
        return cls(**{f.name: float(f"{rng.uniform(*ranges[f.name]):.5g}") for f in fields(cls)})

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


OVERCAST: Final = 0.9
"""With more clouds than this nothing throws a shadow."""
LIMITS: Final[Mapping[str, Range]] = {
    "sun_elevation_deg": (2.0, 90.0),
    "sun_azimuth_deg": (0.0, 360.0),
    "clouds": (0.0, 1.0),
    "visibility_m": (20.0, 1e5),
    "exposure_ev": (-5.0, 5.0),
    "noise": (0.0, 50.0),
    "vignetting": (0.0, 0.5),
    "k1": (-1.0, 1.0),
}
"""What can be set at all."""
_CAMERA: Final[Mapping[str, Range]] = {
    "exposure_ev": (-0.25, 0.25),
    "noise": (1.0, 2.5),
    "vignetting": (0.04, 0.14),
    "k1": (0.0, 0.0),
}
_WEATHER: Final[Mapping[str, Mapping[str, Range]]] = {
    "clear": {"clouds": (0.0, 0.3), "visibility_m": (6e3, 2e4)},
    "cloudy": {"clouds": (0.4, 0.8), "visibility_m": (5e3, 1.5e4)},
    "overcast": {"clouds": (1.0, 1.0), "visibility_m": (3e3, 1e4)},
    "fog": {"clouds": (1.0, 1.0), "visibility_m": (120.0, 500.0)},
}
_HOUR: Final[Mapping[str, Mapping[str, Range]]] = {
    "noon": {"sun_elevation_deg": (45.0, 62.0), "sun_azimuth_deg": (225.0, 315.0)},
    "low_sun": {"sun_elevation_deg": (14.0, 24.0), "sun_azimuth_deg": (150.0, 350.0)},
    "dawn": {"sun_elevation_deg": (5.0, 9.0), "sun_azimuth_deg": (0.0, 40.0)},
    "dusk": {"sun_elevation_deg": (5.0, 9.0), "sun_azimuth_deg": (150.0, 215.0)},
}


def ranges(weather: str, time_of_day: str, overrides: Mapping[str, Range] | None = None) -> dict[str, Range]:
    """The range of every field in a weather at an hour, with some set otherwise."""
    return {
        **_CAMERA,
        **_WEATHER[one_of("weather", weather, tuple(_WEATHER))],
        **_HOUR[one_of("time_of_day", time_of_day, tuple(_HOUR))],
        **(overrides or {}),
    }


_SETTING: Final = re.compile(r"(\w+)=(.+?)(?:\.\.(.+))?")


def parse_settings(settings: list[str]) -> dict[str, Range]:
    """Ranges from flags like "noise=2" or "exposure_ev=-1..1"; a wrong one is a UserError that names it."""
    out = {}
    for setting in settings:
        match = _SETTING.fullmatch(setting)
        try:
            name, low, high = match.groups() if match else ("", "", "")
            values = float(low), float(high if high is not None else low)
        except ValueError:
            raise UserError(f"--set {setting}: expected NAME=VALUE or NAME=LOW..HIGH with numbers") from None
        out[name] = values
    return check_settings(out)


def check_settings(settings: Mapping[str, Range]) -> dict[str, Range]:
    """The settings, when each is a known field's and within what that can be."""
    for name, (low, high) in settings.items():
        least, most = LIMITS[one_of("--set", name, tuple(LIMITS))]
        if not (math.isfinite(low) and math.isfinite(high) and least <= low <= high <= most):
            raise UserError(f"--set {name}: expected a range within {least:g}..{most:g}, got {low:g}..{high:g}")
    return dict(settings)
