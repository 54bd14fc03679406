"""Time to collision, and the deceleration that avoids one.

TTC as SSAM has it: both drive on along the ways that they take later, at the speeds that they have now, until their
boxes meet. DRAC is the least deceleration by which whoever is behind avoids that: on one way its speed over that of the
one ahead, divided by twice the TTC (Cooper and Ferguson, 1976); where ways cross, what lets the later one arrive when
the other one has gone.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.traffic.footprints import FootprintPath, corners, meeting
from skope.types import Array

REAR_END_DEG: Final = 30.0
"""Two that head in directions which differ by less drive one behind the other (SSAM)."""
_LEG_S: Final = 0.2
"""Ways are taken to be straight for so long."""


def times_to_collision(
    one: FootprintPath,
    other: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    horizon_s: float,
    shifts: tuple[Array, Array] | None = None,
    speeds: tuple[Array, Array] | None = None,
) -> Array:
    """(K,) seconds to the collision from each of K moments; infinite where there is none within the horizon.

    Args:
        one: A road user.
        other: Another one.
        rows: (K,) of the moments of each, which are the same in time.
        horizon_s: No collision later than this is looked for.
        shifts: (K, 2) what to add to the places of each, metres; None: nothing.
        speeds: (K,) of each, m/s; None: those that they have.
    """
    legs = np.arange(int(np.ceil(horizon_s / _LEG_S)) + 1) * _LEG_S
    ways = []
    for k, path in enumerate((one, other)):
        speed = path.speed[rows[k]] if speeds is None else speeds[k]
        index = np.broadcast_to(rows[k][:, None], (len(rows[k]), len(legs)))
        place, facing = path.ahead(index, speed[:, None] * legs)
        place = place if shifts is None else place + shifts[k][:, None]
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
) -> Array:
    """(K,) m/s^2 that avoid the collisions which are `seconds` (K,) ahead; 0 where there is none."""
    a, b = one.speed[rows[0]], other.speed[rows[1]]
    along = angle_deg(one.facing[rows[0]], other.facing[rows[1]]) < REAR_END_DEG
    behind = np.abs(a - b) / (2 * np.maximum(seconds, 0.05))
    across = _across(one, other, rows)
    return np.asarray(np.where(np.isfinite(seconds), np.where(along, behind, across), 0.0))


def _across(one: FootprintPath, other: FootprintPath, rows: tuple[NDArray[np.intp], NDArray[np.intp]]) -> Array:
    """(K,) the same where ways cross, both straight on from now."""
    reach = [_strip_times(one, other, rows[0], rows[1]), _strip_times(other, one, rows[1], rows[0])]
    speeds = one.speed[rows[0]], other.speed[rows[1]]
    out = np.zeros(len(rows[0]))
    for second, first in ((0, 1), (1, 0)):
        enter, speed = reach[second][0], speeds[second]
        gone = reach[first][1]
        later = (enter >= reach[first][0]) & (enter < gone) & np.isfinite(gone) & (enter > 0)
        away = speed * np.where(later, enter, 0.0)
        safe = np.where(later, gone, 1.0)
        passing = 2 * (speed - away / safe) / safe
        # Braking as hard as that it may stop before: then stopping there is enough.
        stopping = speed**2 / (2 * np.maximum(away, 0.05))
        needed = np.where(speed - passing * safe < 0, stopping, passing)
        out = np.maximum(out, np.where(later, needed, 0.0))
    return out


def _strip_times(
    one: FootprintPath, other: FootprintPath, rows: NDArray[np.intp], other_rows: NDArray[np.intp]
) -> tuple[Array, Array]:
    """(K,) seconds until `one` enters the strip of road that `other` drives along, and until it has left it."""
    across = np.roll(other.facing[other_rows], 1, axis=1) * [-1, 1]
    offsets = np.einsum("kci,ki->kc", one.corners[rows] - other.place[other_rows][:, None], across)
    rate = one.speed[rows] * np.einsum("ki,ki->k", one.facing[rows], across)
    half = other.size[1] / 2
    still = np.abs(rate) < 1e-6
    safe = np.where(still, 1.0, rate)
    low, high = offsets.min(axis=1), offsets.max(axis=1)
    enter = np.where(rate > 0, -half - high, half - low) / safe
    leave = np.where(rate > 0, half - low, -half - high) / safe
    return np.where(still, np.inf, enter), np.where(still, np.inf, leave)
