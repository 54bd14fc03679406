"""Frames of images, folders, globs, videos and streams in order, with their times."""

import bisect
import contextlib
import glob
import itertools
import math
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skope.dataset.folder import read_image
from skope.dataset.picture_headers import read_header
from skope.errors import UserError
from skope.files import safe_names
from skope.schema import Image
from skope.types import Pixels
from skope.video import live
from skope.video.container import CONTAINER_LIMITS, VideoInfo, open_clip, opened, shown_address
from skope.video.decode import decode_frames, fitted, rgb_of, shown_size
from skope.video.live import StreamRecord

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
_GLOB_CHARS: Final = frozenset("*?[")


@dataclass(frozen=True)
class FootageLimits:
    """Limits for seeking and for frame rates."""

    seek_frames: int = 50
    """Number of frames that take as long to decode as to seek past."""
    most_fps: float = 1000.0
    """Maximum frame rate, frames per second."""
    rounded_s: float = 0.5
    """Maximum excess of listed over contained duration, and of packets over frames, that is not reported, seconds."""


FOOTAGE_LIMITS: Final = FootageLimits()


FOUND_AT: Final = "found_at"
"""Field of `info` in the file of frames: path from its folder to the video, or to the folder of the images."""


@dataclass(frozen=True, kw_only=True)
class FrameRange:
    """Part of a source to read."""

    every: int = 1
    """Frame stride: 1 takes every frame, 5 every fifth."""
    start_s: float = 0.0
    end_s: float = math.inf

    def __post_init__(self) -> None:
        if self.every < 1:
            raise UserError(f"--every: expected a whole number from 1, got {self.every}")
        if not 0 <= self.start_s < self.end_s:
            raise UserError(f"--start, --end: expected 0 <= start < end, got {self.start_s:g} and {self.end_s:g}")


