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
from skope.traffic.footprints import FootprintPath, Footprints, meeting_within
from skope.types import Array


@dataclass(frozen=True)
class CollisionLimits:
    """Limits of times to collision and of braking."""

    braking_s: float = 1.0
    """Duration over which a deceleration is measured, seconds. Over shorter durations position errors dominate."""
    least_probability: float = 0.5
    """Probability below which braking is not listed."""
    rear_end_deg: float = 30.0
    """Maximum difference of headings for two road users to follow each other, degrees (SSAM)."""
    straight_s: float = 0.2
    """Duration for which paths are taken as straight, seconds."""
    passed_s: float = 6.0
    """Time within which the first road user has left the crossing of two paths, seconds."""
    block_rows: int = 50
    """Number of moments that are computed together. It bounds memory."""


COLLISION_LIMITS: Final = CollisionLimits()


@dataclass(frozen=True, kw_only=True, eq=False)
class HardBraking:
    """Braking of a road user above the limit."""

    trajectory: Track
    time_s: float
    """Time of the hardest braking, seconds."""
    position: Array
    """(2,) position at `time_s`, metres."""
    deceleration: float
    """Mean deceleration over one second, m/s^2, positive."""
    sigma: float
    """Standard deviation of `deceleration`, from the errors of the speeds, m/s^2."""
    probability: float
    """Probability that the deceleration was above the limit."""


def hard_brakings(trajectories: Sequence[Track], settings: TrafficSettings) -> list[HardBraking]:
    """Return the hardest braking of each road user that brakes harder than `settings.hard_braking_ms2`, by time.

    Pedestrians and tracks with the flag `implausible_speed` are excluded.
    """
    found = []
    for trajectory in trajectories:
        if is_in_traffic(trajectory) and has_plausible_speed(trajectory) and trajectory.category != PEDESTRIAN_CATEGORY:
            hardest = _hardest(trajectory, settings.hard_braking_ms2)
            if hardest is not None and hardest.probability > COLLISION_LIMITS.least_probability:
                found.append(hardest)
    return sorted(found, key=lambda braking: braking.time_s)


def _hardest(trajectory: Track, limit: float) -> HardBraking | None:
    times = trajectory.times_s
    begins = times[times + COLLISION_LIMITS.braking_s <= times[-1]]
    if not len(begins):
        return None
    drop = trajectory.at(trajectory.speed, begins) - trajectory.at(
        trajectory.speed, begins + COLLISION_LIMITS.braking_s
    )
    k = int(drop.argmax())
    # A gap in the track is interpolated linearly, so braking inside it was not observed.
    if not trajectory.located[(times >= begins[k]) & (times <= begins[k] + COLLISION_LIMITS.braking_s)].any():
        return None
    ends = np.array([begins[k], begins[k] + COLLISION_LIMITS.braking_s])
    sigma = math.hypot(*trajectory.at(trajectory.speed_sigma, ends)) / COLLISION_LIMITS.braking_s
    hardest = float(drop[k]) / COLLISION_LIMITS.braking_s
    middle = float(begins[k]) + COLLISION_LIMITS.braking_s / 2
    return HardBraking(
        trajectory=trajectory,
        time_s=middle,
        position=trajectory.at(trajectory.xy, middle),
        deceleration=hardest,
        sigma=sigma,
        probability=at_most((hardest - limit) / sigma) if sigma > 0 else float(hardest > limit),
    )


@dataclass(frozen=True, eq=False)
class SampledStates:
    """Sampled positions and speeds of two road users at K times."""

    shifts: tuple[Array, Array]
    """(K, 2) offsets from the measured positions of each road user, metres."""
    speeds: tuple[Array, Array]
    """(K,) speeds of each road user, m/s."""

    def only(self, some: NDArray[np.intp]) -> "SampledStates":
        """Return the samples with the given indices."""
        return SampledStates(
            (self.shifts[0][some], self.shifts[1][some]),
            (self.speeds[0][some], self.speeds[1][some]),
        )


def times_to_collision(
    first: FootprintPath,
    second: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    horizon_s: float,
    samples: SampledStates | None = None,
) -> Array:
    """Return the times to collision at K times.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        rows: (K,) rows of each path, at the same times.
        horizon_s: Longest time to collision that is searched for, seconds.
        samples: Sampled positions and speeds instead of the measured ones; None: as measured.

    Returns:
        (K,) times to collision, seconds; infinite if there is no collision within `horizon_s`.
    """
    starts_s, ((a, a_velocity), (b, b_velocity)) = _ways((first, second), rows, horizon_s, samples)
    begin, _ = meeting_within(a, b, b_velocity - a_velocity, COLLISION_LIMITS.straight_s)
    seconds = (starts_s + begin).min(axis=1)
    return np.asarray(np.where(seconds <= horizon_s, seconds, np.inf))


