"""Latitude and longitude, as maps on the web give them, in metres of the page's world."""

import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from skope.camera.geographic import local_metres, utm_metres
from skope.errors import UserError
from skope.site.page.document_values import positions
from skope.site.world import ZONE

_PAIR: Final = re.compile(
    r"\s*([-+]?\d{1,3}(?:[.,]\d+)?)\s*°?\s*([NSns]?)\s*[,;\s]\s*([-+]?\d{1,3}(?:[.,]\d+)?)\s*°?\s*([EWew]?)\s*"
)
_APART_M: Final = 20_000.0


def map_places(sent: Mapping[str, Any]) -> dict[str, Any]:
    """`places`, rows of x (east) and y (north) in metres, and `world`, in which they are.

    Args:
        sent: `text` ("49.00012, 8.40034", latitude first) or `pairs` of degrees in the `order` "latitude" or
            "longitude" first; `world` of the document, or None; `others`: whether places are in it already.

    Raises:
        UserError: These are no such places, or lie in another world than the document's.
    """
    degrees = _typed(sent["text"]) if "text" in sent else _pairs(sent)
    if (np.abs(degrees) > [180.0, 90.0]).any():
        raise UserError("expected a latitude from -90 to 90 and a longitude from -180 to 180 degrees")
    world = sent.get("world")
    if not isinstance(world, dict):
        if sent.get("others"):
            raise UserError(
                "the other places are metres, and where their (0, 0) is on the map is not known: type this one in "
                "metres too"
            )
        longitude, latitude = (round(float(v), 6) for v in np.median(degrees, axis=0))
        world = {"origin": {"longitude": longitude, "latitude": latitude}, "axes": "east, north"}
    metres = _metres_in(world, degrees)
    if np.abs(metres).max() > _APART_M:
        raise UserError(f"lies more than {_APART_M / 1000:g} km from the other places; is the latitude first?")
    return {"places": np.round(metres, 3).tolist(), "world": world}


def _metres_in(world: Mapping[str, Any], degrees: Any) -> Any:
    """(N, 2) metres from the origin of a world, of (N, 2) longitudes and latitudes."""
    origin, zone = world.get("origin"), ZONE.fullmatch(str(world.get("utm_zone")))
    told = origin if isinstance(origin, dict) else {}
    if about := positions([[told.get("longitude"), told.get("latitude")]], 2):
        return local_metres(degrees[:, 0], degrees[:, 1], (about[0][0], about[0][1]))
    if zone and (about := positions([[told.get("easting"), told.get("northing")]], 2)):
        grid = utm_metres(degrees[:, 0], degrees[:, 1], int(zone[1]), south=zone[2] == "S")
        return grid - about[0]
    raise UserError("where the world's (0, 0) is on the map is not known: type metres")


def _typed(text: Any) -> Any:
    """(1, 2) longitude and latitude of a text."""
    found = _PAIR.fullmatch(text) if isinstance(text, str) and len(text) < 100 else None
    if not found:
        raise UserError("expected latitude and longitude in degrees, like 49.00012, 8.40034")
    latitude, north, longitude, east = found.groups()
    signs = [-1 if east.upper() == "W" else 1, -1 if north.upper() == "S" else 1]
    return np.array([[float(longitude.replace(",", ".")), float(latitude.replace(",", "."))]]) * signs


def _pairs(sent: Mapping[str, Any]) -> Any:
    """(N, 2) longitudes and latitudes of numbers."""
    rows = positions(sent.get("pairs"), 2)
    if not rows:
        raise UserError("pairs: expected rows of two numbers")
    return np.array(rows)[:, ::-1] if sent.get("order") == "latitude" else np.array(rows)
