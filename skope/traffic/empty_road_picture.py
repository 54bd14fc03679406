"""The empty road as the camera shows it, beside the tracks: the picture that the page draws the gates on.

It is the median of frames, so that moving road users are not in it; those that stand during most of the time are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skope.files.atomic import write_bytes
from skope.files.json_files import read_json, write_json
from skope.types import Array, Pixels

PICTURE: Final = "empty_road.jpg"
_SIZE: Final = "empty_road.json"
_LONGEST_PX: Final = 1280
_QUALITY: Final = 85
_MIN_FRAMES: Final = 10
_MIN_SECONDS: Final = 10.0
"""Minimum length of the footage. In less, slow road users cover the same pixels in most frames and stay visible."""


@dataclass(frozen=True)
class EmptyRoadPicture:
    """A JPEG of the empty road, and the size of the images that pixel coordinates refer to."""

    jpeg: bytes
    size: tuple[int, int]
    """Width and height of the footage, pixels; the JPEG may be smaller."""


def empty_road_picture(road: Pixels, times_s: Sequence[float] | Array) -> EmptyRoadPicture | None:
    """Encode the empty road.

    Args:
        road: (H, W, 3) the median of frames of the footage.
        times_s: (F,) times of the frames of the footage, rising, seconds.

    Returns:
        The picture. None if the footage is too short for the median to show no road users.
    """
    from skope.page.image_viewer import encoded_jpeg

    if len(times_s) < _MIN_FRAMES or times_s[-1] - times_s[0] < _MIN_SECONDS:
        return None
    return EmptyRoadPicture(
        encoded_jpeg(road, longest=_LONGEST_PX, quality=_QUALITY), (int(road.shape[1]), int(road.shape[0]))
    )


def write_empty_road_picture(folder: Path, picture: EmptyRoadPicture) -> list[str]:
    """Write a picture and its size to a folder of tracks; returns the names of the files."""
    write_bytes(folder / PICTURE, picture.jpeg)
    write_json(folder / _SIZE, {"size": list(picture.size)})
    return [PICTURE, _SIZE]


def read_empty_road_picture(folder: Path) -> EmptyRoadPicture | None:
    """Read the picture in a folder of tracks; None if there is none, or if its size is missing."""
    if not (folder / PICTURE).is_file() or not (folder / _SIZE).is_file():
        return None
    document = read_json(folder / _SIZE)
    size = document.get("size") if isinstance(document, dict) else None
    if not isinstance(size, list) or len(size) != 2 or not all(type(value) is int and value > 0 for value in size):
        return None
    return EmptyRoadPicture((folder / PICTURE).read_bytes(), (size[0], size[1]))
