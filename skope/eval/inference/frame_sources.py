"""Frames of images, folders, globs, videos and streams, one after another, with their times."""

import bisect
import contextlib
import glob
import itertools
import math
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.dataset.folder import read_image
from skope.dataset.picture_headers import read_header
from skope.errors import UserError
from skope.eval.inference import stream
from skope.files import safe_names
from skope.schema import Image
from skope.types import Pixels

IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
_GLOB_CHARS: Final = frozenset("*?[")
_SAME_S: Final = 5e-4
"""Times that differ by less are the same: containers count in thousandths of a second, or finer."""
_SQUARE_WITHIN: Final = 0.005
"""Pixels count as square whose width and height differ by less, as a share."""
SEEK_FRAMES: Final = 50
"""So many frames are as soon decoded as jumped over."""


FOUND_AT: Final = "found_at"
"""Field of `info` in the file of frames: the way from its folder to the video, or to the folder of the images."""


@dataclass(frozen=True, kw_only=True)
class Cut:
    """The part of a source that is wanted."""

    every: int = 1
    """Every so many-th frame is taken."""
    start_s: float = 0.0
    end_s: float = math.inf

    def __post_init__(self) -> None:
        if self.every < 1:
            raise UserError(f"--every: expected a whole number from 1, got {self.every}")
        if not 0 <= self.start_s < self.end_s:
            raise UserError(f"--start, --end: expected 0 <= start < end, got {self.start_s:g} and {self.end_s:g}")


@dataclass(frozen=True)
class Clip:
    """A video file or stream, opened once to see what it says of itself: a camera may not like to be asked often."""

    address: str
    count: float
    """Frames as the container says, 0 or less where it does not."""
    rate: float
    """Mean number of frames a second."""
    times_s: tuple[float, ...] = ()
    """Times of all frames of a file on this machine, since the first one. Empty for other files and for streams, whose
    frames tell their times when they are read."""
    pixel_width: float = 1.0
    """Width of a pixel as it is to be shown, in its heights, as the container says: 1 where it does not."""

    @property
    def square(self) -> bool:
        """Whether its pixels are as wide as high."""
        return abs(self.pixel_width - 1) < _SQUARE_WITHIN

    @property
    def live(self) -> bool:
        """Whether its frames come when they come, and only once."""
        scheme, found, _ = self.address.partition("://")
        return bool(found) and (scheme not in ("http", "https") or self.count <= 0)


@dataclass
class Footage(ABC):
    """A source of frames. Going over it again gives the same frames, unless it is a live stream."""

    name: str
    cut: Cut = field(default_factory=Cut)
    skipped: list[str] = field(default_factory=list)
    """Lines on images that could not be read."""
    images: tuple[Path, ...] = ()
    """Image files, in order; empty for a video or stream."""
    clip: Clip | None = None
    """The video or stream as it describes itself; None for image files."""
    begins: datetime | None = None
    """Time of second 0 of a live stream, by this computer's clock, once its first frame has come; else None."""

    @property
    def live(self) -> bool:
        """Whether it cannot be read again."""
        return False

    @property
    def one_size(self) -> bool:
        """Whether all frames have one size, as those of a video."""
        return True

    @property
    def names(self) -> list[str]:
        """Names of the images: their paths inside the folder that holds them all."""
        return []

    @property
    @abstractmethod
    def place(self) -> Path | None:
        """The video file, or the folder that the images' names are relative to; None for what is on a server."""

    @property
    @abstractmethod
    def fps(self) -> float | None:
        """Frames a second after the cut; None for images, and for a live stream, whose frames come as they can."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of frames, as far as the source says; 0: unknown."""

    @abstractmethod
    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        """Frames with their pixels (H, W, 3) RGB, numbered from 1 as `Image.id`; `first` of them are left out.

        What cannot be read is noted in `skipped`, and keeps its number.
        """

    def frame_size(self) -> tuple[int, int] | None:
        """Width and height of the first frame, pixels; None for a live stream, and where no frame can be read."""
        if self.live:
            return None
        for image, _ in self.frames():
            return image.width, image.height
        return None

    def _skip(self, reason: str) -> None:
        if reason not in self.skipped:  # going over the frames again meets the same reasons
            self.skipped.append(reason)


class ImageFiles(Footage):
    """Image files in order, without times."""

    @property
    def one_size(self) -> bool:
        return len({header.shown for header in map(read_header, self.images) if header}) <= 1

    @property
    def names(self) -> list[str]:
        return [path.relative_to(self.place).as_posix() for path in self.images]

    @property
    def place(self) -> Path:
        return Path(os.path.commonpath([path.parent for path in self.images]))

    @property
    def fps(self) -> None:
        return None

    def __len__(self) -> int:
        return len(self.images[:: self.cut.every])

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        every = self.cut.every
        whole = zip(self.images[::every], self.names[::every], strict=True)
        for number, (path, name) in enumerate(itertools.islice(whole, first, None), start=first + 1):
            try:
                pixels = read_image(path)
            except UserError as error:
                self._skip(str(error))
                continue
            yield _image(number, name, pixels, number - 1, None), pixels


