"""Daylight model: sun, twilight, night, haze and exposure under a recording's conditions, in linear light."""

import math
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np

from skope.gen.scene.conditions import DARK_DEG, OVERCAST_CLOUDS, Conditions
from skope.types import Array

_OPTICAL_DEPTH: Final = np.array([0.12, 0.19, 0.34])
"""Vertical optical depth of clear air with some haze for red, green and blue, from the 1976 US standard atmosphere
and 25 km of visibility."""


@dataclass(frozen=True)
class SkyLight:
    """Light of sky, city and snow, and the response of the automatic exposure."""

    twilight_deg: float = 4.5
    """Solar depression at which the light of the sky has faded to a tenth, degrees."""
    night_sky: float = 0.0004
    """Light of the night sky, as a share of the sky's light at sunset."""
    city_glow: float = 0.000005
    """Radiance of the air over a town per unit of a street light's intensity: 0.003 to 0.04 cd/m2 at the horizon."""
    bounced: float = 0.00006
    """Mean radiance of walls, trees and road around a place per unit of a street light's intensity: a sixth of what a
    lit road of usual reflectance has below a lamp."""
    airlight: float = 0.06
    """Radiance of the lit air, as a share of the light that the lamps give the road."""
    dim_stops: float = 0.24
    """Exponent of the automatic exposure below `full_light`: stops that the image darkens per stop that the scene
    darkens."""
    snow_dims: float = 1.4
    """Relative increase in brightness that the automatic exposure measures on a fully snow-covered street."""
    full_light: float = 2.0
    """Ground irradiance at and above which the automatic exposure reaches the daytime brightness."""


SKY_LIGHT: Final = SkyLight()


def temperature_color(kelvin: float) -> Array:
    """Return the linear RGB (3,) of a black body of luminance 1.

    It is Planck's law at the primaries' dominant wavelengths.
    """
    wavelengths = np.array([611e-9, 549e-9, 464e-9])

    def planck(temperature: float) -> Array:
        return np.asarray(wavelengths**-5.0 / np.expm1(0.0143878 / (wavelengths * temperature)))

    color = planck(kelvin) / planck(6500.0)
    return np.asarray(color / (color @ [0.2126, 0.7152, 0.0722]))


