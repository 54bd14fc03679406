"""Daylight in numbers: sun, sky, haze and exposure of a recording, in linear light."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from skope.gen.recording import Recording

Array = NDArray[np.float64]

_OPTICAL_DEPTH = np.array([0.12, 0.19, 0.34])
"""Of clear air with some haze at red, green and blue, after the 1976 US standard atmosphere and 25 km of visibility."""


@dataclass(frozen=True, eq=False)
class Daylight:
    """Colours are linear RGB: radiance, and irradiance for the sun, in units in which a sun outside the air has 10."""

    sun_direction: Array
    """(3,) unit vector towards the sun, world axes."""
    sun: Array
    """(3,) irradiance on a surface that faces it."""
    zenith: Array
    """(3,)"""
    horizon: Array
    """(3,)"""
    cloud: float
    """0 clear with a few clouds .. 1 overcast."""
    fog_density: float
    """Extinction of the haze, 1/m."""

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """The light of a recording's sun and weather."""
        elevation, azimuth = np.radians([max(recording.sun_elevation_deg, 2.0), recording.sun_azimuth_deg])
        direction = np.array(
            [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
        )
        # Kasten and Young's air mass.
        degrees = math.degrees(elevation)
        mass = 1 / (math.sin(elevation) + 0.50572 * (degrees + 6.07995) ** -1.6364)
        through = np.exp(-_OPTICAL_DEPTH * mass)
        day = math.sin(elevation) ** 0.6
        if recording.weather == "clear":
            zenith = day * np.array([0.22, 0.46, 1.0])
            horizon = day * np.array([0.75, 0.95, 1.15]) + (1 - day) * 0.35 * through
            return cls(direction, 10 * through, zenith, horizon, 0.0, 1 / 2500)
        grey = day * np.array([0.92, 0.97, 1.03])
        # Clouds spread what is left of the sun around the zenith.
        return cls(np.array([0.0, 0.0, 1.0]), 0.4 * day * np.ones(3), 0.9 * grey, 0.7 * grey, 1.0, 1 / 1400)

    def sky(self, direction: Array) -> Array:
        """(3,) mean radiance of the sky in a direction, clouds spread evenly."""
        return np.asarray(self.horizon + (self.zenith - self.horizon) * max(direction[2], 0.0) ** 0.45)

    @property
    def ground_irradiance(self) -> Array:
        """(3,) on level ground under an open sky."""
        mean_sky = 0.35 * self.horizon + 0.65 * self.zenith
        return np.asarray(self.sun * self.sun_direction[2] + math.pi * mean_sky)

    @property
    def ground(self) -> Array:
        """(3,) radiance of a street of ordinary reflectance."""
        return np.asarray(0.14 * self.ground_irradiance / math.pi)

    @property
    def exposure(self) -> float:
        """What an automatic exposure does: brings a surface of 18% reflectance on level ground to a middle grey."""
        return float(0.19 / (0.18 * self.ground_irradiance.mean() / math.pi))
