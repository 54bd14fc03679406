"""Daylight in numbers: sun, sky, haze and exposure under a recording's conditions, in linear light."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from skope.gen.conditions import OVERCAST, Conditions

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
    clouds: float
    """0 clear .. 1 overcast."""
    haze_density: float
    """Extinction of the air, 1/m."""
    exposure_ev: float
    """Stops over what an automatic exposure takes."""
    vignetting: float
    """Share of the light lost 45 degrees off the axis."""

    @classmethod
    def of(cls, conditions: Conditions) -> Self:
        """The light of a recording's sun and weather."""
        elevation, azimuth = np.radians([max(conditions.sun_elevation_deg, 2.0), conditions.sun_azimuth_deg])
        direction = np.array(
            [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
        )
        # Kasten and Young's air mass.
        degrees = math.degrees(elevation)
        mass = 1 / (math.sin(elevation) + 0.50572 * (degrees + 6.07995) ** -1.6364)
        through = np.exp(-_OPTICAL_DEPTH * mass)
        day = math.sin(elevation) ** 0.6
        grey = day * np.array([0.92, 0.97, 1.03])
        # Scattered clouds leave the sun alone; a closed cover spreads what is left of it around the zenith.
        share = float(np.clip((conditions.clouds - 0.5) / 0.5, 0, 1))
        closed = share * share * (3 - 2 * share)
        zenith = (1 - closed) * day * np.array([0.22, 0.46, 1.0]) + closed * 0.9 * grey
        open_horizon = day * np.array([0.75, 0.95, 1.15]) + (1 - day) * 0.35 * through
        overcast = conditions.clouds > OVERCAST
        return cls(
            sun_direction=np.array([0.0, 0.0, 1.0]) if overcast else direction,
            sun=0.4 * day * np.ones(3) if overcast else 10 * (1 - closed) * through,
            zenith=zenith,
            horizon=(1 - closed) * open_horizon + closed * 0.7 * grey,
            clouds=conditions.clouds,
            haze_density=-math.log(0.05) / conditions.visibility_m,
            exposure_ev=conditions.exposure_ev,
            vignetting=conditions.vignetting,
        )

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
        """An automatic exposure brings a surface of 18% reflectance on level ground to a middle grey."""
        return float(2**self.exposure_ev * 0.19 / (0.18 * self.ground_irradiance.mean() / math.pi))