@dataclass(frozen=True, eq=False)
class Daylight:
    """Light of sun, sky and lamps in linear RGB.

    Colours are radiances, and irradiances for the sun. The unit is such that the sun outside the atmosphere has 10.
    """

    sun_direction: Array
    """(3,) unit vector towards the sun, world axes; straight up if the sun casts no shadows."""
    sun: Array
    """(3,) irradiance of the sun on a surface that faces it."""
    zenith: Array
    """(3,) radiance of the sky at the zenith."""
    horizon: Array
    """(3,) radiance of the sky at the horizon."""
    afterglow: Array
    """(3,) extra radiance of the horizon above the sun after sunset."""
    sunset: Array
    """(2,) direction of the afterglow, east and north."""
    clouds: float
    """Cloud cover, 0 (clear) to 1 (overcast)."""
    dark: bool
    """Whether it is dark: street lights burn, windows are lit, and lamps light the road."""
    street_light: Array
    """(3,) radiant intensity of a street light."""
    haze_density: float
    """Extinction coefficient of the air, 1/m."""
    gains: Array
    """(3,) gains of the channels for the white balance, times 2 to the power of the exposure correction in stops."""
    vignetting: float
    """Share of the light that is lost 45 degrees off the axis."""
    bounced: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) mean radiance of the surroundings that street lights light. It lights surfaces from all sides, as the sky
    does, but is not visible in place of the sky."""
    lamplight: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) mean irradiance from stationary lamps on the visible road."""

    @classmethod
    def of(cls, conditions: Conditions) -> Self:
        """Return the light of a recording's sun, weather and lamps."""
        height = conditions.sun_elevation_deg
        elevation, azimuth = np.radians([max(height, 2.0), conditions.sun_azimuth_deg])
        direction = np.array(
            [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
        )
        # Kasten and Young's air mass.
        degrees = math.degrees(elevation)
        mass = 1 / (math.sin(elevation) + 0.50572 * (degrees + 6.07995) ** -1.6364)
        risen = max(float(np.clip((height - DARK_DEG) / 3, 0, 1)), 1e-6)
        through = risen * np.exp(-_OPTICAL_DEPTH * mass)
        dusk = 10 ** (min(height - 2.0, 0.0) / SKY_LIGHT.twilight_deg)
        day = math.sin(elevation) ** 0.6 * max(dusk, SKY_LIGHT.night_sky)
        grey = day * np.array([0.92, 0.97, 1.03])
        # Scattered clouds do not change the sun; a closed cover spreads the remaining light around the zenith.
        share = float(np.clip((conditions.clouds - 0.5) / 0.5, 0, 1))
        closed = share * share * (3 - 2 * share)
        zenith = (1 - closed) * day * np.array([0.22, 0.46, 1.0]) + closed * 0.9 * grey
        open_horizon = day * np.array([0.75, 0.95, 1.15]) + (1 - day) * 0.35 * through
        overcast = conditions.clouds > OVERCAST_CLOUDS
        dark = height < DARK_DEG
        street_light = float(dark) * conditions.street_lighting * 9.0 * temperature_color(conditions.street_light_k)
        city = street_light * SKY_LIGHT.city_glow * np.array([1.0, 0.9, 0.8])
        # The afterglow is strongest just after sunset.
        sunset = math.exp(-((height / 4.0) ** 2)) * max(dusk, 0.02) * (1 - closed)
        stops = 2**conditions.exposure_ev / (1 + SKY_LIGHT.snow_dims * conditions.snow_cover)
        white = temperature_color(6500.0) / temperature_color(conditions.white_balance_k)
        return cls(
            sun_direction=np.array([0.0, 0.0, 1.0]) if overcast or dark else direction,
            sun=0.4 * day * np.ones(3) if overcast else 10 * (1 - closed) * through,
            zenith=zenith + 0.3 * city,
            horizon=(1 - closed) * open_horizon + closed * 0.7 * grey + city,
            afterglow=0.5 * sunset * np.array([1.0, 0.42, 0.12]),
            sunset=np.array([math.cos(azimuth), math.sin(azimuth)]),
            clouds=conditions.clouds,
            dark=dark,
            street_light=street_light,
            haze_density=-math.log(0.05) / conditions.visibility_m,
            gains=stops * white / (white @ [0.2126, 0.7152, 0.0722]),
            vignetting=conditions.vignetting,
            bounced=street_light * SKY_LIGHT.bounced,
        )

    def sky(self, direction: Array) -> Array:
        """Return the mean radiance (3,) of the sky in a direction, with clouds spread evenly."""
        up = max(direction[2], 0.0)
        toward = float(0.5 + 0.5 * direction[:2] @ self.sunset) ** 2
        return np.asarray(
            self.bounced
            + self.horizon
            + (self.zenith - self.horizon) * up**0.45
            + self.afterglow * toward * math.exp(-5 * up)
        )

    @property
    def ground_irradiance(self) -> Array:
        """(3,) irradiance on level ground under an open sky, lamps included."""
        mean_sky = self.bounced + 0.35 * self.horizon + 0.65 * self.zenith
        return np.asarray(self.sun * self.sun_direction[2] + math.pi * mean_sky + self.lamplight)

    @property
    def ground(self) -> Array:
        """(3,) radiance of a street of ordinary reflectance."""
        return np.asarray(0.14 * self.ground_irradiance / math.pi)

    @property
    def haze(self) -> Array:
        """(3,) radiance of the air, including the light of lamps."""
        return np.asarray(self.horizon + SKY_LIGHT.airlight * self.lamplight / math.pi)

    @property
    def exposure(self) -> Array:
        """(3,) exposure factor of each channel.

        The automatic exposure brings a surface of 18% reflectance on level ground to a middle grey, or below it in low
        light.
        """
        light = float(self.ground_irradiance.mean())
        dim = min(light / SKY_LIGHT.full_light, 1.0) ** SKY_LIGHT.dim_stops
        return np.asarray(self.gains * dim * 0.19 / (0.18 * light / math.pi))
