"""Keypoint R-CNN detector: build, save, load, run; and the weights that come with the package."""

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skope.detector.checkpoint import read_checkpoint as read_checkpoint

# Threads of torch (OpenMP) spin after each operation and take processors from OpenVINO, which makes it 15% slower. The
# variable limits this if torch has not been imported before.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")


def __getattr__(name: str) -> Any:
    """Load `read_checkpoint` on first use, because torch takes seconds to import and `weights` does not need it."""
    if name != "read_checkpoint":
        raise AttributeError(f"module 'skope.detector' has no attribute {name!r}")
    from skope.detector.checkpoint import read_checkpoint

    return read_checkpoint
