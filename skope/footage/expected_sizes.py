"""Expected sizes of vehicles at each place of a camera's image, told by those that drive through it."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from skope.types import Array

SizeSample = tuple[float, float, float]
"""Place of a box on the road, x and y, and its size there, the square root of its area; pixels."""

_FEWEST_DRIVERS: Final = 4
"""So many vehicles must have driven before they tell how large others are."""
_TYPICAL: Final = 0.25
"""Relative standard deviation of vehicles' sizes at one place."""
_SPREADS: Final = 2.0
_SIZE_FACTOR: Final = 2.0
"""A vehicle differs from the expected size by this factor at most, and by so many standard deviations of that."""
_FIT_ROUNDS: Final = 10


class ExpectedSizes:
    """Expected sizes of vehicles at each place of the image.

    On a plane inverse depth is affine in the image's coordinates, and so are sizes, but for the kinds of vehicles.
    """

    def __init__(self, vehicles: Sequence[Sequence[SizeSample]]) -> None:
        """`vehicles` are the samples of each vehicle that drove."""
        self._enough = len(vehicles) >= _FEWEST_DRIVERS
        if self._enough:
            samples = np.array([sample for samples in vehicles for sample in samples])
            self._parameters, self._covariance = _fitted(samples)

    def allow(self, sample: SizeSample) -> bool:
        """Whether a vehicle may be so large where it is; also where that cannot be told."""
        if not self._enough:
            return True
        *place, size = sample
        at = np.array([1.0, *place])
        expected = float(at @ self._parameters)
        spread = _SPREADS * float(np.sqrt(at @ self._covariance @ at))
        return (expected - spread) / _SIZE_FACTOR < size < (expected + spread) * _SIZE_FACTOR


def _fitted(samples: Array) -> tuple[Array, Array]:
    """(3,) size at the origin and its slopes along x and y from (N, 3) samples x, y, size; (3, 3) their covariance.

    Errors count relative to the size, large ones in proportion only (Huber).
    """
    design = np.column_stack([np.ones(len(samples)), samples[:, :2]]) / samples[:, 2:]
    weights = np.ones(len(samples))
    for _ in range(_FIT_ROUNDS):
        normal = design.T @ (design * weights[:, None])
        parameters = np.linalg.lstsq(normal, design.T @ weights, rcond=None)[0]
        errors = np.abs(design @ parameters - 1)
        weights = np.minimum(1.0, _TYPICAL / np.maximum(errors, 1e-9))
    return np.asarray(parameters), np.asarray(_TYPICAL**2 * np.linalg.pinv(normal))
