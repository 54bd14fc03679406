"""Files of weights that others have published: torchvision's cache of them, and torch's own format."""

import argparse
import pickle
import re
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlparse

import torch
from torchvision.models import WeightsEnum

from skope.errors import UserError

PublishedState = dict[str, torch.Tensor]
_NO_WEIGHTS: Final = "not a file of weights of torch's, or one that did not arrive whole"


def cached_weights(weights: WeightsEnum) -> Path:
    """Path at which torchvision keeps the file of published weights, whether or not it is there."""
    return Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(weights.url).path).name


def fetch(init: str, weights: WeightsEnum) -> Path:
    """The file of published weights, downloaded where it is missing; a UserError names `--init init` if that fails."""
    path = cached_weights(weights)
    if path.is_file():
        return path
    digest = re.search(r"-([0-9a-f]{8,})\.pth$", path.name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(weights.url, str(path), digest.group(1) if digest else None)
    except (OSError, RuntimeError) as error:
        raise UserError(
            f"--init {init}: cannot download {weights.url} ({error}); put the file at {path}, or take --init random"
        ) from None
    return path


def unpickled(path: Path) -> PublishedState:
    """The state dict in a file of torch's, or under the key `model` as torchvision's training scripts save it.

    These scripts put their arguments beside it, in a class that holds nothing but values.
    """
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        other = re.search(r"Unsupported global: GLOBAL (\S+)", str(error))
        if other is None:
            raise UserError(f"{path}: {_NO_WEIGHTS}") from None
        raise UserError(
            f"{path}: holds more than tensors ({other[1]}), and is not loaded: it might run anything. If you trust it, "
            "take the weights out of it in Python: checkpoint = torch.load(FILE, weights_only=False), "
            'then torch.save(checkpoint["model"], NEW), or under whichever key they are'
        ) from None
    except Exception as error:  # torch.load raises whatever the broken archive led to
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"{path}: {_NO_WEIGHTS} ({reason})") from None
    if isinstance(state, dict) and isinstance(state.get("model"), dict):
        state = state["model"]
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise UserError(f"{path}: not a file of weights: expected tensors by name")
    return state
