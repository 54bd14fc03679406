"""Fit the most likely body types to vehicles: place every type's mean, optimise the few best."""

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
"""Minimum number of keypoints for a pose, with (True) and without (False) a known ground."""
INLIER_VARIANCES: Final = 9.0
"""Maximum squared distance, in variances, of an agreeing keypoint."""
_KEPT_TYPES: Final = 2
"""Number of body types that are optimised after the start."""


def vehicle_starts(seen: Observed, shapes: Shapes, ground: Ground | None, chosen: Mask | None = None) -> Starts:
    """Start a fit of each body type to each vehicle.

    Args:
        seen: N vehicles.
        shapes: The body types; each gets a start.
        ground: The road; None: distance follows from the size of vehicles.
        chosen: (N, 33) keypoints to start from; None: all that count.
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
        starts: One start per vehicle and type.
        kinds: (N, kept) types to optimise.

    Returns:
        (N, kept) fits, best first.
    """
    chosen = np.argsort(starts.cost, axis=1)[:, : min(_KEPT_TYPES, starts.cost.shape[1])]
    return refine(seen, shapes, ground, starts.take(chosen), kinds[chosen]).ordered()


def best_types(seen: Observed, shapes: Shapes, ground: Ground | None) -> Fits:
    """Fit the most likely body types to each vehicle, best first; without the search of `skope.pose.search`.

    Args:
        seen: Keypoints of N vehicles.
        shapes: The body types to choose from.
        ground: The road; None: unknown.
    """
    return refined(seen, shapes, ground, vehicle_starts(seen, shapes, ground), np.arange(len(shapes.types)))


def agreeing_share(seen: Observed, fits: Fits) -> Array:
    """Return (N,) the share of the counted keypoints that agree with the best fit."""
    agree = (fits.squared[:, 0] <= INLIER_VARIANCES) & seen.counted
    return np.asarray(agree.sum(axis=1) / np.maximum(seen.count, 1))
