"""The empty road as it looks from above, beside the tracks: what maps of them are drawn on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from skope.files.atomic import write_bytes
from skope.files.json_files import read_json, write_json

PICTURE: Final = "road.jpg"
_PLACE: Final = "road.json"


@dataclass(frozen=True)
class RoadPicture:
    """A picture of a rectangle of the road, north up."""

    jpeg: bytes
    low: tuple[float, float]
    """World x and y of its south-west corner, metres."""
    high: tuple[float, float]
    """And of its north-east corner."""


def write_road_picture(folder: Path, picture: RoadPicture) -> list[str]:
    """Write a picture and where it lies to a folder of tracks; returns the files' names."""
    write_bytes(folder / PICTURE, picture.jpeg)
    write_json(folder / _PLACE, {"low": list(picture.low), "high": list(picture.high)})
    return [PICTURE, _PLACE]


def read_road_picture(folder: Path) -> RoadPicture | None:
    """The picture in a folder of tracks; None where there is none, or nothing says where it lies: maps do without."""
    if not (folder / PICTURE).is_file() or not (folder / _PLACE).is_file():
        return None
    document = read_json(folder / _PLACE)
    corners = [_corner(document.get(name)) for name in ("low", "high")] if isinstance(document, dict) else [None]
    if (
        corners[0] is None
        or corners[-1] is None
        or not all(a < b for a, b in zip(corners[0], corners[-1], strict=True))
    ):
        return None
    return RoadPicture((folder / PICTURE).read_bytes(), corners[0], corners[-1])


def _corner(value: Any) -> tuple[float, float] | None:
    if not isinstance(value, list) or len(value) != 2 or not all(type(one) in (int, float) for one in value):
        return None
    return float(value[0]), float(value[1])
