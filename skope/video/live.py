"""Frames of a live stream: the newest one whenever one is asked for, so that a slow reader does not fall behind."""

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
    """A stream that broke off is waited for this long, seconds."""
    pause_s: float = 1.0
    """Time between two attempts to connect, seconds."""
    patience_s: float = 7.0
    """The end waits this long for the reading thread, seconds: longer than the network may be silent."""
    agree_s: float = 0.5
    """A camera's time stamp agrees with the arrival of its frame if it is ahead by less than this, seconds."""
    late_s: float = 5.0
    """A frame may arrive this long after its time stamp says, seconds: a network that stalled delivers late."""
    drift_window_s: float = 20.0
    """If all frames of this time arrive late, the camera's clock is slow, seconds."""
    steady_frames: int = 5
    """Consecutive frames whose time stamps agree with each other, but not with the clock so far: the clock was set."""
    stamp_round_s: float = 2**32 / 90_000
    """Time stamps of video over RTP begin anew after this time, seconds (RFC 3551: 32 bits, 90 kHz)."""
    least_step_s: float = 1e-3
    """Times of two frames differ by at least this, seconds."""


LIVE_LIMITS: Final = LiveLimits()


class BrokenOffError(Exception):
    """A stream has ended, cannot be reached any more, or sends frames of another shape."""


class Frame(NamedTuple):
    """A frame of a stream."""

    number: int
    """Number of frames that arrived before it."""
    time_s: float
    """Seconds since the first frame."""
    pixels: Pixels
    """(H, W, 3) RGB, in the size of the first frame."""


class _Arrived(NamedTuple):
    """A frame that is not converted yet: most are passed over."""

    number: int
    time_s: float
    frame: "VideoFrame"
    size: tuple[int, int]


class CameraClock:
    """Times of frames: those of their arrival, with the camera's intervals as long as they agree with it.

    Arrival is late by what the network takes, which varies; a camera's time stamps are even, but clocks are set, and
    single time stamps are wrong. A time stamp is believed while it puts the frame before its arrival, by
    `LIVE_LIMITS.late_s` at most. The smallest delay so far is taken for none.
    """

    def __init__(self) -> None:
        self.steps: list[tuple[float, float]] = []
        """Times at which the camera's clock was set, and by how much, seconds."""
        self.strays = 0
        """Number of frames whose time stamp was not believed and which did not become a step."""
        self.last_s = -1.0
        """Time of the last frame, seconds."""
        self._offset_s: float | None = None
        self._good_stamp_s = 0.0
        self._delays: deque[tuple[float, float]] = deque()
        self._doubted: list[tuple[float, float]] = []

    def restart(self) -> None:
        """Forget the camera's clock: it begins anew when a stream is opened again."""
        self._offset_s = None
        self._delays.clear()
        self._doubted.clear()

    def time_of(self, stamp_s: float | None, arrived_s: float) -> float:
        """Time of a frame, seconds; it rises from frame to frame.

        Args:
            stamp_s: The camera's time stamp, seconds; None where there is none.
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
            # No frame arrives before it was taken; and if all are late, the clock is slow.
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
            # FFmpeg takes a step back for the rest of a round forward.
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
    """What happened to a stream while it was read."""

    received: int = 0
    """Frames that arrived whole."""
    taken: int = 0
    """Frames that were analysed, as the caller counts them; the others were passed over."""
    damaged: int = 0
    """Frames that arrived damaged, and were dropped."""
    strays: int = 0
    """Frames whose time stamps were not believed; their times are those of arrival."""
    last_s: float = 0.0
    """Time of the last frame, seconds."""
    events: list[str] = field(default_factory=list)
    """Interruptions and changes, a line each."""

    def __str__(self) -> str:
        passed = self.received - self.taken
        line = f"{self.received} frames received, {self.taken} analysed, {passed} passed over"
        line += f", {self.damaged} damaged" if self.damaged else ""
        line += f"; {self.taken / self.last_s:.1f} analysed per second" if self.last_s > 1 else ""
        return line + (f"; {self.strays} time stamps were not believed" if self.strays else "")


class _Newest:
    """Holds the newest frame: each frame takes the place of the one before."""

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
        """The newest frame, waited for; None when there are no more. Raises what the reader met."""
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None or self.ended)
            frame, self._frame = self._frame, None
            if frame is None and self._error is not None:
                raise self._error
            return frame


def stream_frames(address: str, every: int, record: StreamRecord) -> Generator[Frame]:
    """Every `every`-th frame of a stream as far as the caller keeps up; the others are passed over.

    Args:
        address: Address of the stream. It is opened again when it breaks off.
        every: Step between the frames that are taken.
        record: Is kept up to date.

    Yields:
        The newest frame whenever the caller asks for one.

    Raises:
        BrokenOffError: The stream broke off and did not come back, or its frames have another shape.
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
    """Reads a stream in a thread of its own, through all its interruptions."""

    def __init__(self, address: str, every: int, newest: _Newest, record: StreamRecord) -> None:
        self._address, self._every, self._newest, self._record = address, every, newest, record
        self._clock = CameraClock()
        self._begun_s = 0.0
        self._first_size: tuple[int, int] | None = None
        self._last_size: tuple[int, int] | None = None

    def run(self) -> None:
        """Read until nobody wants the stream, or it is gone."""
        try:
            self._drain()
            while not self._newest.ended:
                self._come_back()
            self._newest.end()
        except Exception as error:  # raised again where the frames are taken
            self._newest.end(error)

    def _come_back(self) -> None:
        """Open a stream that broke off again; a BrokenOffError where it sends nothing within `LIVE_LIMITS.return_s`."""
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
        """Read one opening of the stream until it ends, falls silent, or nobody wants it."""
        with opened(self._address) as (container, stream):
            came_back = self._record.received > 0
            self._clock.restart()
            # Time stamps of images over HTTP are invented by the reader.
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
        """Report a new size; a BrokenOffError for another shape."""
        first = self._first_size = self._first_size or size
        if size != (self._last_size or first):
            change = f"frames are {size[0]}x{size[1]} from {time_s:.1f} s on, {first[0]}x{first[1]} before"
            if not same_shape(size, first):
                raise BrokenOffError(f"{change}; the recording ends there")
            self._event(f"{change}; they are scaled" if size != first else f"frames are {first[0]}x{first[1]} again")
        self._last_size = size

    def _event(self, line: str) -> None:
        self._record.events.append(line)
