"""Estimate the uncertainty of a conflict from random samples of the positions and speeds of both road users."""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.confidence_level import INTERVAL_LEVEL, INTERVAL_SIGMAS
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import VEHICLE_LENGTH_SIGMA_M, Track
from skope.traffic.event_probability import event_probability
from skope.traffic.footprints import FootprintPath
from skope.traffic.post_encroachment_time import Encroachment, by_places
from skope.traffic.time_to_collision import SampledStates, deceleration_to_avoid, times_to_collision
from skope.types import Array


@dataclass(frozen=True)
class ConflictUncertainty:
    """Minimum quality of tracks in conflicts, and number of samples for the uncertainty of conflicts."""

    step_s: float = 0.1
    """Time step at which pairs are examined, seconds, as in SSAM."""
    horizon_s: float = 3.0
    """Minimum look-ahead for collisions when computing decelerations, seconds. A larger `ttc_s` replaces it."""
    samples: int = 200
    """Number of samples of positions and speeds for the uncertainty of a time to collision."""
    braking_samples: int = 60
    """Number of samples for the uncertainty of a deceleration, which takes longer to compute."""
    fewest_positions: int = 10
    """Smallest number of positions of a road user in a conflict."""
    shortest_s: float = 2.0
    """Shortest track of a road user in a conflict, seconds."""
    around_s: float = 1.0
    """Time before and after a conflict in which gaps are searched for, seconds."""
    longest_gap_s: float = 0.6
    """Longest gap between positions within `around_s` of a conflict, seconds. On key frames, a detector gives two
    positions per second."""
    worst_sigma_m: float = 0.5
    """Largest standard deviation of the position at the conflict, metres."""


CONFLICT_UNCERTAINTY: Final = ConflictUncertainty()


def is_followed(trajectory: Track, time_s: float) -> bool:
    """Return whether a road user is tracked well enough around a time for a conflict to be credible.

    Nearly all conflicts of track fragments and of short false detections are false.
    """
    times = trajectory.times_s[trajectory.located]
    if len(times) < CONFLICT_UNCERTAINTY.fewest_positions or times[-1] - times[0] < CONFLICT_UNCERTAINTY.shortest_s:
        return False
    margin_s = CONFLICT_UNCERTAINTY.around_s - CONFLICT_UNCERTAINTY.longest_gap_s
    if not times[0] <= time_s - margin_s <= time_s + margin_s <= times[-1]:
        return False
    gap_s = trajectory.longest_gap(time_s, CONFLICT_UNCERTAINTY.around_s)
    return (
        gap_s <= CONFLICT_UNCERTAINTY.longest_gap_s
        and trajectory.sigma_at(time_s) <= CONFLICT_UNCERTAINTY.worst_sigma_m
    )


def ttc_interval(
    first: FootprintPath,
    second: FootprintPath,
    row: tuple[int, int],
    settings: TrafficSettings,
    rng: np.random.Generator,
) -> tuple[float, float, float]:
    """Return the confidence interval of a time to collision, and the probability that the time is within the limit.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        row: Rows of both paths at the conflict.
        settings: `ttc_s` is the limit.
        rng: Random generator for positions and speeds.

    Returns:
        Low and high end of the 90% confidence interval, seconds (infinite: there may be no collision), and the
        probability that the time is within the limit and both are road users.
    """
    index, states = _drawn(first, second, row, rng)
    drawn = times_to_collision(first, second, index, _farthest_s(settings), states)
    real_probability = event_probability(first.trajectory) * event_probability(second.trajectory)
    return *_middle(drawn), real_probability * float((drawn <= settings.ttc_s).mean())


def hardest_needed(
    first: FootprintPath,
    second: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    seconds: Array,
    settings: TrafficSettings,
    rng: np.random.Generator,
    common_scale_sigma: float = 0.0,
) -> tuple[float, float, float]:
    """Return the largest deceleration that avoids a collision.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        rows: (K,) rows of each path.
        seconds: (K,) times to collision at these rows, seconds.
        settings: `ttc_s` sets how far ahead collisions are searched for.
        rng: Random generator for positions and speeds.
        common_scale_sigma: Relative standard deviation of the scale, which all distances and speeds share.

    Returns:
        The deceleration, m/s², and the low and high end of its 90% confidence interval; all NaN without a collision.
    """
    drac = deceleration_to_avoid(first, second, rows, seconds)
    if not len(drac) or drac.max() <= 0:
        return (math.nan,) * 3
    k = int(drac.argmax())
    index, states = _drawn(first, second, (int(rows[0][k]), int(rows[1][k])), rng, CONFLICT_UNCERTAINTY.braking_samples)
    ahead = times_to_collision(first, second, index, _farthest_s(settings), states)
    # Both share the camera's error: it scales distances and speeds by the same factor, so times do not change.
    scale = (
        np.maximum(0.0, 1 + common_scale_sigma * rng.standard_normal(CONFLICT_UNCERTAINTY.braking_samples))
        if common_scale_sigma
        else 1.0
    )
    return float(drac[k]), *_middle(scale * deceleration_to_avoid(first, second, index, ahead, states))


