"""The [plan] table of a site file: a map, plan or aerial picture, and where its pixels lie in the world."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skope.site.toml_table import TomlTable

_PIXEL_M: Final = (1e-5, 1e4)
"""Smallest and largest pixel, metres."""
_FARTHEST_M: Final = 1e8


@dataclass(frozen=True, kw_only=True)
class PlanPicture:
    """A picture of the road from above."""

    file: Path
    """File of the picture, which need not be there."""
    metres_per_pixel: float
    origin: tuple[float, float]
    """World x and y of the picture's top-left corner, metres."""
    rotation_deg: float
    """By how much the picture's up is turned from the world's y, counter-clockwise."""


def read_plan(table: TomlTable, unknown: list[str]) -> PlanPicture:
    """The table's plan; keys that mean nothing here are added to `unknown`.

    Raises:
        UserError: Something is missing or wrong; the message names file and key.
    """
    name = table.text("file")
    if not name or not name.isprintable():
        raise table.wrong("file", "expected the name of a picture")
    x, y = table.numbers("origin", 2)
    if max(abs(x), abs(y)) > _FARTHEST_M:
        raise table.wrong("origin", f"expected metres within {_FARTHEST_M:g}")
    plan = PlanPicture(
        file=table.path.parent / name,
        metres_per_pixel=table.number("metres_per_pixel", low=_PIXEL_M[0], high=_PIXEL_M[1]),
        origin=(x, y),
        rotation_deg=table.number("rotation_deg", 0.0, low=-360, high=360),
    )
    unknown += table.unread
    return plan
