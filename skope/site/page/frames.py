"""The frames of a site's footage, the one that shows its road most clearly, and the start time of the footage."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final
from zoneinfo import ZoneInfo

import cv2
import numpy as np

from skope.dataset.folder import read_image
from skope.errors import UserError
from skope.schema import Image
from skope.site.page.marks import Problem
from skope.site.site_file import clock_doubt
from skope.types import Pixels
from skope.video.footage import open_footage
from skope.video.frame_cache import FrameCache
from skope.viewer.collection import Picture, encoded, read_picture

FIELDS: Final = ("time_zone", "start")


@dataclass(frozen=True, kw_only=True)
class FootageTime:
    """Time at which the footage was taken, as far as the page says it."""

    time_zone: str | None
    start: datetime | None
    """With a zone of its own, or without where it is in `time_zone`."""
    problems: tuple[Problem, ...]


def read_time(document: Mapping[str, Any]) -> FootageTime:
    """Time zone and start of a document, texts or None, and what is wrong with them."""
    problems: list[Problem] = []

    def wrong(field: str, text: str) -> None:
        problems.append(Problem(kind="footage", index=0, field=field, text=text))

    name, zone = document.get("time_zone"), None
    if name not in (None, ""):
        zone = _zone(name)
        if zone is None:
            wrong("time_zone", 'expected a name like "Europe/Berlin"')
    text, start = document.get("start"), None
    if text not in (None, ""):
        try:
            start = datetime.fromisoformat(text.strip().replace(" ", "T", 1))
        except (AttributeError, ValueError):
            wrong("start", "expected date and time, like 2026-11-26 10:00:00")
    if start is not None and start.tzinfo is None:
        if zone is None and not problems:
            wrong("start", "type the time zone too")
        elif zone is not None and (doubt := clock_doubt(start, zone)):
            wrong("start", doubt)
    return FootageTime(time_zone=zone.key if zone else None, start=start, problems=tuple(problems))


def time_texts(time_zone: str | None, start: datetime | None) -> dict[str, str | None]:
    """`time_zone` and `start` of a document; a start in that zone is written without it."""
    if start is not None and time_zone is not None and getattr(start.tzinfo, "key", None) == time_zone:
        start = start.replace(tzinfo=None)
    return {"time_zone": time_zone, "start": None if start is None else start.isoformat(sep=" ")}


def _zone(name: Any) -> ZoneInfo | None:
    try:
        return ZoneInfo(name)
    except (ValueError, KeyError, OSError, TypeError):  # no such zone, a path, a folder of zones
        return None


_LOOKED_AT: Final = 7
"""So many frames are compared for the clearest one."""


class SiteFrames:
    """Pictures of footage by number, all of one size."""

    def __init__(
        self,
        title: str,
        count: int,
        size: tuple[int, int],
        picture: Callable[[int], Picture],
        source: str | None = None,
    ) -> None:
        self.title, self.count, self.size, self.picture = title, count, size, picture
        self.source = source
        """The footage as commands take it; None where there is none."""

    @classmethod
    def of_footage(cls, source: str) -> "SiteFrames":
        """Frames of an image, a folder of images or a video file.

        Raises:
            UserError: It is none of these, or cannot be read.
        """
        footage = open_footage(source)
        if footage.live or footage.place is None:
            raise UserError(f"{source}: a stream has no frames to go back to; record some seconds of it")
        if footage.images:
            paths = footage.images
            size = _size(read_image(paths[0]))
            return cls(Path(source).name or source, len(paths), size, lambda i: read_picture(paths[i]), source)
        frames, count = FrameCache(Path(source), encoded), max(1, len(footage))

        def picture(number: int) -> Picture:
            return frames.frame(Image(id=1, file_name=footage.name, width=1, height=1, frame_index=number))

        return cls(Path(source).name, count, _size(decoded_frame(picture(0))), picture, source)

    @classmethod
    def canvas(cls, size: tuple[int, int], title: str) -> "SiteFrames":
        """No footage: an empty canvas of a size, for points that were marked elsewhere."""

        def picture(number: int) -> Picture:
            raise UserError("an empty canvas has no pictures")

        return cls(title, 0, size, picture)

    def clearest(self) -> int:
        """Number of the sharpest of some frames from all of the footage: not the one in fog or headlights."""
        numbers = sorted({round(i) for i in np.linspace(0, self.count - 1, _LOOKED_AT).tolist()}) if self.count else []
        best, most = 0, -1.0
        for number in numbers:
            try:
                pixels = decoded_frame(self.picture(number))
            except UserError:
                continue
            grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
            sharp = float(cv2.Laplacian(grey, cv2.CV_64F).var())
            if _size(pixels) == self.size and sharp > most:
                best, most = number, sharp
        return best


def decoded_frame(picture: Picture) -> Pixels:
    """(H, W, 3) RGB of a picture."""
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise UserError("a frame cannot be decoded")
    return np.asarray(pixels, dtype=np.uint8)


def _size(pixels: Pixels) -> tuple[int, int]:
    return pixels.shape[1], pixels.shape[0]