@dataclass
class VideoFootage(Footage):
    """Base of what is read through a `Clip`."""

    clip: Clip = field(kw_only=True)

    @property
    def place(self) -> Path | None:
        return None if "://" in self.clip.address else Path(self.clip.address)

    @property
    def fps(self) -> float | None:
        return self.clip.rate / self.cut.every

    def __len__(self) -> int:
        count, fps = self.clip.count, self.clip.rate
        last = min(count, self.cut.end_s * fps)
        return max(0, math.ceil((last - math.ceil(self.cut.start_s * fps)) / self.cut.every)) if count > 0 else 0

    def _frame(self, number: int, at: int, time_s: float, bgr: NDArray[np.generic]) -> tuple[Image, Pixels]:
        pixels = np.asarray(cv2.cvtColor(_three_channels(bgr), cv2.COLOR_BGR2RGB), dtype=np.uint8)
        return _image(number, f"{self.name}/{at:06d}", pixels, at, time_s), pixels

    def _note_missing(self, count: int) -> None:
        """Say that a file ends early: containers round their counts, but not by half a second."""
        clip = self.clip
        if count < clip.count - max(2.0, clip.rate / 2):
            self._skip(f"{clip.address}: frame {count} of {clip.count:.0f} cannot be decoded")


class IndexedVideo(VideoFootage):
    """A file of which the times of all frames are known beforehand, so that frames are jumped to."""

    def __len__(self) -> int:
        return len(self._wanted)

    @property
    def _wanted(self) -> range:
        """Numbers of the frames that are wanted."""
        edges = (self.cut.start_s - _SAME_S, self.cut.end_s - _SAME_S)
        first, last = (bisect.bisect_left(self.clip.times_s, edge) for edge in edges)
        return range(first, last, self.cut.every)

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        clip = self.clip
        left = deque(enumerate(self._wanted[first:], start=first + 1))
        if not left:
            return
        with contextlib.closing(_decoded(clip, left[0][1])) as decoded:
            for at, retrieve in decoded:
                while left and left[0][1] < at:  # the decoder has left it out
                    self._skip(f"{clip.address}: frame {left[0][1]} of {len(clip.times_s)} cannot be decoded")
                    left.popleft()
                if left and left[0][1] == at:
                    yield self._frame(left.popleft()[0], at, clip.times_s[at], retrieve())
                if not left:
                    break
        if left:
            self._skip(f"{clip.address}: frame {left[0][1]} of {len(clip.times_s)} cannot be decoded")
        elif self.cut.end_s > clip.times_s[-1]:
            self._note_missing(len(clip.times_s))


class SequentialVideo(VideoFootage):
    """A file on a server, or one without an index: it comes once from its begin, and each frame says its time."""

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        clip = self.clip
        with _opened(clip.address) as capture:
            number, at, begin, time_s = 0, 0, 0, -1 / clip.rate
            while capture.grab():
                reported_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                time_s = reported_s if reported_s > time_s else time_s + 1 / clip.rate
                if time_s >= self.cut.end_s - _SAME_S:
                    return
                if time_s < self.cut.start_s - _SAME_S:
                    begin = at + 1
                elif (at - begin) % self.cut.every == 0:
                    number += 1
                    if number > first:
                        good, bgr = capture.retrieve()
                        if not good:
                            break
                        yield self._frame(number, at, time_s, bgr)
                at += 1
            self._note_missing(at)


class LiveStream(VideoFootage):
    """A stream whose frames come when they come, and only once."""

    @property
    def live(self) -> bool:
        return True

    @property
    def fps(self) -> None:
        return None

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        clip = self.clip
        frames = stream.stream_frames(
            lambda: _opened(clip.address), self.cut.every, camera_clock=clip.address.startswith("rtsp")
        )
        with contextlib.closing(frames):
            wanted = (f for f in frames if f.time_s >= self.cut.start_s)
            try:
                for number, (at, time_s, bgr) in enumerate(wanted, start=1):
                    if time_s >= self.cut.end_s:
                        return
                    if self.begins is None:
                        self.begins = datetime.now(UTC) - timedelta(seconds=time_s)
                    yield self._frame(number, at, time_s, bgr)
            except stream.BrokenOffError as error:
                self._skip(f"{clip.address}: {error}")


def _of_clip(name: str, cut: Cut, clip: Clip) -> VideoFootage:
    """The footage of a video file or stream."""
    if clip.live:
        return LiveStream(name, cut, clip=clip)
    return IndexedVideo(name, cut, clip=clip) if clip.times_s else SequentialVideo(name, cut, clip=clip)