def _ways(
    paths: tuple[FootprintPath, FootprintPath],
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    horizon_s: float,
    samples: SampledStates | None,
) -> tuple[Array, list[tuple[Footprints, Array]]]:
    """Return the paths ahead of both road users as L straight segments.

    Returns:
        (L,) start times of the segments, and for each road user (K, L) footprints and (K, L, 2) velocities.
    """
    starts_s = np.asarray(
        np.arange(int(np.ceil(horizon_s / COLLISION_LIMITS.straight_s)) + 1) * COLLISION_LIMITS.straight_s,
        dtype=np.float64,
    )
    ways = []
    for k, path in enumerate(paths):
        speed = path.speed[rows[k]] if samples is None else samples.speeds[k]
        index = np.broadcast_to(rows[k][:, None], (len(rows[k]), len(starts_s)))
        position, facing = path.ahead(index, speed[:, None] * starts_s)
        position = position if samples is None else position + samples.shifts[k][:, None]
        velocity = np.diff(position, axis=1) / COLLISION_LIMITS.straight_s
        ways.append((Footprints(position[:, :-1], facing[:, :-1], path.size), velocity))
    return starts_s[:-1], ways


def angle_deg(first: Array, second: Array) -> Array:
    """Return (...,) angles between unit vectors (..., 2), degrees."""
    return np.asarray(np.degrees(np.arccos(np.clip(np.einsum("...i,...i->...", first, second), -1, 1))))


def deceleration_to_avoid(
    first: FootprintPath,
    second: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    seconds: Array,
    samples: SampledStates | None = None,
) -> Array:
    """Return the decelerations that avoid collisions.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        rows: (K,) rows of each path, at the same times.
        seconds: (K,) times to collision, seconds; infinite for none.
        samples: Sampled positions and speeds instead of the measured ones; None: as measured.

    Returns:
        (K,) decelerations, m/s²; 0 if no collision is ahead.
    """
    speeds = samples.speeds if samples else (first.speed[rows[0]], second.speed[rows[1]])
    ahead = np.isfinite(seconds)
    along = angle_deg(first.facing[rows[0]], second.facing[rows[1]]) < COLLISION_LIMITS.rear_end_deg
    out = np.where(ahead & along, np.abs(speeds[0] - speeds[1]) / (2 * np.maximum(seconds, 0.05)), 0.0)
    crossing = np.flatnonzero(ahead & ~along)
    for part in np.split(crossing, range(COLLISION_LIMITS.block_rows, len(crossing), COLLISION_LIMITS.block_rows)):
        chosen = None if samples is None else samples.only(part)
        out[part] = _across(first, second, (rows[0][part], rows[1][part]), (speeds[0][part], speeds[1][part]), chosen)
    return np.asarray(out)


def _across(
    first: FootprintPath,
    second: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    speeds: tuple[Array, Array],
    samples: SampledStates | None,
) -> Array:
    """Return (K,) decelerations, m/s^2, with which the later road user lets the first one leave the common area."""
    starts_s, ways = _ways((first, second), rows, COLLISION_LIMITS.passed_s, samples)
    stays = _stay(starts_s, *ways[0], ways[1][0]), _stay(starts_s, *ways[1], ways[0][0])
    out = np.zeros(len(rows[0]))
    for following, leading in ((0, 1), (1, 0)):
        speed, enter, gone = speeds[following], stays[following][0], stays[leading][1]
        later = (enter >= stays[leading][0]) & (enter < gone) & np.isfinite(gone) & (enter > 0)
        away = speed * np.where(later, enter, 0.0)
        safe = np.where(later, gone, 1.0)
        passing = 2 * (speed - away / safe) / safe
        # If it would stop before the common area with that deceleration, stopping at the area is enough.
        stopping = speed**2 / (2 * np.maximum(away, 0.05))
        needed = np.where(speed - passing * safe < 0, stopping, passing)
        out = np.maximum(out, np.where(later, needed, 0.0))
    return out


def _stay(starts_s: Array, moving: Footprints, velocity: Array, places: Footprints) -> tuple[Array, Array]:
    """Return when a road user first and last touches places where a second road user will be.

    Args:
        starts_s: (L,) start times of the segments.
        moving: (K, L) footprints of the road user.
        velocity: (K, L, 2) its velocities, m/s.
        places: (K, L) footprints of the second road user.

    Returns:
        (K,) first and (K,) last times, seconds; infinite for none.
    """
    begin, end = meeting_within(moving[:, :, None], places[:, None], -velocity[:, :, None], COLLISION_LIMITS.straight_s)
    since = starts_s[:, None]
    enter = (since + begin).min(axis=(1, 2))
    return enter, np.where(np.isfinite(enter), (since + end).max(axis=(1, 2)), np.inf)
