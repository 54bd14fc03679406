"""A live stream in consecutive windows, each of them footage of its own, without a gap between them."""

import itertools
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Final

from skope.schema import Image
from skope.types import Pixels
from skope.video.container import VideoInfo
from skope.video.footage import FrameRange, LiveStream


@dataclass(frozen=True)
class StreamWindowLimits:
    """Tolerances of the times of windows."""

    clock_step_s: float = 10.0
    """Difference between the times of frames and this computer's clock above which the clock was set, seconds. A frame
    may arrive some seconds late."""
    shortest: float = 0.1
    """Minimum length of the first window, as a share of the length of the others; a shorter one is longer by a whole
    window instead."""


STREAM_WINDOW_LIMITS: Final = StreamWindowLimits()


class StreamWindow(LiveStream):
    """The frames of a stream from one time to another. It is read once, as the stream."""

    def __init__(
        self, name: str, clip: VideoInfo, begin: datetime | None, source: Iterator[tuple[Image, Pixels]]
    ) -> None:
        """Hold a window's frames, numbered from 1, whose times are seconds after `begin` (None: not known)."""
        super().__init__(name, FrameRange(), clip=clip)
        self.start_time = begin
        self._source = source

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        yield from itertools.islice(self._source, first, None)


def without_frames(stream: LiveStream) -> StreamWindow:
    """Return a window without frames, for work on a stream that reads none."""
    return StreamWindow(stream.name, stream.clip, None, iter(()))


class StreamWindows:
    """Cuts a stream into windows that end at multiples of their length by the clock.

    The time of a frame is that of the stream. If this computer's clock is set, the next window follows the clock.
    """

    def __init__(
        self, stream: LiveStream, seconds: float, now: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        """Prepare windows of `seconds`; `now` is this computer's clock."""
        self._stream, self._seconds, self._now = stream, seconds, now
        self._set = timedelta()
        """Time by which the clock was set since the stream began."""
        self._next: tuple[Image, Pixels] | None = None
        self._source = stream.frames()

    def __iter__(self) -> Generator[StreamWindow]:
        """Yield windows, each with at least one frame, until the stream ends or breaks off.

        Frames of a window that the caller does not read are dropped.
        """
        while self._next is not None or self._take():
            first_s = self._next_s
            begin = self._begin(first_s)
            left_s = self._seconds - begin.timestamp() % self._seconds
            if left_s < STREAM_WINDOW_LIMITS.shortest * self._seconds:
                left_s += self._seconds
            end_s = first_s + left_s
            frames = self._until(first_s, end_s)
            yield StreamWindow(self._stream.name, self._stream.clip, begin, frames)
            for _ in frames:
                pass

    @property
    def frame_size(self) -> tuple[int, int] | None:
        """Width and height of the next frame, pixels; None before the first window and at the end."""
        return None if self._next is None else (self._next[0].width, self._next[0].height)

    @property
    def _next_s(self) -> float:
        assert self._next is not None
        assert self._next[0].time_s is not None
        return self._next[0].time_s

    def _take(self) -> bool:
        """Read the next frame; return whether there is one."""
        self._next = next(self._source, None)
        return self._next is not None

    def _begin(self, first_s: float) -> datetime:
        """Return the time of a frame at `first_s` of the stream, after each step of this computer's clock."""
        now = self._now()
        if self._stream.start_time is None:
            return now
        begin = self._stream.start_time + timedelta(seconds=first_s) + self._set
        if abs((now - begin).total_seconds()) > STREAM_WINDOW_LIMITS.clock_step_s:
            self._set += now - begin
            begin = now
        return begin

    def _until(self, first_s: float, end_s: float) -> Generator[tuple[Image, Pixels]]:
        """Yield the frames before `end_s`. The frame at `first_s` becomes second 0."""
        for number in itertools.count(1):
            if (self._next is None and not self._take()) or self._next_s >= end_s:
                return
            assert self._next is not None
            image, pixels = self._next
            self._next = None
            assert image.time_s is not None
            yield replace(image, id=number, time_s=image.time_s - first_s), pixels
