"""A camera from vehicles, corrected by lengths on the road that somebody knows: a dash, a lane's width, a kerb.

How large vehicles of a country are in the mean, nothing in the image tells: all distances go with it. A length that was
measured on the road does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from skope.camera.derivatives import slopes
from skope.camera.fit.camera_unknowns import UNKNOWN_STEP, camera_of_unknowns, on_road
from skope.camera.fit.fit_camera import CameraEstimate
from skope.errors import UserError
from skope.types import Array

_MARKED_PX: Final = 1.0
"""Standard deviation of a marked end, pixels along each axis."""
_MEASURED: Final = 0.01
"""The same of a measured length, as a share of it."""
_CONTRADICTS: Final = 3.0
"""Deviations between a length and what the vehicles say of it, from which one of them is wrong."""
_STEP_PX: Final = 0.1


@dataclass(frozen=True, eq=False)
class KnownLength:
    """A straight line on the road."""

    ends: Array
    """(2, 2) column and row of its ends, pixels."""
    metres: float

    def log_under(self, unknowns: Array, size: tuple[int, int]) -> Array:
        """The logarithm of its length under the camera with the unknowns (5,)."""
        begin, end = on_road(camera_of_unknowns(unknowns, size), self.ends)
        return np.asarray(np.log(np.linalg.norm(end - begin) + 1e-9))


def corrected(estimate: CameraEstimate, lengths: Sequence[KnownLength]) -> CameraEstimate:
    """The estimate with known lengths, each taken in as Kalman's filter takes in a measurement.

    Raises:
        UserError: A length contradicts the vehicles, or an end lies at the horizon.
    """
    unknowns, covariance = estimate.solved.bundle.camera, estimate.covariance
    size = estimate.views.size
    for length in lengths:
        says = float(length.log_under(unknowns, size))
        slope = slopes(partial(length.log_under, size=size), unknowns, UNKNOWN_STEP)
        across = covariance @ slope
        variance = float(slope @ across) + _variance(length, unknowns, size)
        away = math.log(length.metres) - says
        if not abs(away) < _CONTRADICTS * math.sqrt(variance):
            (a, b), (c, d) = length.ends.tolist()
            raise UserError(
                f"--length {a:g},{b:g},{c:g},{d:g},{length.metres:g}: under the camera that the vehicles tell this is "
                f"{math.exp(says):.3g} m: it is not on the road, the road is no plane, or one of the numbers is wrong"
            )
        unknowns = unknowns + across * away / variance
        covariance = covariance - np.outer(across, across) / variance
    solved = estimate.solved
    shared = np.concatenate([unknowns, solved.bundle.shared[len(unknowns) :]])
    return replace(
        estimate,
        camera=camera_of_unknowns(unknowns, size),
        solved=replace(solved, bundle=replace(solved.bundle, shared=shared)),
        covariance=covariance,
    )


def _variance(length: KnownLength, unknowns: Array, size: tuple[int, int]) -> float:
    """Variance of the logarithm of a length through its marking and measuring."""

    def marked(ends: Array) -> Array:
        return replace(length, ends=ends.reshape(2, 2)).log_under(unknowns, size)

    by_ends = slopes(marked, length.ends.ravel(), _STEP_PX)
    return float(by_ends @ by_ends) * _MARKED_PX**2 + _MEASURED**2
