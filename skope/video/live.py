"""Frames of a live stream: each request returns the newest frame, so that a slow reader does not fall behind."""

import contextlib
import itertools
import threading
import time
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from skope.errors import UserError
from skope.types import Pixels
from skope.video.container import opened
from skope.video.decode import Decoder, fitted, packets, rgb_of, same_shape, shown_size

if TYPE_CHECKING:
    from av.video.frame import VideoFrame


@dataclass(frozen=True)
class LiveLimits:
    """Waiting times and clocks of live streams."""

    return_s: float = 10.0
    """Maximum time to wait for a stream that broke off, seconds."""
    pause_s: float = 1.0
    """Time between two attempts to connect, seconds."""
    patience_s: float = 7.0
    """Maximum time to wait for the reading thread at the end, seconds: longer than the network may be silent."""
    agree_s: float = 0.5
    """Maximum time by which a camera's time stamp may be ahead of the frame's arrival, seconds."""
    late_s: float = 5.0
    """Maximum delay of a frame's arrival after its time stamp, seconds: a stalled network delivers late."""
    drift_window_s: float = 20.0
    """Duration after which the camera's clock counts as slow if all frames arrive late, seconds."""
    steady_frames: int = 5
    """Number of consecutive frames with consistent time stamps that differ from the clock so far: the clock was set."""
    stamp_round_s: float = 2**32 / 90_000
    """Period after which time stamps of video over RTP wrap around, seconds (RFC 3551: 32 bits, 90 kHz)."""
    least_step_s: float = 1e-3
    """Minimum difference between the times of two frames, seconds."""


LIVE_LIMITS: Final = LiveLimits()


class BrokenOffError(Exception):
    """Stream that has ended, is unreachable, or sends frames of another aspect ratio."""


class Frame(NamedTuple):
    """Frame of a stream."""

    number: int
    """Number of frames that arrived before it."""
    time_s: float
    """Time since the first frame, seconds."""
    pixels: Pixels
    """(H, W, 3) RGB, in the size of the first frame."""


class _Arrived(NamedTuple):
    """Frame that is not converted yet, because most frames are passed over."""

    number: int
    time_s: float
    frame: "VideoFrame"
    size: tuple[int, int]


class CameraClock:
    """Times of frames: those of their arrival, refined by the camera's intervals while both agree.

    The network delays arrivals by a varying time. A camera's time stamps are regular, but clocks are set, and single
    time stamps are wrong. A time stamp is accepted if it puts the frame at most `LIVE_LIMITS.late_s` before its
    arrival. The smallest delay so far counts as zero.
    """

    def __init__(self) -> None:
        self.steps: list[tuple[float, float]] = []
        """Times at which the camera's clock was set, and the size of each step, seconds."""
        self.strays = 0
        """Number of frames with a rejected time stamp that did not become a step."""
        self.last_s = -1.0
        """Time of the last frame, seconds."""
        self._offset_s: float | None = None
        self._good_stamp_s = 0.0
        self._delays: deque[tuple[float, float]] = deque()
        self._doubted: list[tuple[float, float]] = []

    def restart(self) -> None:
        """Reset the camera's clock, which restarts when a stream is opened again."""
        self._offset_s = None
        self._delays.clear()
        self._doubted.clear()

    def time_of(self, stamp_s: float | None, arrived_s: float) -> float:
        """Return the time of a frame, seconds; it rises from frame to frame.

        Args:
            stamp_s: The camera's time stamp, seconds; None if there is none.
            arrived_s: Time of arrival, seconds since the first frame.
        """
        time_s = arrived_s if stamp_s is None else self._believed(stamp_s, arrived_s)
        self.last_s = max(time_s, self.last_s + LIVE_LIMITS.least_step_s)
        return self.last_s

    def _believed(self, stamp_s: float, arrived_s: float) -> float:
        if self._offset_s is None:
            self._anchor(stamp_s, arrived_s)
            return arrived_s
        delay_s = arrived_s - (stamp_s + self._offset_s)
        if stamp_s > self._good_stamp_s and -LIVE_LIMITS.agree_s < delay_s < LIVE_LIMITS.late_s:
            self.strays += len(self._doubted)
            self._doubted.clear()
            self._good_stamp_s = stamp_s
            self._delays.append((arrived_s, delay_s))
            while arrived_s - self._delays[0][0] > LIVE_LIMITS.drift_window_s:
                self._delays.popleft()
            # No frame arrives before it was taken. If all are late, the clock is slow.
            full = arrived_s - self._delays[0][0] > LIVE_LIMITS.drift_window_s / 2
            correction = min(delay_s, 0.0) or (min(delay for _, delay in self._delays) if full else 0.0)
            if correction:
                self._offset_s += correction
                self._delays = deque((at, delay - correction) for at, delay in self._delays)
            return stamp_s + self._offset_s
        self._doubted.append((stamp_s, arrived_s))
        recent = self._doubted[-LIVE_LIMITS.steady_frames :]
        pairs = list(itertools.pairwise(recent))
        steady = all(b[0] > a[0] and abs((b[0] - a[0]) - (b[1] - a[1])) < LIVE_LIMITS.agree_s for a, b in pairs)
        if len(recent) == LIVE_LIMITS.steady_frames and steady:
            # FFmpeg interprets a step back as a step forward by the rest of a period.
            self.steps.append(
                (
                    arrived_s,
                    (-delay_s + LIVE_LIMITS.stamp_round_s / 2) % LIVE_LIMITS.stamp_round_s
                    - LIVE_LIMITS.stamp_round_s / 2,
                )
            )
            self.strays += len(self._doubted) - LIVE_LIMITS.steady_frames
            self.restart()
            self._anchor(stamp_s, arrived_s)
        return arrived_s

    def _anchor(self, stamp_s: float, arrived_s: float) -> None:
        self._offset_s, self._good_stamp_s = arrived_s - stamp_s, stamp_s


