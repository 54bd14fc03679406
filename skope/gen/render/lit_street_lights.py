"""Choice of the street lights that burn, where only a share of them do."""

from typing import Final

import numpy as np

from skope.types import Array

_STRETCH_M: Final = 55.0
"""Lamps this near to each other mostly fail together, as those on one cable do."""
_SHARED_LUCK: Final = 0.65
"""Share of a lamp's luck that it has in common with its stretch."""


def burning(lamps: Array, share: float) -> Array:
    """The street lights (N, 3) that burn where `share` of them (0 to 1) do: the same ones at every call.

    Those that do not mostly stand beside each other, so that the road between them is dark.
    """
    if share >= 1:
        return lamps
    luck = _SHARED_LUCK * _hashed(np.floor(lamps[:, :2] / _STRETCH_M)) + (1 - _SHARED_LUCK) * _hashed(lamps[:, :2])
    first = luck.argsort(kind="stable")[: round(share * len(lamps))]
    return lamps[np.sort(first)]


def _hashed(at: Array) -> Array:
    """(N,) numbers in 0..1 that look random, of places (N, 2)."""
    return np.asarray(np.abs(np.sin(at @ [12.9898, 78.233]) * 43758.5453) % 1.0)
