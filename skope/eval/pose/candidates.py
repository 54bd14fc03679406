"""The likeliest body types of vehicles, each with its pose: what every search for a pose is made of."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.eval.pose import initialize
from skope.eval.pose.observations import Mask, Observed
from skope.eval.pose.optimize import Fits, refine
from skope.eval.pose.shape_model import Shapes
from skope.eval.pose.types import Ground, Starts

Array = NDArray[np.float64]
Kinds = NDArray[np.intp]

FEWEST: Final = {True: 4, False: 6}
"""Keypoints a pose needs, with and without a known ground."""
INLIER: Final = 9.0
"""Squared distance, in variances, up to which a keypoint agrees."""
_KEPT: Final = 2
"""Body types that go on from the start."""


def starts_of(seen: Observed, shapes: Shapes, ground: Ground | None, chosen: Mask | None = None) -> Starts:
    """A start for each body type, from the keypoints `chosen` (N, 33), by default all that count."""
    return initialize.on_ground(seen, shapes, ground, chosen) if ground else initialize.free(seen, shapes, chosen)


def refined(seen: Observed, shapes: Shapes, ground: Ground | None, starts: Starts, kinds: Kinds) -> Fits:
    """(N, kept) fits from the best starts of each vehicle, the best first."""
    chosen = np.argsort(starts.cost, axis=1)[:, : min(_KEPT, starts.cost.shape[1])]
    return refine(seen, shapes, ground, starts.take(chosen), kinds[chosen]).ordered()


def best_types(seen: Observed, shapes: Shapes, ground: Ground | None) -> Fits:
    """Fits of the likeliest body types to each vehicle, the best first, without second tries."""
    return refined(seen, shapes, ground, starts_of(seen, shapes, ground), np.arange(len(shapes.types)))


def share(seen: Observed, fits: Fits) -> Array:
    """(N,) of the keypoints that count, how many agree with the best fit."""
    agree = (fits.squared[:, 0] <= INLIER) & seen.counted
    return np.asarray(agree.sum(axis=1) / np.maximum(seen.count, 1))
