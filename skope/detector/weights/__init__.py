"""Detectors that come with the package: `NAME.safetensors` with a card, `NAME.md`, beside it."""

from pathlib import Path
from typing import Final

DEFAULT_WEIGHTS: Final = "road33"
"""Name of the default detector. Training starts from this detector if COCO's weights are not available."""

LIGHT_WEIGHTS: Final = "road33-lite"
"""Name of the light detector, which processes every frame of a live camera on a CPU."""
BY_ACCURACY: Final = (DEFAULT_WEIGHTS, LIGHT_WEIGHTS)
"""Shipped detectors, the most accurate first. They have the same keypoints and categories."""

WEIGHTS_FOLDER: Final = Path(__file__).parent


def names() -> tuple[str, ...]:
    """Return the names of the detectors that come with the package."""
    return tuple(sorted(path.stem for path in WEIGHTS_FOLDER.glob("*.safetensors")))


def path(name: str) -> Path:
    """Return the file of the weights called `name`, one of `names`."""
    return WEIGHTS_FOLDER / f"{name}.safetensors"


def shipped(weights: Path) -> bool:
    """Return whether a weights file is inside the package. User files are never written there."""
    return weights.parent == WEIGHTS_FOLDER
