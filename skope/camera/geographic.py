"""Places on the Earth as metres of a plane near them: WGS84's longitude and latitude, and UTM's scale."""

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.types import Array

_A: Final = 6378137.0
_F: Final = 1 / 298.257223563
"""WGS84's equatorial radius, metres, and flattening."""
_E2: Final = _F * (2 - _F)
_UTM_SCALE: Final = 0.9996
"""UTM's scale on a zone's central meridian, where the easting is 500 km."""


def local_metres(longitude_deg: ArrayLike, latitude_deg: ArrayLike, origin_deg: tuple[float, float]) -> Array:
    """(..., 2) metres east and north of an origin (longitude, latitude), in the plane that touches the ellipsoid there.

    Closed form, through Cartesian coordinates of the Earth. Over 1 km the plane and the ellipsoid differ by 8 cm in
    height, and lengths by less than a millimetre.
    """
    at, about = _cartesian(longitude_deg, latitude_deg), _cartesian(*origin_deg)
    turn, tilt = math.radians(origin_deg[0]), math.radians(origin_deg[1])
    east = np.array([-math.sin(turn), math.cos(turn), 0.0])
    north = np.array([-math.sin(tilt) * math.cos(turn), -math.sin(tilt) * math.sin(turn), math.cos(tilt)])
    return np.asarray((at - about) @ np.stack([east, north], axis=-1))


def _cartesian(longitude_deg: ArrayLike, latitude_deg: ArrayLike) -> Array:
    """(..., 3) metres from the Earth's middle, of places on the ellipsoid."""
    turn, tilt = np.radians(longitude_deg), np.radians(latitude_deg)
    across = _A / np.sqrt(1 - _E2 * np.sin(tilt) ** 2)
    return np.stack(
        [
            across * np.cos(tilt) * np.cos(turn),
            across * np.cos(tilt) * np.sin(turn),
            across * (1 - _E2) * np.sin(tilt),
        ],
        axis=-1,
    )


def utm_scale(easting: float, northing: float, *, south: bool = False) -> float:
    """How many metres of UTM's grid a metre on the ellipsoid is, at a place of a zone, also outside its usual width.

    Snyder, Map Projections (1987), equation 8-11, with the radii of curvature at the latitude that the northing says.
    """
    # The latitude to a tenth of a degree is enough: the radius follows it slowly.
    tilt = ((northing - 1e7) if south else northing) / (_UTM_SCALE * 6367449.0)
    across = _A / math.sqrt(1 - _E2 * math.sin(tilt) ** 2)
    along = across * (1 - _E2) / (1 - _E2 * math.sin(tilt) ** 2)
    q = (easting - 500_000.0) ** 2 / (2 * across * along * _UTM_SCALE**2)
    return _UTM_SCALE * (1 + q + q**2 / 6)
