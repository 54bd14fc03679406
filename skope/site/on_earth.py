"""Places of a site on the Earth, by its [world] table."""

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from skope.camera.geographic import geographic, local_metres, utm_metres
from skope.errors import UserError
from skope.types import Array

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts


def on_earth(site: "SiteParts", places: Array) -> Array:
    """(..., 2) longitude and latitude (WGS84, degrees) of places (..., 2) of a site, metres.

    Raises:
        UserError: The site does not say where it is, or in a grid that is not UTM's.
    """
    world = site.world
    if world is None:
        raise UserError("the site does not say where on the Earth it is: [world] with an origin (docs/own-road.md)")
    axes = world.get("axes", "east, north")
    if axes != "east, north":
        raise UserError(f"world.axes: places on the Earth need x east and y north, got {axes!r:.40}")
    origin = world["origin"]
    if "longitude" in origin:
        about = (origin["longitude"], origin["latitude"])
        return geographic(places, lambda turn, tilt: local_metres(turn, tilt, about), about)
    zone = str(world["utm_zone"])
    south = zone.endswith("S")
    if "epsg" in world and world["epsg"] != (32700 if south else 32600) + int(zone[:-1]):
        raise UserError(f"world.epsg: {world['epsg']} is not the grid of UTM zone {zone}; leave it out if it is")
    corner = np.array([origin["easting"], origin["northing"]])
    near = (6 * int(zone[:-1]) - 183.0, (corner[1] - (1e7 if south else 0.0)) / 111_000)
    try:
        return geographic(corner + np.asarray(places), partial(utm_metres, zone=int(zone[:-1]), south=south), near)
    except ValueError:
        raise UserError(f"world.origin: easting and northing lie too far from UTM zone {zone}") from None
