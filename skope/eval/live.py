"""Frames of a live stream: the newest whenever one is asked for, so that a slow reader does not fall behind."""

import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

_PATIENCE_S: Final = 5.0
"""How long the end waits for a reader that waits for the network."""


class Frame(NamedTuple):
    """A frame as it came."""

    number: int
    """How many came before it."""
    time_s: float
    """Since the first."""
    bgr: NDArray[np.generic]


class _Newest:
    """One place for a frame, which the next one takes."""

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


def frames(
    opened: Callable[[], AbstractContextManager[cv2.VideoCapture]], every: int, *, camera_clock: bool
) -> Generator[Frame]:
    """Every so many-th frame of a stream as far as the caller keeps up: what comes meanwhile is passed over.

    Times are those that the frames carry where `camera_clock` says that they are worth it, else those of arrival.
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
    """Empty the stream until it ends or nobody wants it; the capture belongs to this thread alone."""
    try:
        with opened() as capture:
            index, first, last = 0, 0.0, -1.0
            while not newest.ended and capture.grab():
                now = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000 if camera_clock else time.monotonic()
                first = now if index == 0 else first
                if index % every == 0 and now - first > last:  # trackers need times that rise
                    good, bgr = capture.retrieve()
                    if good:
                        last = now - first
                        newest.put(Frame(index, last, bgr))
                index += 1
        newest.end()
    except Exception as error:  # raised again where the frames are taken
        newest.end(error)