@dataclass
class StreamRecord:
    """Statistics and events of a stream while it was read."""

    received: int = 0
    """Number of frames that arrived undamaged."""
    taken: int = 0
    """Number of analysed frames, as the caller counts them; the others were passed over."""
    damaged: int = 0
    """Number of frames that arrived damaged and were dropped."""
    strays: int = 0
    """Number of frames with rejected time stamps; their times are those of arrival."""
    last_s: float = 0.0
    """Time of the last frame, seconds."""
    events: list[str] = field(default_factory=list)
    """Interruptions and changes, one line each."""

    def __str__(self) -> str:
        passed = self.received - self.taken
        line = f"{self.received} frames received, {self.taken} analysed, {passed} passed over"
        line += f", {self.damaged} damaged" if self.damaged else ""
        line += f"; {self.taken / self.last_s:.1f} analysed per second" if self.last_s > 1 else ""
        return line + (f"; {self.strays} time stamps were rejected" if self.strays else "")


class _Newest:
    """Holds the newest frame; each frame replaces the previous one."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._frame: _Arrived | None = None
        self._error: Exception | None = None
        self.ended = False

    def put(self, frame: _Arrived) -> None:
        with self._changed:
            self._frame = frame
            self._changed.notify()

    def end(self, error: Exception | None = None) -> None:
        with self._changed:
            self.ended, self._error = True, error
            self._changed.notify()

    def take(self) -> _Arrived | None:
        """Wait for and return the newest frame; None if there are no more. Raises the reader's exception."""
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None or self.ended)
            frame, self._frame = self._frame, None
            if frame is None and self._error is not None:
                raise self._error
            return frame


def stream_frames(address: str, every: int, record: StreamRecord) -> Generator[Frame]:
    """Yield every `every`-th frame of a stream as far as the caller keeps up; the others are passed over.

    Args:
        address: Address of the stream. It is opened again after an interruption.
        every: Frame stride.
        record: Statistics, updated in place.

    Yields:
        The newest frame whenever the caller asks for one.

    Raises:
        BrokenOffError: The stream broke off and did not come back, or its frames have another aspect ratio.
    """
    newest = _Newest()
    reader = threading.Thread(target=_Reader(address, every, newest, record).run, daemon=True)
    reader.start()
    try:
        while arrived := newest.take():
            pixels = fitted(rgb_of(arrived.frame), arrived.size)
            assert pixels is not None
            yield Frame(arrived.number, arrived.time_s, pixels)
    finally:
        newest.ended = True
        reader.join(LIVE_LIMITS.patience_s)


