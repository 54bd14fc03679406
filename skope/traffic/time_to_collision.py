"""Time to collision, the deceleration that avoids one, and hard braking."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.confidence_level import at_most
from skope.schema import PEDESTRIAN_CATEGORY
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track, has_plausible_speed, is_in_traffic
from skope.traffic.footprints import FootprintPath, footprint_corners, meeting
from skope.types import Array


@dataclass(frozen=True)
class CollisionLimits:
    """Limits of times to collision and of braking."""

    braking_s: float = 1.0
    """Duration over which a deceleration is measured, seconds. Shorter ones are mostly position errors."""
    least_probability: float = 0.5
    """Probability below which braking is not listed."""
    rear_end_deg: float = 30.0
    """Two road users whose headings differ by less follow each other, degrees (SSAM)."""
    straight_s: float = 0.2
    """Duration for which paths are taken as straight, seconds."""
    passed_s: float = 6.0
    """Time within which the first road user has left the crossing of two paths, seconds."""
    block_rows: int = 50
    """Number of moments that are computed together. It bounds memory."""


COLLISION_LIMITS: Final = CollisionLimits()


@dataclass(frozen=True, kw_only=True, eq=False)
class HardBraking:
    """A road user brakes harder than the limit."""

    trajectory: Track
    time_s: float
    """Time at which it brakes hardest, seconds."""
    place: Array
    """(2,) metres."""
    deceleration: float
    """m/s^2 over a second, positive."""
    sigma: float
    """Standard deviation of that, m/s^2, from those of the speeds."""
    probability: float
    """Probability that it was harder than the limit."""


def hard_brakings(trajectories: Sequence[Track], settings: TrafficSettings) -> list[HardBraking]:
    """The hardest braking of each vehicle that brakes harder than `settings.hard_braking_ms2`, in order of time.

    Tracks with the flag `implausible_speed` are left out.
    """
    found = []
    for trajectory in trajectories:
        if is_in_traffic(trajectory) and has_plausible_speed(trajectory) and trajectory.category != PEDESTRIAN_CATEGORY:
            hardest = _hardest(trajectory, settings.hard_braking_ms2)
            if hardest is not None and hardest.probability > COLLISION_LIMITS.least_probability:
                found.append(hardest)
    return sorted(found, key=lambda one: one.time_s)


def _hardest(trajectory: Track, limit: float) -> HardBraking | None:
    times = trajectory.times_s
    begins = times[times + COLLISION_LIMITS.braking_s <= times[-1]]
    if not len(begins):
        return None
    drop = trajectory.at(trajectory.speed, begins) - trajectory.at(
        trajectory.speed, begins + COLLISION_LIMITS.braking_s
    )
    k = int(drop.argmax())
    # A gap in the track is bridged by a straight line, which brakes evenly: there it is seen nowhere.
    if not trajectory.located[(times >= begins[k]) & (times <= begins[k] + COLLISION_LIMITS.braking_s)].any():
        return None
    ends = np.array([begins[k], begins[k] + COLLISION_LIMITS.braking_s])
    sigma = math.hypot(*trajectory.at(trajectory.speed_sigma, ends)) / COLLISION_LIMITS.braking_s
    hardest = float(drop[k]) / COLLISION_LIMITS.braking_s
    middle = float(begins[k]) + COLLISION_LIMITS.braking_s / 2
    return HardBraking(
        trajectory=trajectory,
        time_s=middle,
        place=trajectory.at(trajectory.xy, middle),
        deceleration=hardest,
        sigma=sigma,
        probability=at_most((hardest - limit) / sigma) if sigma > 0 else float(hardest > limit),
    )


@dataclass(frozen=True, eq=False)
class SampledStates:
    """Other places and speeds that two road users may have at K moments."""

    shifts: tuple[Array, Array]
    """(K, 2) what to add to the places of each, metres."""
    speeds: tuple[Array, Array]
    """(K,) of each, m/s."""

    def only(self, some: NDArray[np.intp]) -> "SampledStates":
        """Some of the moments, by their indices."""
        return SampledStates(
            (self.shifts[0][some], self.shifts[1][some]),
            (self.speeds[0][some], self.speeds[1][some]),
        )


def times_to_collision(
    one: FootprintPath,
    other: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    horizon_s: float,
    doubt: SampledStates | None = None,
) -> Array:
    """(K,) seconds to the collision from each of K moments; infinite where there is none within the horizon.

    Args:
        one: A road user.
        other: Another one.
        rows: (K,) of the moments of each, which are the same in time.
        horizon_s: No collision later than this is looked for.
        doubt: Where they are and how fast instead of what was measured; None: as measured.
    """
    legs, ways = _ways((one, other), rows, horizon_s, doubt)
    begin, end = meeting(*ways[0], *ways[1])
    met = (begin <= end) & (end >= 0) & (begin <= COLLISION_LIMITS.straight_s)
    seconds = np.where(met, legs + np.maximum(begin, 0), np.inf).min(axis=1)
    return np.asarray(np.where(seconds <= horizon_s, seconds, np.inf))


def _ways(
    paths: tuple[FootprintPath, FootprintPath],
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    horizon_s: float,
    doubt: SampledStates | None,
) -> tuple[Array, list[tuple[Array, Array]]]:
    """The ways ahead of two: when their L legs begin (L,), and corners (K, L, 4, 2), velocities (K, L, 2)."""
    legs = np.asarray(
        np.arange(int(np.ceil(horizon_s / COLLISION_LIMITS.straight_s)) + 1) * COLLISION_LIMITS.straight_s,
        dtype=np.float64,
    )
    ways = []
    for k, path in enumerate(paths):
        speed = path.speed[rows[k]] if doubt is None else doubt.speeds[k]
        index = np.broadcast_to(rows[k][:, None], (len(rows[k]), len(legs)))
        place, facing = path.ahead(index, speed[:, None] * legs)
        place = place if doubt is None else place + doubt.shifts[k][:, None]
        boxes = footprint_corners(place[:, :-1], facing[:, :-1], path.size)
        ways.append((boxes, np.diff(place, axis=1) / COLLISION_LIMITS.straight_s))
    return legs[:-1], ways


def angle_deg(one: Array, other: Array) -> Array:
    """(...,) degrees between unit vectors (..., 2)."""
    return np.asarray(np.degrees(np.arccos(np.clip(np.einsum("...i,...i->...", one, other), -1, 1))))


def deceleration_to_avoid(
    one: FootprintPath,
    other: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    seconds: Array,
    doubt: SampledStates | None = None,
) -> Array:
    """Decelerations that avoid collisions.

    Args:
        one: A road user.
        other: Another one.
        rows: (K,) of the moments of each, which are the same in time.
        seconds: (K,) until the collision; infinite where there is none.
        doubt: Places and speeds instead of those that were measured; None: as measured.

    Returns:
        (K,) m/s², as the module has it; 0 where no collision is ahead.
    """
    speeds = doubt.speeds if doubt else (one.speed[rows[0]], other.speed[rows[1]])
    ahead = np.isfinite(seconds)
    along = angle_deg(one.facing[rows[0]], other.facing[rows[1]]) < COLLISION_LIMITS.rear_end_deg
    out = np.where(ahead & along, np.abs(speeds[0] - speeds[1]) / (2 * np.maximum(seconds, 0.05)), 0.0)
    crossing = np.flatnonzero(ahead & ~along)
    for part in np.split(crossing, range(COLLISION_LIMITS.block_rows, len(crossing), COLLISION_LIMITS.block_rows)):
        chosen = None if doubt is None else doubt.only(part)
        out[part] = _across(one, other, (rows[0][part], rows[1][part]), (speeds[0][part], speeds[1][part]), chosen)
    return np.asarray(out)


def _across(
    one: FootprintPath,
    other: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    speeds: tuple[Array, Array],
    doubt: SampledStates | None,
) -> Array:
    """(K,) m/s^2 by which the one that gets later to where both drive lets the other one leave before."""
    legs, ways = _ways((one, other), rows, COLLISION_LIMITS.passed_s, doubt)
    stays = _stay(legs, ways[0], ways[1][0]), _stay(legs, ways[1], ways[0][0])
    out = np.zeros(len(rows[0]))
    for second, first in ((0, 1), (1, 0)):
        speed, enter, gone = speeds[second], stays[second][0], stays[first][1]
        later = (enter >= stays[first][0]) & (enter < gone) & np.isfinite(gone) & (enter > 0)
        away = speed * np.where(later, enter, 0.0)
        safe = np.where(later, gone, 1.0)
        passing = 2 * (speed - away / safe) / safe
        # Braking as hard as that it may stop before: then stopping there is enough.
        stopping = speed**2 / (2 * np.maximum(away, 0.05))
        needed = np.where(speed - passing * safe < 0, stopping, passing)
        out = np.maximum(out, np.where(later, needed, 0.0))
    return out


def _stay(legs: Array, way: tuple[Array, Array], places: Array) -> tuple[Array, Array]:
    """(K,) seconds until somebody on a way first touches places (K, L, 4, 2), and until it last does; else infinite."""
    shape = (*way[0].shape[:2], places.shape[1])
    moving = np.broadcast_to(way[0][:, :, None], (*shape, 4, 2))
    velocity = np.broadcast_to(way[1][:, :, None], (*shape, 2))
    begin, end = meeting(moving, velocity, np.broadcast_to(places[:, None], (*shape, 4, 2)), np.zeros((*shape, 2)))
    met = (begin <= end) & (end >= 0) & (begin <= COLLISION_LIMITS.straight_s)
    since = legs[:, None]
    enter = np.where(met, since + np.maximum(begin, 0), np.inf).min(axis=(1, 2))
    leave = np.where(met, since + np.minimum(end, COLLISION_LIMITS.straight_s), -np.inf).max(axis=(1, 2))
    return enter, np.where(np.isfinite(enter), leave, np.inf)
