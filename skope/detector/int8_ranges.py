"""Value ranges of the inputs of a detector's layers, which int8 inference needs.

The ranges are part of a checkpoint's metadata. The first and last layers, whose weights keep 16 bits in a packed
checkpoint (`skope.detector.compact_weights`), have no range: they are not quantised.
"""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from torch import Tensor, nn

from skope.detector.compact_weights import DELICATE_NAMES
from skope.errors import UserError

RANGES_KEY: Final = "activation_ranges"
"""Metadata key of the ranges in a checkpoint."""

Ranges = Mapping[str, tuple[float, float]]
"""Minimum and maximum input by layer name."""


@dataclass(frozen=True)
class RangeSampling:
    """Settings for measuring the ranges of inputs."""

    clipped_share: float = 1e-4
    """Share of a call's inputs outside its range at each end. Including rare extreme values would make the steps of all
    values coarser."""
    inputs: int = 1 << 18
    """Number of inputs examined per call."""


RANGE_SAMPLING: Final = RangeSampling()


def rounded_layers(model: nn.Module) -> dict[str, nn.Conv2d | nn.Linear]:
    """Return the layers that have ranges, by name."""
    layers = ((n, m) for n, m in model.named_modules() if isinstance(m, nn.Conv2d | nn.Linear))
    return {name: module for name, module in layers if not f"{name}.".startswith(DELICATE_NAMES)}


@contextlib.contextmanager
def noted(model: nn.Module) -> Iterator[dict[str, tuple[float, float]]]:
    """Record the ranges of the inputs of a model's layers while it runs.

    Yields:
        The widest range over all calls, by layer. Layers without input are missing.
    """
    found: dict[str, tuple[float, float]] = {}

    def note(name: str, _: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        x = inputs[0].detach().flatten()
        if not len(x):
            return
        x = x[:: max(1, len(x) // RANGE_SAMPLING.inputs)].float().sort().values
        beyond = int(RANGE_SAMPLING.clipped_share * len(x))
        low, high = float(x[beyond]), float(x[-1 - beyond])
        before = found.get(name, (low, high))
        found[name] = (min(low, before[0]), max(high, before[1]))

    hooks = [layer.register_forward_pre_hook(partial(note, name)) for name, layer in rounded_layers(model).items()]
    try:
        yield found
    finally:
        for hook in hooks:
            hook.remove()


def to_metadata(model: nn.Module, ranges: Ranges) -> dict[str, Any]:
    """Return ranges as checkpoint metadata; empty if a layer has no range."""
    return (
        {RANGES_KEY: {name: list(ends) for name, ends in ranges.items()}}
        if set(ranges) == set(rounded_layers(model))
        else {}
    )


def read(model: nn.Module, metadata: Mapping[str, Any]) -> Ranges | None:
    """Return the input ranges in a checkpoint's metadata; None if the metadata contains none.

    Raises:
        UserError: The ranges do not belong to the layers of `model`.
    """
    stored = metadata.get(RANGES_KEY)
    if stored is None:
        return None
    names = set(rounded_layers(model))
    if not isinstance(stored, dict) or set(stored) != names or not all(map(_is_range, stored.values())):
        raise UserError(f"{RANGES_KEY}: expected the least and largest input of each of {len(names)} layers")
    return {name: (float(low), float(high)) for name, (low, high) in stored.items()}


def _is_range(value: Any) -> bool:
    numbers = isinstance(value, list | tuple) and len(value) == 2 and all(type(x) in (int, float) for x in value)
    return numbers and value[0] <= value[1]