def open_footage(source: str, cut: Cut | None = None) -> Footage:
    """Open a source of frames.

    Args:
        source: An image, a folder of images, a glob, a video file, or the address of a stream.
        cut: Which frames are wanted; None: all.

    Raises:
        UserError: `source` is none of these, or cannot be opened.
    """
    cut = cut or Cut()
    if "://" in source:
        return _of_clip("stream", cut, _open_clip(source))
    footage = _on_this_machine(source, cut)
    for image, name in zip(footage.images, footage.names, strict=True):
        if not safe_names.is_relative(name):
            raise UserError(f"{str(image)!r}: no name for a dataset (control characters, backslashes)")
    return footage


def _on_this_machine(source: str, cut: Cut) -> Footage:
    path = Path(source)
    if path.is_dir():
        images = (p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
        found = sorted(images, key=safe_names.counting_order)
        if not found:
            raise UserError(f"{source}: no images in it ({', '.join(IMAGE_SUFFIXES)})")
        return ImageFiles(path.name, cut, images=tuple(found))
    if not path.exists() and _GLOB_CHARS & set(source):
        matches = map(Path, glob.glob(source, recursive=True))  # noqa: PTH207 (absolute patterns too)
        found = sorted(matches, key=safe_names.counting_order)
        if not found:
            raise UserError(f"{source}: matches no file")
        return ImageFiles("images", cut, images=tuple(found))
    if not path.is_file():
        raise UserError(f"{source}: no such file or folder")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return ImageFiles(path.stem, cut, images=(path,))
    return _of_clip(path.stem, cut, _open_clip(source))


def _open_clip(video: str) -> Clip:
    with _opened(video) as capture:
        count, rate, pixel_width = capture.get(cv2.CAP_PROP_FRAME_COUNT), _rate(capture), _pixel_width(capture)
    if "://" in video:
        return Clip(video, count, rate, pixel_width=pixel_width)
    times_s = _times(video)
    if len(times_s) >= 2:
        rate = (len(times_s) - 1) / times_s[-1]
    return Clip(video, count, rate, times_s, pixel_width)


def _pixel_width(capture: cv2.VideoCapture) -> float:
    width, height = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    return width / height if width > 0 and height > 0 else 1.0


def _times(video: str) -> tuple[float, ...]:
    """Times at which each frame of a file is shown, from the first: as its packets say, none of which is decoded.

    Empty where they do not say it, or two frames at once.
    """
    capture = cv2.VideoCapture(safe_names.for_opencv(video), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    try:
        times = []
        while capture.grab():
            times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
    finally:
        capture.release()
    times.sort()  # packets come in the order in which they are decoded
    rises = all(b - a > _SAME_S for a, b in itertools.pairwise(times))
    return tuple(time_s - times[0] for time_s in times) if rises else ()


def _decoded(clip: Clip, first: int) -> Generator[tuple[int, Callable[[], NDArray[np.generic]]]]:
    """Numbers of the frames of a file from `first` on or somewhat before, each with what gives its pixels."""
    with _opened(clip.address) as capture:
        at = -1
        if first >= SEEK_FRAMES and capture.set(cv2.CAP_PROP_POS_FRAMES, first):
            at = _number(clip, capture) if capture.grab() else len(clip.times_s)
            if at > first:  # where frames last differently long, the decoder can only guess
                capture.release()
                capture.open(clip.address)
                at = -1
            else:
                yield at, lambda: capture.retrieve()[1]
        while capture.grab():
            at = max(at + 1, _number(clip, capture))
            yield at, lambda: capture.retrieve()[1]


def _number(clip: Clip, capture: cv2.VideoCapture) -> int:
    """Number of the frame that was read last, from 0, by its time."""
    time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
    after = bisect.bisect_left(clip.times_s, time_s)
    around = range(max(0, after - 1), min(len(clip.times_s), after + 1))
    return min(around, key=lambda i: abs(clip.times_s[i] - time_s))


@contextlib.contextmanager
def _opened(video: str) -> Iterator[cv2.VideoCapture]:
    capture = cv2.VideoCapture(safe_names.for_opencv(video))
    try:
        if not capture.isOpened():
            raise UserError(f"{video}: neither an image nor a video that can be opened")
        yield capture
    finally:
        capture.release()


def _rate(capture: cv2.VideoCapture) -> float:
    fps = capture.get(cv2.CAP_PROP_FPS)
    return fps if math.isfinite(fps) and 0 < fps <= 1000 else 25.0


def _three_channels(pixels: NDArray[np.generic]) -> Pixels:
    """Grey or 16-bit frames as 8-bit of three channels."""
    shifted = pixels >> 8 if pixels.dtype == np.uint16 else pixels  # type: ignore[operator]
    eight = shifted.astype(np.uint8, copy=False)
    return np.repeat(eight[..., None], 3, axis=-1) if eight.ndim == 2 else eight


def _image(number: int, name: str, pixels: Pixels, index: int, time_s: float | None) -> Image:
    height, width = pixels.shape[:2]
    return Image(id=number, file_name=name, width=width, height=height, frame_index=index, time_s=time_s)
