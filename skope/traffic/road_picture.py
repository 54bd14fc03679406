"""Images of the empty road beside the tracks: from above, for maps, and from the camera, for its gates.

The camera's image is the median of frames. Moving road users disappear in the median. Road users that are stopped most
of the time remain.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from skope.files.atomic import write_bytes
from skope.files.json_files import read_json, write_json
from skope.types import Array, Pixels

EMPTY_ROAD_FILE: Final = "empty_road.jpg"
EMPTY_ROAD_SIZE_FILE: Final = "empty_road.json"


@dataclass(frozen=True)
class RoadImage:
    """Settings for the image of the empty road."""

    longer_px: int = 1280
    """Longer side, pixels."""
    jpeg_quality: int = 85
    fewest_frames: int = 10
    """Smallest number of frames."""
    shortest_s: float = 10.0
    """Minimum length of the footage, seconds. In shorter footage, slow road users cover the same pixels in most
    frames and stay visible."""


ROAD_IMAGE: Final = RoadImage()


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

    if len(times_s) < ROAD_IMAGE.fewest_frames or times_s[-1] - times_s[0] < ROAD_IMAGE.shortest_s:
        return None
    return EmptyRoadPicture(
        encoded_jpeg(road, longest=ROAD_IMAGE.longer_px, quality=ROAD_IMAGE.jpeg_quality),
        (int(road.shape[1]), int(road.shape[0])),
    )


def write_empty_road_picture(folder: Path, picture: EmptyRoadPicture) -> list[str]:
    """Write a picture and its size to a folder of tracks; returns the names of the files."""
    write_bytes(folder / EMPTY_ROAD_FILE, picture.jpeg)
    write_json(folder / EMPTY_ROAD_SIZE_FILE, {"size": list(picture.size)})
    return [EMPTY_ROAD_FILE, EMPTY_ROAD_SIZE_FILE]


def read_empty_road_picture(folder: Path) -> EmptyRoadPicture | None:
    """Read the picture in a folder of tracks; None if there is none, or if its size is missing."""
    if not (folder / EMPTY_ROAD_FILE).is_file() or not (folder / EMPTY_ROAD_SIZE_FILE).is_file():
        return None
    document = read_json(folder / EMPTY_ROAD_SIZE_FILE)
    size = document.get("size") if isinstance(document, dict) else None
    if not isinstance(size, list) or len(size) != 2 or not all(type(value) is int and value > 0 for value in size):
        return None
    return EmptyRoadPicture((folder / EMPTY_ROAD_FILE).read_bytes(), (size[0], size[1]))


ROAD_FILE: Final = "road.jpg"
ROAD_POSITION_FILE: Final = "road.json"


@dataclass(frozen=True)
class RoadPicture:
    """A picture of a rectangle of the road, north up."""

    jpeg: bytes
    low: tuple[float, float]
    """World x and y of its south-west corner, metres."""
    high: tuple[float, float]
    """World x and y of its north-east corner, metres."""


def write_road_picture(folder: Path, picture: RoadPicture) -> list[str]:
    """Write an image and its position to a folder of tracks; return the names of the files."""
    write_bytes(folder / ROAD_FILE, picture.jpeg)
    write_json(folder / ROAD_POSITION_FILE, {"low": list(picture.low), "high": list(picture.high)})
    return [ROAD_FILE, ROAD_POSITION_FILE]


def read_road_picture(folder: Path) -> RoadPicture | None:
    """Read the image in a folder of tracks; None if it or its position is missing."""
    if not (folder / ROAD_FILE).is_file() or not (folder / ROAD_POSITION_FILE).is_file():
        return None
    document = read_json(folder / ROAD_POSITION_FILE)
    corners = [_corner(document.get(name)) for name in ("low", "high")] if isinstance(document, dict) else [None]
    if (
        corners[0] is None
        or corners[-1] is None
        or not all(a < b for a, b in zip(corners[0], corners[-1], strict=True))
    ):
        return None
    return RoadPicture((folder / ROAD_FILE).read_bytes(), corners[0], corners[-1])


def _corner(value: Any) -> tuple[float, float] | None:
    if not isinstance(value, list) or len(value) != 2 or not all(type(number) in (int, float) for number in value):
        return None
    return float(value[0]), float(value[1])
