"""Convert positions on the Earth to metres of a local plane: WGS84 longitude and latitude, and UTM."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.types import Array


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid WGS84, UTM projection and the accuracy of their inverses."""

    radius_m: float = 6378137.0
    """Equatorial radius, metres."""
    flattening: float = 1 / 298.257223563
    """Flattening."""
    eccentricity_2: float = flattening * (2 - flattening)
    """Square of the first eccentricity."""
    utm_scale: float = 0.9996
    """Scale of UTM on the central meridian."""
    utm_east_m: float = 500_000.0
    """Easting of UTM on the central meridian, metres."""
    utm_south_m: float = 1e7
    """Northing of UTM on the equator in southern zones, metres."""
    newton_steps: int = 20
    """Maximum number of Newton steps of an inverse."""
    newton_m: float = 1e-5
    """Accuracy of an inverse, metres."""
    newton_deg: float = 1e-6
    """Step of its derivatives, degrees."""


WGS84_ELLIPSOID: Final = Ellipsoid()


def local_metres(longitude_deg: ArrayLike, latitude_deg: ArrayLike, origin_deg: tuple[float, float]) -> Array:
    """Return (..., 2) metres east and north of an origin (longitude, latitude), in the ellipsoid's tangent plane there.

    The formula is closed, through Cartesian coordinates of the Earth. Over 1 km the plane and the ellipsoid differ by
    8 cm in height, and lengths by less than a millimetre.

    Args:
        longitude_deg: (...) longitudes, degrees.
        latitude_deg: (...) latitudes, degrees.
        origin_deg: Longitude and latitude of the origin, degrees.
    """
    at, about = _cartesian(longitude_deg, latitude_deg), _cartesian(*origin_deg)
    turn, tilt = math.radians(origin_deg[0]), math.radians(origin_deg[1])
    east = np.array([-math.sin(turn), math.cos(turn), 0.0])
    north = np.array([-math.sin(tilt) * math.cos(turn), -math.sin(tilt) * math.sin(turn), math.cos(tilt)])
    return np.asarray((at - about) @ np.stack([east, north], axis=-1))


def _cartesian(longitude_deg: ArrayLike, latitude_deg: ArrayLike) -> Array:
    """Return (..., 3) metres from the Earth's centre, of positions on the ellipsoid."""
    turn, tilt = np.radians(longitude_deg), np.radians(latitude_deg)
    across = WGS84_ELLIPSOID.radius_m / np.sqrt(1 - WGS84_ELLIPSOID.eccentricity_2 * np.sin(tilt) ** 2)
    return np.stack(
        [
            across * np.cos(tilt) * np.cos(turn),
            across * np.cos(tilt) * np.sin(turn),
            across * (1 - WGS84_ELLIPSOID.eccentricity_2) * np.sin(tilt),
        ],
        axis=-1,
    )


def utm_scale(easting: float, northing: float, *, south: bool = False) -> float:
    """Return the metres of UTM's grid per metre on the ellipsoid, also outside the zone's usual width.

    Snyder, Map Projections (1987), equation 8-11, with the radii of curvature at the latitude of the northing.

    Args:
        easting: Easting in the zone's grid, metres.
        northing: Northing in the zone's grid, metres.
        south: Whether the zone is in the southern hemisphere, where northings start 10 000 km south of the equator.
    """
    # A latitude within a tenth of a degree is accurate enough, because the radius changes slowly.
    tilt = ((northing - WGS84_ELLIPSOID.utm_south_m) if south else northing) / (WGS84_ELLIPSOID.utm_scale * 6367449.0)
    across = WGS84_ELLIPSOID.radius_m / math.sqrt(1 - WGS84_ELLIPSOID.eccentricity_2 * math.sin(tilt) ** 2)
    along = across * (1 - WGS84_ELLIPSOID.eccentricity_2) / (1 - WGS84_ELLIPSOID.eccentricity_2 * math.sin(tilt) ** 2)
    q = (easting - WGS84_ELLIPSOID.utm_east_m) ** 2 / (2 * across * along * WGS84_ELLIPSOID.utm_scale**2)
    return WGS84_ELLIPSOID.utm_scale * (1 + q + q**2 / 6)


def utm_metres(longitude_deg: ArrayLike, latitude_deg: ArrayLike, zone: int, *, south: bool = False) -> Array:
    """Return (..., 2) easting and northing of positions in the grid of a UTM zone, also outside its usual width.

    Krueger's series in the third flattening to its fourth power (Karney, Transverse Mercator with an accuracy of a few
    nanometers, 2011, equations 7 to 10, 14 and 35), which is exact to a micrometre within 1000 km of the zone's middle.

    Args:
        longitude_deg: (...) longitudes, degrees.
        latitude_deg: (...) latitudes, degrees.
        zone: Number of the zone, 1 to 60.
        south: Whether northings are of the southern hemisphere, where they start 10 000 km south of the equator.
    """
    turn = np.radians(np.asarray(longitude_deg, dtype=np.float64) - (6 * zone - 183))
    sine, e, n = (
        np.sin(np.radians(latitude_deg)),
        math.sqrt(WGS84_ELLIPSOID.eccentricity_2),
        WGS84_ELLIPSOID.flattening / (2 - WGS84_ELLIPSOID.flattening),
    )
    conformal = np.sinh(np.arctanh(sine) - e * np.arctanh(e * sine))
    xi = np.arctan2(conformal, np.cos(turn))
    eta = np.arcsinh(np.sin(turn) / np.hypot(conformal, np.cos(turn)))
    series = (
        n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3 + 41 / 180 * n**4,
        13 / 48 * n**2 - 3 / 5 * n**3 + 557 / 1440 * n**4,
        61 / 240 * n**3 - 103 / 140 * n**4,
        49561 / 161280 * n**4,
    )
    north, east = xi, eta
    for j, share in enumerate(series, start=1):
        north = north + share * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
        east = east + share * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
    radius = WGS84_ELLIPSOID.utm_scale * WGS84_ELLIPSOID.radius_m / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return np.stack(
        [radius * east + WGS84_ELLIPSOID.utm_east_m, radius * north + (WGS84_ELLIPSOID.utm_south_m if south else 0.0)],
        axis=-1,
    )


def geographic(metres: ArrayLike, forward: Callable[[Array, Array], Array], near_deg: tuple[float, float]) -> Array:
    """Return (..., 2) longitude and latitude, degrees, of positions in metres: invert a projection by Newton's method.

    Args:
        metres: (..., 2) positions in the projection's plane.
        forward: Function from longitudes and latitudes (...,) to (..., 2) metres, as `local_metres` and `utm_metres`.
        near_deg: A longitude and latitude within some degrees of all positions.

    Raises:
        ValueError: The method does not converge, because the positions are too far away.
    """
    wanted = np.asarray(metres, dtype=np.float64)
    found = np.broadcast_to(np.asarray(near_deg, dtype=np.float64), wanted.shape).copy()
    for _ in range(WGS84_ELLIPSOID.newton_steps):
        off = forward(found[..., 0], found[..., 1]) - wanted
        if not np.isfinite(off).all():
            break
        if not off.size or np.abs(off).max() < WGS84_ELLIPSOID.newton_m:
            return found
        columns = []
        for axis in range(2):
            moved = found.copy()
            moved[..., axis] += WGS84_ELLIPSOID.newton_deg
            columns.append((forward(moved[..., 0], moved[..., 1]) - off - wanted) / WGS84_ELLIPSOID.newton_deg)
        found -= np.linalg.solve(np.stack(columns, axis=-1), off[..., None])[..., 0]
    raise ValueError("the inverse projection does not converge: the positions are too far away")
