"""Fit the likeliest body types to vehicles: place every type's mean, optimise the few best."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.ground_plane import Ground
from skope.pose import closed_form_starts
from skope.pose.closed_form_starts import Starts
from skope.pose.levenberg_marquardt import Fits, refine
from skope.pose.observations import Observed
from skope.pose.shape_model import Shapes
from skope.types import Array, Mask

Kinds = NDArray[np.intp]

FEWEST_KEYPOINTS: Final = {True: 4, False: 6}
"""Keypoints that a pose needs, with (True) and without (False) a known ground."""
INLIER_VARIANCES: Final = 9.0
"""Squared distance, in variances, up to which a keypoint agrees."""
_KEPT_TYPES: Final = 2
"""Body types that go on from the start."""


def vehicle_starts(seen: Observed, shapes: Shapes, ground: Ground | None, chosen: Mask | None = None) -> Starts:
    """Start a fit of each body type to each vehicle.

    Args:
        seen: N vehicles.
        shapes: The body types, each of which has a start.
        ground: The road; None: the size of vehicles tells distance.
        chosen: (N, 33) keypoints to begin from; None: all that count.
    """
    return (
        closed_form_starts.on_ground(seen, shapes, ground, chosen)
        if ground
        else closed_form_starts.placed_anywhere(seen, shapes, chosen)
    )


def refined(seen: Observed, shapes: Shapes, ground: Ground | None, starts: Starts, kinds: Kinds) -> Fits:
    """Optimise the best starts of each vehicle.

    Args:
        seen: Keypoints of N vehicles.
        shapes: The body types.
        ground: The road; None: unknown.
        starts: A start for each vehicle and type.
        kinds: (N, kept) types that go on.

    Returns:
        (N, kept) fits, the best first.
    """
    chosen = np.argsort(starts.cost, axis=1)[:, : min(_KEPT_TYPES, starts.cost.shape[1])]
    return refine(seen, shapes, ground, starts.take(chosen), kinds[chosen]).ordered()


def best_types(seen: Observed, shapes: Shapes, ground: Ground | None) -> Fits:
    """Fit the likeliest body types to each vehicle, the best first; no search as in `skope.pose.search`.

    Args:
        seen: Keypoints of N vehicles.
        shapes: The body types to choose from.
        ground: The road; None: unknown.
    """
    return refined(seen, shapes, ground, vehicle_starts(seen, shapes, ground), np.arange(len(shapes.types)))


def agreeing_share(seen: Observed, fits: Fits) -> Array:
    """(N,) share of the keypoints that count which agree with the best fit."""
    agree = (fits.squared[:, 0] <= INLIER_VARIANCES) & seen.counted
    return np.asarray(agree.sum(axis=1) / np.maximum(seen.count, 1))