@dataclass
class Footage(ABC):
    """Source of frames. Iterating again gives the same frames, unless it is a live stream."""

    name: str
    cut: FrameRange = field(default_factory=FrameRange)
    skipped: list[str] = field(default_factory=list)
    """Messages on images that could not be read."""
    notes: list[str] = field(default_factory=list)
    """Messages on assumptions, and on events of a live stream."""
    broken_off: str = ""
    """Reason why a live stream ended before `cut`; empty if it did not."""
    images: tuple[Path, ...] = ()
    """Image files, in order; empty for a video or stream."""
    clip: VideoInfo | None = None
    """Properties of the video or stream; None for image files."""
    start_time: datetime | None = None
    """Time of second 0 of a live stream by this computer's clock, once its first frame has arrived; else None."""

    @property
    def live(self) -> bool:
        """Whether it cannot be read again."""
        return False

    @property
    def one_size(self) -> bool:
        """Whether all frames have one size, as in a video."""
        return True

    @property
    def names(self) -> list[str]:
        """Names of the images: their paths relative to their common folder."""
        return []

    @property
    @abstractmethod
    def location(self) -> Path | None:
        """The video file, or the folder that the images' names are relative to; None for a source on a server."""

    @property
    @abstractmethod
    def fps(self) -> float | None:
        """Frames per second after the cut; None for images, and for a live stream with its irregular frames."""

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of frames, if the source states it; 0: unknown."""

    @abstractmethod
    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        """Yield frames with their pixels (H, W, 3) RGB, numbered from 1 as `Image.id`, without the `first` ones.

        Unreadable frames are noted in `skipped`, and keep their numbers.
        """

    def frame_size(self) -> tuple[int, int] | None:
        """Return width and height of the first frame, pixels; None for a live stream, or if no frame can be read."""
        if self.live:
            return None
        if self.clip is not None and self.clip.size is not None:
            return self.clip.size
        for image, _ in self.frames():
            return image.width, image.height
        return None

    def _skip(self, reason: str) -> None:
        if reason not in self.skipped:  # another iteration finds the same reasons
            self.skipped.append(reason)


class ImageFiles(Footage):
    """Image files in order, without times."""

    @property
    def one_size(self) -> bool:
        return len({header.shown for header in map(read_header, self.images) if header}) <= 1

    @property
    def names(self) -> list[str]:
        return [path.relative_to(self.location).as_posix() for path in self.images]

    @property
    def location(self) -> Path:
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
    """Base of footage that is read through a `VideoInfo`."""

    clip: VideoInfo = field(kw_only=True)

    @property
    def location(self) -> Path | None:
        return None if self.clip.on_server else Path(self.clip.address)

    @property
    def fps(self) -> float | None:
        return self.clip.rate / self.cut.every

    def __len__(self) -> int:
        count, fps = self.clip.count, self.clip.rate
        last = min(count, self.cut.end_s * fps)
        return max(0, math.ceil((last - math.ceil(self.cut.start_s * fps)) / self.cut.every)) if count > 0 else 0

    def _skip_shape(self, frame: "VideoFrame", size: tuple[int, int]) -> None:
        """Note that frames have another aspect ratio than the first one, of a size (width, height)."""
        left_out, first = ("x".join(map(str, shape)) for shape in (shown_size(frame), size))
        self._skip(f"{shown_address(self.clip.address)}: frames of {left_out} are left out; the first is {first}")


class RecordedVideo(VideoFootage):
    """Video file on this machine: the times of all frames are known beforehand."""

    def __len__(self) -> int:
        return len(self._wanted)

    @property
    def _wanted(self) -> range:
        """Numbers of the frames to read."""
        edges = (self.cut.start_s - CONTAINER_LIMITS.same_s, self.cut.end_s - CONTAINER_LIMITS.same_s)
        first, last = (bisect.bisect_left(self.clip.times_s, edge) for edge in edges)
        return range(first, last, self.cut.every)

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        clip = self.clip
        left = deque(enumerate(self._wanted[first:], start=first + 1))
        if not left:
            return
        size = clip.size
        with contextlib.closing(_numbered(clip, left[0][1])) as decoded:
            for at, frame in decoded:
                missing = []
                while left and left[0][1] < at:
                    missing.append(left.popleft()[1])
                self._note_missing(missing)
                if left and left[0][1] == at:
                    size = size or shown_size(frame)
                    pixels = fitted(rgb_of(frame), size)
                    number, _ = left.popleft()
                    if pixels is None:
                        self._skip_shape(frame, size)
                    else:
                        yield _image(number, f"{self.name}/{at:06d}", pixels, at, clip.times_s[at]), pixels
                if not left:
                    break
        # Fewer frames than packets may be counted, because some encoders write packets that repeat a frame.
        if clip.stamps or len(left) * self.cut.every > clip.rate * FOOTAGE_LIMITS.rounded_s:
            self._note_missing([at for _, at in left])
        if clip.lost > clip.rate * FOOTAGE_LIMITS.rounded_s and self.cut.end_s > clip.times_s[-1]:
            contained = len(clip.times_s)
            self._skip(f"{clip.address}: ends after {contained} of {contained + clip.lost} frames that it lists")

    def _note_missing(self, missing: Sequence[int]) -> None:
        if not missing:
            return
        total = len(self.clip.times_s)
        which = f"frame {missing[0]}" if len(missing) == 1 else f"frames {missing[0]} to {missing[-1]}"
        self._skip(f"{self.clip.address}: {which} of {total} cannot be decoded")


class ServerVideo(VideoFootage):
    """Video file on a server: it is read once from its start, and each frame carries its time."""

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        clip, number, begin, time_s = self.clip, 0, 0, -1 / self.clip.rate
        size: tuple[int, int] | None = None
        origin_s: float | None = None
        with opened(clip.address) as (container, stream):
            for at, frame in enumerate(decode_frames(container, stream)):
                stamp_s = math.nan if frame.time is None else frame.time
                origin_s = stamp_s if origin_s is None else origin_s
                time_s = stamp_s - origin_s if stamp_s - origin_s > time_s else time_s + 1 / clip.rate
                if time_s >= self.cut.end_s - CONTAINER_LIMITS.same_s:
                    return
                if time_s < self.cut.start_s - CONTAINER_LIMITS.same_s:
                    begin = at + 1
                elif (at - begin) % self.cut.every == 0:
                    number += 1
                    size = size or shown_size(frame)
                    if number > first:
                        pixels = fitted(rgb_of(frame), size)
                        if pixels is None:
                            self._skip_shape(frame, size)
                        else:
                            yield _image(number, f"{self.name}/{at:06d}", pixels, at, time_s), pixels


class LiveStream(VideoFootage):
    """Stream of frames that arrive irregularly, and only once."""

    @property
    def live(self) -> bool:
        return True

    @property
    def fps(self) -> None:
        return None

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        clip, record = self.clip, StreamRecord()
        reported = 0
        with contextlib.closing(live.stream_frames(clip.address, self.cut.every, record)) as frames:
            wanted = (frame for frame in frames if frame.time_s >= self.cut.start_s)
            try:
                for number, frame in enumerate(wanted, start=1):
                    if frame.time_s >= self.cut.end_s:
                        break
                    if self.start_time is None:
                        self.start_time = datetime.now(UTC) - timedelta(seconds=frame.time_s)
                    reported = self._report(record, reported)
                    record.taken += 1
                    name = f"{self.name}/{frame.number:06d}"
                    yield _image(number, name, frame.pixels, frame.number, frame.time_s), frame.pixels
            except live.BrokenOffError as error:
                self.broken_off = f"{self.name}: {error}"
                self._skip(self.broken_off)
            finally:
                self._report(record, reported)
                self.notes.append(f"{self.name}: {record}")

    def _report(self, record: StreamRecord, reported: int) -> int:
        """Add the events from number `reported` on to the notes; return the number of events."""
        self.notes += [f"{self.name}: {event}" for event in record.events[reported:]]
        return len(record.events)


def _of_clip(name: str, cut: FrameRange, clip: VideoInfo) -> VideoFootage:
    """Return the footage of a video file or stream."""
    notes = [f"{shown_address(clip.address)} {note}" for note in clip.notes]
    if clip.live:
        return LiveStream(name, cut, clip=clip, notes=notes)
    kind = ServerVideo if clip.on_server else RecordedVideo
    return kind(name, cut, clip=clip, notes=notes)


def open_footage(source: str, cut: FrameRange | None = None, *, fps: float | None = None) -> Footage:
    """Open a source of frames.

    Args:
        source: An image, a folder of images, a glob, a video file, or the address of a stream.
        cut: The part to read; None: all.
        fps: Frame rate of a video file with missing or wrong time stamps; None: use its time stamps.

    Raises:
        UserError: `source` is none of these, or cannot be opened; or `fps` does not fit it.
    """
    cut = cut or FrameRange()
    if fps is not None and not 0 < fps <= FOOTAGE_LIMITS.most_fps:
        raise UserError(f"--fps: expected frames per second up to {FOOTAGE_LIMITS.most_fps:g}, got {fps:g}")
    if "://" in source:
        return _of_clip("stream", cut, open_clip(source, fps))
    footage = _on_this_machine(source, cut, fps)
    if fps is not None and footage.clip is None:
        raise UserError(f"--fps: {source} is not a video; images have no times")
    for image, name in zip(footage.images, footage.names, strict=True):
        if not safe_names.is_relative(name):
            raise UserError(f"{str(image)!r}: no name for a dataset (control characters, backslashes)")
    return footage


def _on_this_machine(source: str, cut: FrameRange, fps: float | None) -> Footage:
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
    return _of_clip(path.stem, cut, open_clip(source, fps))


def _numbered(clip: VideoInfo, first: int) -> Generator[tuple[int, "VideoFrame"]]:
    """Yield frames of a file with their numbers, from number `first` on or slightly before."""
    if clip.stamps and first >= FOOTAGE_LIMITS.seek_frames:
        with opened(clip.address) as (container, stream):
            # Two more frames, which the deinterlacing filter needs.
            container.seek(clip.stamps[first - 2], stream=stream)
            frames = _by_stamp(clip, decode_frames(container, stream))
            reached = next(frames, None)
            if reached and reached[0] <= first - 2:
                yield reached
                yield from frames
                return
    with opened(clip.address) as (container, stream):
        decoded = decode_frames(container, stream)
        yield from _by_stamp(clip, decoded) if clip.stamps else enumerate(itertools.islice(decoded, clip.count))


def _by_stamp(clip: VideoInfo, frames: Iterator["VideoFrame"]) -> Iterator[tuple[int, "VideoFrame"]]:
    """Yield frames with their numbers by time stamp. Frames with unknown time stamps are dropped."""
    numbers = {stamp: number for number, stamp in enumerate(clip.stamps)}
    for frame in frames:
        number = numbers.get(frame.pts) if frame.pts is not None else None
        if number is not None:
            yield number, frame


def _image(number: int, name: str, pixels: Pixels, index: int, time_s: float | None) -> Image:
    height, width = pixels.shape[:2]
    return Image(id=number, file_name=name, width=width, height=height, frame_index=index, time_s=time_s)
