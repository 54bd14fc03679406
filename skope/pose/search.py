"""Continue the search for poses of vehicles with contradictory keypoints.

The search first leaves out the keypoints that the vehicle's own body hides. If that does not suffice, it tries random
subsets of the keypoints, and keypoints with exchanged sides or ends of the vehicle.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.ground_plane import Ground
from skope.keypoints import FLIP, OTHER_END
from skope.pose.fit_body_types import FEWEST_KEYPOINTS, best_types, refined, vehicle_starts
from skope.pose.levenberg_marquardt import Fits
from skope.pose.observations import Observed
from skope.pose.shape_model import Shapes, facing
from skope.types import Array, Mask

RowNumbers = NDArray[np.intp]

EXCHANGE_FLAGS: Final = ("sides_exchanged", "ends_exchanged", "turned_around")
"""Flags of keypoints that fit only with left and right, front and rear, or both exchanged."""
RANDOM_STARTS: Final = {True: 24, False: 4}
"""Number of random starts, with and without a known ground."""


@dataclass(frozen=True)
class PoseSearch:
    """Starts of the search for a pose, and costs at which labels count as exchanged."""

    start_keypoints: int = 6
    """Number of keypoints of a random start."""
    exchange_gap: float = 12.0
    """Decrease of the cost (twice the negative log likelihood) at which labels count as exchanged."""
    hidden_cost: float = 9.0
    """Cost of a keypoint unrelated to the pose, uniform over the box: the log ratio of the box's area to that of the
    keypoint's own uncertainty."""
    rival_gap: float = 30.0
    """Difference of cost within which the opposite heading remains possible: this flags 2% of the correct headings and
    half of the wrong ones."""
    hidden_rounds: int = 2
    """Number of times that the hidden keypoints are determined from a pose and the pose is fitted without them."""


POSE_SEARCH: Final = PoseSearch()

EXCHANGED_ORDERS: Final = (list(FLIP), list(OTHER_END), [FLIP[i] for i in OTHER_END])
"""Order of the keypoints for each of `EXCHANGE_FLAGS`."""


def retry_from_subsets(seen: Observed, fits: Fits, poor: RowNumbers, shapes: Shapes, ground: Ground | None) -> None:
    """Fit vehicles from random small subsets of keypoints; `fits` is updated with better fits to all keypoints.

    Args:
        seen: Keypoints of N vehicles.
        fits: The fits so far, changed in place.
        poor: Rows of the vehicles to retry.
        shapes: The body types.
        ground: The road; None: unknown.
    """
    times = RANDOM_STARTS[ground is not None]
    some, again = seen.take(poor), seen.take(np.tile(poor, times))
    # A fixed order of the keypoints for each start makes the fits of a vehicle independent of other vehicles.
    order = np.random.default_rng(0).random((times, keypoints.K)).repeat(len(poor), axis=0)
    subsets = again.first_counted(POSE_SEARCH.start_keypoints, order)
    starts = vehicle_starts(again, shapes, ground, subsets).gathered(times)
    better = refined(some, shapes, ground, starts, np.tile(np.arange(len(shapes.types)), times))
    fits.replace_where(poor, better, better.cost[:, 0] < fits.cost[poor, 0])


def without_hidden(
    seen: Observed, fits: Fits, poor: RowNumbers, cut: Mask, shapes: Shapes, ground: Ground | None
) -> tuple[Observed, Array]:
    """Fit the vehicles `poor` without the keypoints that their own bodies hide, in both orientations.

    Detectors also give hidden keypoints high scores. A keypoint that is left out may be anywhere, at the cost
    `POSE_SEARCH.hidden_cost`.

    Args:
        seen: Keypoints of all vehicles.
        fits: Their fits so far; those of `poor` are replaced by better ones.
        poor: Rows of the vehicles to fit.
        cut: (len(poor),) whether the image's edge may cut the vehicle. Keypoints beyond the edge are then left out.
        shapes: The body types.
        ground: The road; None: unknown.

    Returns:
        `seen` without the keypoints that were left out of the fits, and (len(poor),) the additional cost of the
        opposite heading.
    """
    some, every = seen.take(poor), np.arange(len(poor))
    best, cost = fits.take(poor), fits.cost[poor, 0].copy()
    rival = np.full(len(poor), np.inf)  # lowest cost of the opposite heading
    for turned in (False, True):
        guess, reached = best.take(every), np.full(len(poor), np.inf)
        for attempt in range(POSE_SEARCH.hidden_rounds):
            shown = _shown(some, guess, shapes, ground, turned=turned and not attempt)
            shown &= _inside(some, guess, shapes, ground) | ~cut[:, None]
            enough = (some.counted & shown).sum(axis=1) >= FEWEST_KEYPOINTS[ground is not None]
            tried = replace(some, counted=some.counted & (shown | ~enough[:, None]))
            guess = best_types(tried, shapes, ground)
            whole = np.where(enough, guess.cost[:, 0] + POSE_SEARCH.hidden_cost * (some.count - tried.count), np.inf)
            reached = np.minimum(reached, np.where(_opposite(guess, best), whole, np.inf))
            wins = whole < cost
            rival = np.where(wins & _opposite(guess, best), cost, rival)
            best.replace_where(every, guess, wins)
            cost = np.where(wins, whole, cost)
            seen = seen.with_rows(poor[wins], tried.take(np.flatnonzero(wins)))
        rival = np.minimum(rival, reached)
    fits.replace_where(poor, best, np.ones(len(poor), dtype=bool))
    return seen, rival - cost


