"""Keypoint R-CNN detector: build, save, load, run; and the weights that come with the package."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skope.detector.checkpoint import read_checkpoint as read_checkpoint


def __getattr__(name: str) -> Any:
    """Load `read_checkpoint` on first use, because torch takes seconds to import and `weights` does not need it."""
    if name != "read_checkpoint":
        raise AttributeError(f"module 'skope.detector' has no attribute {name!r}")
    from skope.detector.checkpoint import read_checkpoint

    return read_checkpoint
