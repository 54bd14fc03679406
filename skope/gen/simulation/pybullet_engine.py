"""The one place that imports pybullet, without the line that it prints."""

import os
from functools import cache
from typing import Any


@cache
def engine() -> Any:
    """The pybullet module."""
    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        # The line comes from C, past sys.stderr.
        os.dup2(null, 2)
        import pybullet
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)
    return pybullet
