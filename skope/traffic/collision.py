"""Time to collision, and the deceleration that avoids one.

TTC as SSAM has it: both drive on along the ways that they take later, at the speeds that they have now, until their
boxes meet. DRAC is the least deceleration by which whoever is behind avoids that: on one way its speed over that of the
one ahead, divided by twice the TTC (Cooper and Ferguson, 1976); where ways cross, what lets the later one arrive when
the other one has gone.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.traffic.footprints import FootprintPath, corners, meeting
from skope.types import Array

REAR_END_DEG: Final = 30.0
"""Two that head in directions which differ by less drive one behind the other (SSAM)."""
_LEG_S: Final = 0.2
"""Ways are taken to be straight for so long."""


@dataclass(frozen=True, eq=False)
class Doubt:
    """Other places and speeds that two road users may have at K moments."""

    shifts: tuple[Array, Array]
    """(K, 2) what to add to the places of each, metres."""
    speeds: tuple[Array, Array]
    """(K,) of each, m/s."""


def times_to_collision(
    one: FootprintPath,
    other: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    horizon_s: float,
    doubt: Doubt | None = None,
) -> Array:
    """(K,) seconds to the collision from each of K moments; infinite where there is none within the horizon.

    Args:
        one: A road user.
        other: Another one.
        rows: (K,) of the moments of each, which are the same in time.
        horizon_s: No collision later than this is looked for.
        doubt: Where they are and how fast instead of what was measured; None: as measured.
    """
    legs = np.arange(int(np.ceil(horizon_s / _LEG_S)) + 1) * _LEG_S
    ways = []
    for k, path in enumerate((one, other)):
        speed = path.speed[rows[k]] if doubt is None else doubt.speeds[k]
        index = np.broadcast_to(rows[k][:, None], (len(rows[k]), len(legs)))
        place, facing = path.ahead(index, speed[:, None] * legs)
        place = place if doubt is None else place + doubt.shifts[k][:, None]
        boxes = corners(place[:, :-1], facing[:, :-1], path.size)
        ways.append((boxes, np.diff(place, axis=1) / _LEG_S))
    begin, end = meeting(*ways[0], *ways[1])
    met = (begin <= end) & (end >= 0) & (begin <= _LEG_S)
    seconds = np.where(met, legs[:-1] + np.maximum(begin, 0), np.inf).min(axis=1)
    return np.asarray(np.where(seconds <= horizon_s, seconds, np.inf))


def angle_deg(one: Array, other: Array) -> Array:
    """(...,) degrees between unit vectors (..., 2)."""
    return np.asarray(np.degrees(np.arccos(np.clip(np.einsum("...i,...i->...", one, other), -1, 1))))


def deceleration_to_avoid(
    one: FootprintPath,
    other: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    seconds: Array,
    doubt: Doubt | None = None,
) -> Array:
    """(K,) m/s^2 that avoid the collisions which are `seconds` (K,) ahead; 0 where there is none.

    `rows` and `doubt` are those of `times_to_collision`.
    """
    paths = one, other
    speeds = doubt.speeds if doubt else (one.speed[rows[0]], other.speed[rows[1]])
    shifts = doubt.shifts if doubt else (np.zeros((len(rows[0]), 2)), np.zeros((len(rows[1]), 2)))
    now = [
        _Now(path.place[row] + shift, path.facing[row], speed, path.size)
        for path, row, shift, speed in zip(paths, rows, shifts, speeds, strict=True)
    ]
    along = angle_deg(now[0].facing, now[1].facing) < REAR_END_DEG
    behind = np.abs(speeds[0] - speeds[1]) / (2 * np.maximum(seconds, 0.05))
    return np.asarray(np.where(np.isfinite(seconds), np.where(along, behind, _across(*now)), 0.0))


@dataclass(frozen=True, eq=False)
class _Now:
    """A road user at K moments: places and unit vectors (K, 2) where it faces, speeds (K,), length and width."""

    place: Array
    facing: Array
    speed: Array
    size: tuple[float, float]


def _across(one: _Now, other: _Now) -> Array:
    """(K,) the same where ways cross, both straight on from now."""
    reach = _strip_times(one, other), _strip_times(other, one)
    out = np.zeros(len(one.speed))
    for second, first, speed in ((0, 1, one.speed), (1, 0, other.speed)):
        enter, gone = reach[second][0], reach[first][1]
        later = (enter >= reach[first][0]) & (enter < gone) & np.isfinite(gone) & (enter > 0)
        away = speed * np.where(later, enter, 0.0)
        safe = np.where(later, gone, 1.0)
        passing = 2 * (speed - away / safe) / safe
        # Braking as hard as that it may stop before: then stopping there is enough.
        stopping = speed**2 / (2 * np.maximum(away, 0.05))
        needed = np.where(speed - passing * safe < 0, stopping, passing)
        out = np.maximum(out, np.where(later, needed, 0.0))
    return out


def _strip_times(one: _Now, other: _Now) -> tuple[Array, Array]:
    """(K,) seconds until `one` enters the strip of road that `other` drives along, and until it has left it."""
    across = np.roll(other.facing, 1, axis=1) * [-1, 1]
    shape = corners(one.place, one.facing, one.size) - other.place[:, None]
    offsets = np.einsum("kci,ki->kc", shape, across)
    rate = one.speed * np.einsum("ki,ki->k", one.facing, across)
    half = other.size[1] / 2
    still = np.abs(rate) < 1e-6
    safe = np.where(still, 1.0, rate)
    low, high = offsets.min(axis=1), offsets.max(axis=1)
    enter = np.where(rate > 0, -half - high, half - low) / safe
    leave = np.where(rate > 0, half - low, -half - high) / safe
    return np.where(still, np.inf, enter), np.where(still, np.inf, leave)
