"""The [world] table of a site file: where the world's (0, 0) is on the map that its places were taken from."""

import re
from collections.abc import Mapping
from typing import Any, Final

from skope.site.toml_table import TomlTable

ZONE: Final = re.compile(r"([1-9]|[1-5][0-9]|60)([NS])")
"""A UTM zone: its number and half of the Earth."""
_FARTHEST_M: Final = 1e8


def read_world(table: TomlTable, unknown: list[str]) -> Mapping[str, Any]:
    """The table's values as they stand there: `origin`, and perhaps `axes`, `utm_zone`, `epsg` and `scale`.

    The origin is longitude and latitude in degrees, or easting and northing in metres of a UTM zone. Keys that mean
    nothing here are added to `unknown`.

    Raises:
        UserError: Something is missing or wrong; the message names file and key.
    """
    out: dict[str, Any] = {"origin": _origin(table.table("origin"), unknown)}
    if "axes" in table:
        out["axes"] = table.text("axes")
    if "utm_zone" in table:
        out["utm_zone"] = table.text("utm_zone")
        if not ZONE.fullmatch(out["utm_zone"]):
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
    """Raises UserError where it is neither in degrees nor in metres."""
    limits = {"longitude": 180.0, "latitude": 90.0}
    if "easting" in table or "northing" in table:
        limits = {"easting": _FARTHEST_M, "northing": _FARTHEST_M}
    found = {name: table.number(name, low=-most, high=most) for name, most in limits.items()}
    unknown += table.unread
    return found