def surely_encroaches(first: FootprintPath, second: FootprintPath, i: int, j: int, most_s: float) -> bool:
    """Return whether there is an encroachment even if both road users are smaller than measured.

    Length and width of each road user are reduced by the width of the 90% confidence interval of its position.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        i: Row of `first` at the encounter.
        j: Row of `second` at the encounter.
        most_s: Longest post-encroachment time, seconds. One second is added for the search.
    """
    shrunk = []
    for path, row in ((first, i), (second, j)):
        spread = path.trajectory.at(path.trajectory.total_covariance, float(path.times_s[row]))
        sides = path.facing[row], np.array([-path.facing[row, 1], path.facing[row, 0]])
        size = [
            max(0.1, extent - 2 * INTERVAL_SIGMAS * math.sqrt(max(0.0, float(side @ spread @ side))))
            for extent, side in zip(path.size, sides, strict=True)
        ]
        shrunk.append(
            FootprintPath(replace(path.trajectory, length=size[0], width=size[1]), CONFLICT_UNCERTAINTY.step_s)
        )
    return by_places(shrunk[0], shrunk[1], most_s + 1.0) is not None


def pet_sigma(first: FootprintPath, second: FootprintPath, reached: Encroachment | None) -> float:
    """Return the standard deviation of a post-encroachment time, from errors of positions and lengths.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        reached: The encroachment; None if there is none.

    Returns:
        The standard deviation, seconds; NaN without an encroachment.
    """
    if reached is None:
        return math.nan
    total = 0.0
    for path, time_s in zip((first, second), in_order((reached.first_s, reached.second_s), reached), strict=True):
        trajectory = path.trajectory
        speed = max(0.1, float(trajectory.at(trajectory.speed, time_s)))
        total += (trajectory.sigma_at(time_s) ** 2 + (VEHICLE_LENGTH_SIGMA_M / 2) ** 2) / speed**2
    return math.sqrt(total)


def in_order(times: tuple[float, float], reached: Encroachment) -> tuple[float, float]:
    """Reorder two times from order of arrival to the order of the search's arguments: first, second."""
    return times[::-1] if reached.swapped else times


def _farthest_s(settings: TrafficSettings) -> float:
    """Return the look-ahead for collisions of random samples, seconds: four times that of the measured states."""
    return 4 * max(settings.ttc_s, CONFLICT_UNCERTAINTY.horizon_s)


def _drawn(
    first: FootprintPath,
    second: FootprintPath,
    rows: tuple[int, int],
    rng: np.random.Generator,
    count: int = CONFLICT_UNCERTAINTY.samples,
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], SampledStates]:
    """Return one pair of rows, repeated `count` times, with randomly sampled positions and speeds."""
    shifts, speeds = [], []
    for path, row in zip((first, second), rows, strict=True):
        time_s, trajectory = float(path.times_s[row]), path.trajectory
        shifts.append(rng.multivariate_normal(np.zeros(2), trajectory.at(trajectory.total_covariance, time_s), count))
        sigma = float(trajectory.at(trajectory.speed_sigma, time_s))
        speeds.append(np.maximum(0.0, path.speed[row] + rng.normal(0, sigma, count)))
    index = np.full(count, rows[0]), np.full(count, rows[1])
    return index, SampledStates((shifts[0], shifts[1]), (speeds[0], speeds[1]))


def _middle(drawn: Array) -> tuple[float, float]:
    """Return the central interval of the samples at `INTERVAL_LEVEL` (90%); infinite values sort last."""
    tail = round(len(drawn) * (1 - INTERVAL_LEVEL) / 2)
    ordered = np.sort(drawn)
    return float(ordered[tail]), float(ordered[-1 - tail])