def _opposite(first: Fits, second: Fits) -> Mask:
    """Return (N,) whether the best fits have opposite headings."""
    return np.asarray(np.einsum("ni,ni->n", first.R[:, 0, :, 0], second.R[:, 0, :, 0]) < 0)


def _shown(seen: Observed, fits: Fits, shapes: Shapes, ground: Ground | None, *, turned: bool) -> Mask:
    """Return (N, 33) whether the best fit's body leaves a keypoint visible; with `turned`, for the opposite heading."""
    R, p, kind = fits.R[:, 0], fits.p[:, 0], fits.kind[:, 0]
    if turned:
        R = R * np.array([-1.0, -1.0, 1.0])
    eye = (np.zeros(3) if ground is None else seen.eye) - p
    return facing(shapes, kind, shapes.mean[kind, :-1], np.einsum("nij,ni->nj", R, eye))


def _inside(seen: Observed, fits: Fits, shapes: Shapes, ground: Ground | None) -> Mask:
    """Return (N, 33) whether the best fit puts a keypoint inside the image."""
    points = np.einsum("nij,nkj->nki", fits.R[:, 0], shapes.mean[fits.kind[:, 0], :-1]) + fits.p[:, 0, None]
    inside = np.zeros(points.shape[:2], dtype=bool)
    for index in np.unique(seen.camera_index):
        camera, rows = seen.cameras[index], seen.camera_index == index
        from_here = camera if ground is not None else replace(camera, T_camera_world=np.eye(4))
        pixels, _, valid = from_here.project(points[rows].reshape(-1, 3))
        inside[rows] = (valid & from_here.inside(pixels)).reshape(-1, points.shape[1])
    return inside


def retry_exchanged(
    seen: Observed,
    whole: Observed,
    fits: Fits,
    poor: RowNumbers,
    shapes: Shapes,
    ground: Ground | None,
    exchanged: dict[int, str],
) -> Observed:
    """Fit the vehicles `poor` with exchanged keypoints of left and right, front and rear, or both.

    Args:
        seen: Keypoints of all vehicles, without those that `without_hidden` left out.
        whole: Keypoints of the vehicles `poor`, with those that `without_hidden` left out.
        fits: Fits of all vehicles; those of `poor` are replaced by clearly better ones.
        poor: Rows of the vehicles to fit.
        shapes: The body types.
        ground: The road; None: unknown.
        exchanged: Flag from `EXCHANGE_FLAGS` by vehicle; updated in place.

    Returns:
        `seen` with the labels that fit clearly better.
    """
    for name, order in zip(EXCHANGE_FLAGS, EXCHANGED_ORDERS, strict=True):
        some = whole.relabelled(order)
        relabelled_fits = best_types(some, shapes, ground)
        left_out = whole.count - seen.count[poor]
        wins = (
            relabelled_fits.cost[:, 0]
            < fits.cost[poor, 0] + POSE_SEARCH.hidden_cost * left_out - POSE_SEARCH.exchange_gap
        )
        fits.replace_where(poor, relabelled_fits, wins)
        seen = seen.with_rows(poor[wins], some.take(np.flatnonzero(wins)))
        exchanged |= dict.fromkeys(poor[wins].tolist(), name)
    return seen
