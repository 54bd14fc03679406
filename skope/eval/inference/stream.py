"""Frames of a live stream: the newest whenever one is asked for, so that a slow reader does not fall behind."""

import contextlib
import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.errors import UserError

RETURN_S = 10.0
"""Seconds for which a stream that broke off is waited for."""
_PAUSE_S: Final = 1.0
_PATIENCE_S: Final = 5.0
"""Seconds for which the end waits for a reader that waits for the network."""


class BrokenOffError(Exception):
    """A stream has ended or cannot be reached any more; says since when."""


class Frame(NamedTuple):
    """A frame of a stream."""

    number: int
    """Number of frames before it."""
    time_s: float
    """Seconds since the first frame."""
    bgr: NDArray[np.generic]
    """(H, W, 3) or (H, W), as OpenCV gives it."""


class _Newest:
    """Holds the newest frame: each frame takes the place of the one before."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._frame: Frame | None = None
        self._error: Exception | None = None
        self.ended = False

    def put(self, frame: Frame) -> None:
        with self._changed:
            self._frame = frame
            self._changed.notify()

    def end(self, error: Exception | None = None) -> None:
        with self._changed:
            self.ended, self._error = True, error
            self._changed.notify()

    def take(self) -> Frame | None:
        """The newest frame, waited for; None when there are no more. Raises what the reader met."""
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None or self.ended)
            frame, self._frame = self._frame, None
            if frame is None and self._error is not None:
                raise self._error
            return frame


def stream_frames(
    opened: Callable[[], AbstractContextManager[cv2.VideoCapture]], every: int, *, camera_clock: bool
) -> Generator[Frame]:
    """Every so many-th frame of a stream as far as the caller keeps up: what comes meanwhile is passed over.

    Args:
        opened: Opens the stream, each time anew.
        every: Take each so many-th frame.
        camera_clock: Times are those that the frames carry; else those of arrival.

    Yields:
        The newest frame whenever the caller asks for one.

    Raises:
        BrokenOffError: The stream broke off, was opened again and did not come back.
    """
    newest = _Newest()
    reader = threading.Thread(target=_read, args=(opened, every, camera_clock, newest), daemon=True)
    reader.start()
    try:
        while frame := newest.take():
            yield frame
    finally:
        newest.ended = True
        reader.join(_PATIENCE_S)


def _read(
    opened: Callable[[], AbstractContextManager[cv2.VideoCapture]], every: int, camera_clock: bool, newest: _Newest
) -> None:
    """Read until nobody wants the stream, or it is gone."""
    stream = _Stream(every, camera_clock, newest)
    try:
        with opened() as capture:
            stream.drain(capture)
        while not newest.ended:
            _again(opened, stream)
        newest.end()
    except Exception as error:  # raised again where the frames are taken
        newest.end(error)


def _again(opened: Callable[[], AbstractContextManager[cv2.VideoCapture]], stream: "_Stream") -> None:
    """Open a stream that broke off again, and go on; a BrokenOffError where it sends nothing within `RETURN_S`."""
    begun, before = time.monotonic(), stream.count
    while time.monotonic() - begun < RETURN_S and not stream.newest.ended:
        with contextlib.suppress(UserError), opened() as capture:
            stream.drain(capture)
        if stream.count > before:
            return
        time.sleep(min(_PAUSE_S, RETURN_S / 4))
    if not stream.newest.ended:
        raise BrokenOffError(f"broke off after {stream.last:.1f} s and {stream.count} frames, and did not come back")


class _Stream:
    """State that lasts from one opening of a stream to the next: the count of its frames and their time."""

    def __init__(self, every: int, camera_clock: bool, newest: _Newest) -> None:
        self.newest = newest
        self.count = 0
        self.last = -1.0
        """Time of the last frame that was passed on, seconds since the first frame of all."""
        self._every, self._camera_clock = every, camera_clock
        self._begun = 0.0

    def drain(self, capture: cv2.VideoCapture) -> None:
        """Empty the stream until it ends or nobody wants it; the capture belongs to this thread alone."""
        offset: float | None = None
        while not self.newest.ended and capture.grab():
            arrived = time.monotonic()
            if self.count == 0:
                self._begun = arrived
            clock_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000 if self._camera_clock else arrived
            # A camera's clock begins anew with each opening; ours says how long the gap was.
            offset = arrived - self._begun - clock_s if offset is None else offset
            time_s = clock_s + offset
            if self.count % self._every == 0 and time_s > self.last:  # trackers need times that rise
                good, bgr = capture.retrieve()
                if good:
                    self.last = time_s
                    self.newest.put(Frame(self.count, time_s, bgr))
            self.count += 1
