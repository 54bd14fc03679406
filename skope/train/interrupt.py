"""Ctrl-C and SIGTERM that wait for the step in progress, so that its state can be saved."""

import os
import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_ANSWER = b"\nskope: stopping after this step, to save it; once more stops at once\n"


class StopRequest:
    """Context in which the first SIGINT or SIGTERM only sets `asked`; a second one interrupts at once."""

    def __init__(self, *, tell: bool = False) -> None:
        """With `tell` the first signal is answered on standard error."""
        self.asked: signal.Signals | None = None
        self._tell = tell
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # Python allows handlers nowhere else
            self._before = {number: signal.signal(number, self._heard) for number in _SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if self.asked is not None:
            raise KeyboardInterrupt
        self.asked = signal.Signals(number)
        if self._tell:  # print() may be in the middle of a line just now
            os.write(2, _ANSWER)


def ignore_signals(_worker: int) -> None:
    """Ignore SIGINT and SIGTERM in a loading process: whoever ends a whole group of processes ends this one through its
    parent, not before it."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
