"""Detectors that come with the package: `NAME.safetensors` with a card, `NAME.md`, beside it."""

from pathlib import Path
from typing import Final

REFERENCE: Final = "reference"
NAMES: Final = (REFERENCE,)

FOLDER: Final = Path(__file__).parent


def path(name: str) -> Path:
    """The file of the weights called `name`, one of `NAMES`."""
    return FOLDER / f"{name}.safetensors"


def shipped(weights: Path) -> bool:
    """Whether a file of weights lies in the package, where nothing of a user's is written."""
    return weights.parent == FOLDER