class _Reader:
    """Reads a stream in its own thread, across interruptions."""

    def __init__(self, address: str, every: int, newest: _Newest, record: StreamRecord) -> None:
        self._address, self._every, self._newest, self._record = address, every, newest, record
        self._clock = CameraClock()
        self._begun_s = 0.0
        self._first_size: tuple[int, int] | None = None
        self._last_size: tuple[int, int] | None = None

    def run(self) -> None:
        """Read until the consumer has ended or the stream is gone."""
        try:
            self._drain()
            while not self._newest.ended:
                self._come_back()
            self._newest.end()
        except Exception as error:  # raised again in the thread that takes the frames
            self._newest.end(error)

    def _come_back(self) -> None:
        """Reopen a stream that broke off; raise BrokenOffError without data within `LIVE_LIMITS.return_s`."""
        record, begun, before = self._record, time.monotonic(), self._record.received
        while time.monotonic() - begun < LIVE_LIMITS.return_s and not self._newest.ended:
            with contextlib.suppress(UserError):
                self._drain()
            if record.received > before:
                return
            time.sleep(min(LIVE_LIMITS.pause_s, LIVE_LIMITS.return_s / 4))
        if not self._newest.ended:
            raise BrokenOffError(
                f"broke off after {record.last_s:.1f} s and {record.received} frames, and did not come back"
            )

    def _drain(self) -> None:
        """Read one connection until the stream ends or falls silent, or the consumer has ended."""
        with opened(self._address) as (container, stream):
            came_back = self._record.received > 0
            self._clock.restart()
            # The reader invents the time stamps of images over HTTP.
            unit = stream.time_base if self._address.startswith("rtsp") else None
            decoder = Decoder(stream)
            damaged_before = self._record.damaged
            for packet in itertools.chain(packets(container, stream, retries=1), [None]):
                if self._newest.ended:
                    return
                arrived = time.monotonic()
                for frame in decoder.frames_of(packet):
                    if not self._record.received:
                        self._begun_s = arrived
                    if came_back:
                        gap_s = arrived - self._begun_s - self._record.last_s
                        self._event(f"broke off at {self._record.last_s:.1f} s and came back after {gap_s:.1f} s")
                        came_back = False
                    stamp_s = float(frame.pts * unit) if unit and frame.pts is not None else None
                    self._pass_on(frame, stamp_s, arrived - self._begun_s)
                self._record.damaged = damaged_before + decoder.damaged

    def _pass_on(self, frame: "VideoFrame", stamp_s: float | None, arrived_s: float) -> None:
        record, steps = self._record, len(self._clock.steps)
        time_s = self._clock.time_of(stamp_s, arrived_s)
        for at_s, by_s in self._clock.steps[steps:]:
            self._event(f"the camera's clock was set by {by_s:+.1f} s at {at_s:.1f} s; times of arrival count there")
        record.strays = self._clock.strays
        self._check_size(shown_size(frame), time_s)
        number = record.received
        record.received += 1
        record.last_s = time_s
        if number % self._every == 0:
            assert self._first_size is not None
            self._newest.put(_Arrived(number, time_s, frame, self._first_size))

    def _check_size(self, size: tuple[int, int], time_s: float) -> None:
        """Report a new size; raise BrokenOffError for another aspect ratio."""
        first = self._first_size = self._first_size or size
        if size != (self._last_size or first):
            change = f"frames are {size[0]}x{size[1]} from {time_s:.1f} s on, {first[0]}x{first[1]} before"
            if not same_shape(size, first):
                raise BrokenOffError(f"{change}; the recording ends there")
            self._event(f"{change}; they are scaled" if size != first else f"frames are {first[0]}x{first[1]} again")
        self._last_size = size

    def _event(self, line: str) -> None:
        self._record.events.append(line)
