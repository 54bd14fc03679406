"""Waiting for other processes, threads and pages, on machines of any speed."""

import time
from collections.abc import Callable
from typing import Final, TypeVar

Found = TypeVar("Found")

HANG_S: Final = 600
"""Seconds after which a test takes what it waits for to hang. It says nothing of speed: machines can be 10 x slower."""


def until(found: Callable[[], Found | None]) -> Found:
    """Return what `found` returns as soon as it is true.

    Raises:
        AssertionError: It has not become true in time.
    """
    end = time.monotonic() + HANG_S
    while not (answer := found()):
        assert time.monotonic() < end, found
        time.sleep(0.01)
    return answer
