"""Import of pybullet without the line that it prints; no other module imports it."""

import os
from functools import cache
from typing import Any


@cache
def engine() -> Any:
    """Return the pybullet module."""
    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        # C code prints the line, so redirecting sys.stderr does not suppress it.
        os.dup2(null, 2)
        import pybullet
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)
    return pybullet
