"""The [world] table of a site file: the position of the world's (0, 0) on a map or on the Earth."""

import re
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import numpy as np

from skope.camera.geographic import geographic, local_metres, utm_metres
from skope.errors import UserError
from skope.records import TomlTable
from skope.types import Array


def on_earth(world: Mapping[str, Any] | None, places: Array) -> Array:
    """Convert positions of a site to longitude and latitude.

    Args:
        world: The site's [world] table; None if it has none.
        places: (..., 2) positions in the site's world, metres.

    Returns:
        (..., 2) longitude and latitude (WGS84), degrees.

    Raises:
        UserError: There is no [world] table, or its grid is not UTM.
    """
    if world is None:
        raise UserError("the site's position on the Earth is missing: [world] with an origin (docs/own-road.md)")
    axes = world.get("axes", "east, north")
    if axes != "east, north":
        raise UserError(f"world.axes: positions on the Earth need x east and y north, got {axes!r:.40}")
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


UTM_ZONE: Final = re.compile(r"([1-9]|[1-5][0-9]|60)([NS])")
"""UTM zone: its number and hemisphere."""
_FARTHEST_M: Final = 1e8


def read_world(table: TomlTable, unknown: list[str]) -> Mapping[str, Any]:
    """Read the table's values unchanged: `origin`, and optionally `axes`, `utm_zone`, `epsg` and `scale`.

    The origin is longitude and latitude in degrees, or easting and northing in metres of a UTM zone. Unknown keys are
    added to `unknown`.

    Raises:
        UserError: A key is missing or invalid; the message names file and key.
    """
    out: dict[str, Any] = {"origin": _origin(table.table("origin"), unknown)}
    if "axes" in table:
        out["axes"] = table.text("axes")
    if "utm_zone" in table:
        out["utm_zone"] = table.text("utm_zone")
        if not UTM_ZONE.fullmatch(out["utm_zone"]):
            raise table.wrong("utm_zone", f'expected a zone like "32N", got {out["utm_zone"][:20]!r}')
    if "epsg" in table:
        code = table.number("epsg", low=1024, high=99999)
        if code % 1:
            raise table.wrong("epsg", "expected a whole number")
        out["epsg"] = int(code)
    if "scale" in table:
        out["scale"] = table.number("scale", low=0.5, high=2.0)
    unknown += table.unread
    if "easting" in out["origin"] and "utm_zone" not in out:
        raise table.wrong("utm_zone", "missing: an origin in metres of a map needs its zone")
    return out


def _origin(table: TomlTable, unknown: list[str]) -> dict[str, float]:
    """Return the origin. Raises UserError if it is neither in degrees nor in metres."""
    limits = {"longitude": 180.0, "latitude": 90.0}
    if "easting" in table or "northing" in table:
        limits = {"easting": _FARTHEST_M, "northing": _FARTHEST_M}
    found = {name: table.number(name, low=-most, high=most) for name, most in limits.items()}
    unknown += table.unread
    return found
