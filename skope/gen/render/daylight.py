"""Light in numbers: sun, twilight, night, haze and exposure under a recording's conditions, in linear light."""

import math
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np

from skope.gen.scene.conditions import DARK_DEG, OVERCAST_CLOUDS, Conditions
from skope.types import Array

_OPTICAL_DEPTH: Final = np.array([0.12, 0.19, 0.34])
"""Vertical optical depth of clear air with some haze at red, green and blue, after the 1976 US standard atmosphere and
25 km of visibility."""


@dataclass(frozen=True)
class SkyLight:
    """Light of sky, city and snow, and how an automatic exposure follows it."""

    twilight_deg: float = 4.5
    """Degrees that the sun must sink below the horizon for the sky to fade to a tenth."""
    night_sky: float = 0.0004
    """Light of the night sky as a share of the sky's at sunset."""
    city_glow: float = 0.000005
    """Radiance of the air over a town for each unit of a street light's intensity: 0.003 to 0.04 cd/m2 at the
    horizon."""
    bounced: float = 0.00024
    """Mean radiance of walls, trees and road around a place for each unit of a street light's intensity."""
    airlight: float = 0.06
    """Share of the lamps' light on the road with which the air between them shines."""
    dim_stops: float = 0.24
    """Stops by which an automatic exposure leaves a picture darker than by day, for each stop that the scene is
    darker."""
    snow_dims: float = 1.4
    """Share by which an automatic exposure finds a street under snow brighter than another."""
    full_light: float = 2.0
    """Irradiance on the ground from which an automatic exposure keeps the full brightness."""


SKY_LIGHT: Final = SkyLight()


def temperature_color(kelvin: float) -> Array:
    """(3,) linear RGB of a black body of luminance 1 (Planck's law at the primaries' dominant wavelengths)."""
    wavelengths = np.array([611e-9, 549e-9, 464e-9])

    def planck(temperature: float) -> Array:
        return np.asarray(wavelengths**-5.0 / np.expm1(0.0143878 / (wavelengths * temperature)))

    color = planck(kelvin) / planck(6500.0)
    return np.asarray(color / (color @ [0.2126, 0.7152, 0.0722]))


@dataclass(frozen=True, eq=False)
class Daylight:
    """Colours are linear RGB: radiance, and irradiance for the sun, in units in which a sun outside the air has 10."""

    sun_direction: Array
    """(3,) unit vector towards the sun, world axes; straight up when it throws no shadows."""
    sun: Array
    """(3,) irradiance on a surface that faces it."""
    zenith: Array
    """(3,)"""
    horizon: Array
    """(3,)"""
    afterglow: Array
    """(3,) light that the horizon over the sun has more when the sun has set."""
    sunset: Array
    """(2,) direction of that, east and north."""
    clouds: float
    """0 clear .. 1 overcast."""
    dark: bool
    """Whether street lights burn, windows are lit, and lamps are what lights the road."""
    street_light: Array
    """(3,) radiant intensity of a street light."""
    haze_density: float
    """Extinction of the air, 1/m."""
    gains: Array
    """(3,) of the channels, for the white balance, times 2 to the power of the stops set over an automatic exposure."""
    vignetting: float
    """Share of the light lost 45 degrees off the axis."""
    bounced: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) mean radiance of what street lights light around a place. It lights surfaces from all sides, as the sky
    does, but is not seen in the sky's place."""
    lamplight: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) mean irradiance on the road in view from lamps that do not move."""

    @classmethod
    def of(cls, conditions: Conditions) -> Self:
        """The light of a recording's sun, weather and lamps."""
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
        # Scattered clouds leave the sun alone; a closed cover spreads what is left of it around the zenith.
        share = float(np.clip((conditions.clouds - 0.5) / 0.5, 0, 1))
        closed = share * share * (3 - 2 * share)
        zenith = (1 - closed) * day * np.array([0.22, 0.46, 1.0]) + closed * 0.9 * grey
        open_horizon = day * np.array([0.75, 0.95, 1.15]) + (1 - day) * 0.35 * through
        overcast = conditions.clouds > OVERCAST_CLOUDS
        dark = height < DARK_DEG
        street_light = float(dark) * conditions.street_lighting * 9.0 * temperature_color(conditions.street_light_k)
        city = street_light * SKY_LIGHT.city_glow * np.array([1.0, 0.9, 0.8])
        # It is at its strongest when the sun has just set.
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
        """(3,) mean radiance from above in a direction, clouds spread evenly."""
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
        """(3,) on level ground under an open sky, lamps included."""
        mean_sky = self.bounced + 0.35 * self.horizon + 0.65 * self.zenith
        return np.asarray(self.sun * self.sun_direction[2] + math.pi * mean_sky + self.lamplight)

    @property
    def ground(self) -> Array:
        """(3,) radiance of a street of ordinary reflectance."""
        return np.asarray(0.14 * self.ground_irradiance / math.pi)

    @property
    def haze(self) -> Array:
        """(3,) radiance of the air, which lamps light too."""
        return np.asarray(self.horizon + SKY_LIGHT.airlight * self.lamplight / math.pi)

    @property
    def exposure(self) -> Array:
        """(3,) for each channel; an automatic exposure brings a surface of 18% reflectance on level ground to a middle
        grey, or somewhat below that when there is little light.
        """
        light = float(self.ground_irradiance.mean())
        dim = min(light / SKY_LIGHT.full_light, 1.0) ** SKY_LIGHT.dim_stops
        return np.asarray(self.gains * dim * 0.19 / (0.18 * light / math.pi))
