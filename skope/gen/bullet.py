"""The one place that imports pybullet, without the line that it prints."""

import ctypes
import os
import sys
from functools import cache
from typing import Any


@cache
def engine() -> Any:
    """The pybullet module."""
    sys.stdout.flush()
    kept = os.dup(1)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        # The line comes from C, past sys.stdout, and may wait in C's own buffer.
        os.dup2(null, 1)
        import pybullet

        ctypes.CDLL(None).fflush(None)
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(null)
    return pybullet
