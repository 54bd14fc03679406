"""Detectors that come with the package: `NAME.safetensors` with a card, `NAME.md`, beside it."""

from pathlib import Path
from typing import Final

DEFAULT: Final = "road33"
"""The detector that runs where none is named, and from which training begins where COCO's weights are not at hand."""

LIGHT: Final = "road33-lite"
"""The light detector, for every frame of a live camera on a CPU."""
BY_ACCURACY: Final = (DEFAULT, LIGHT)
"""The detectors that come with the package, the most accurate first: alike in keypoints and categories."""

FOLDER: Final = Path(__file__).parent


def names() -> tuple[str, ...]:
    """Names of the detectors that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.safetensors")))


def path(name: str) -> Path:
    """The file of the weights called `name`, one of `names`."""
    return FOLDER / f"{name}.safetensors"


def shipped(weights: Path) -> bool:
    """Whether a file of weights lies in the package, where nothing of a user's is written."""
    return weights.parent == FOLDER
