"""Meetings of two road users near a collision, or of one that gets where the other was: what conflicts are made of."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.site.traffic_settings import TrafficSettings
from skope.traffic.collision import REAR_END_DEG, angle_deg, times_to_collision
from skope.traffic.conflict_doubt import HORIZON_S, in_order, surely_encroaches
from skope.traffic.encroachment import Encroachment, by_places
from skope.traffic.footprints import FootprintPath
from skope.types import Array

_DRIVES: Final = 1.0
"""One of two in a conflict is as fast as this, m/s."""
_ROWS: Final = 400
"""Moments that are looked at together, which bounds the memory."""


@dataclass(frozen=True, kw_only=True)
class Meeting:
    """Two who come near to a collision, or get where the other one was."""

    one: FootprintPath
    other: FootprintPath
    rows: tuple[NDArray[np.intp], NDArray[np.intp]]
    """Of the moments at which they are near."""
    seconds: Array
    """Times to their collision then."""
    moment: tuple[int, int]
    """The rows of the moment of the conflict."""
    ttc_s: float
    """The least of the times; NaN where it is above the limit."""
    reached: Encroachment | None
    ways_deg: float
    """Between their ways."""

    @property
    def close(self) -> bool:
        """Whether a collision is ahead within the limit."""
        return not math.isnan(self.ttc_s)

    def in_order(self) -> tuple[tuple[FootprintPath, float], tuple[FootprintPath, float]]:
        """The first and the second of the two, and when they meet."""
        one, other = self.one, self.other
        swapped = self.reached.swapped if self.reached is not None else _behind(one, other, *self.moment)
        first, second = (other, one) if swapped else (one, other)
        if self.close or self.reached is None:
            time_s = float(one.times_s[self.moment[0]])
            return (first, time_s), (second, time_s)
        return (first, self.reached.first_s), (second, self.reached.second_s)


def meeting_of(one: FootprintPath, other: FootprintPath, settings: TrafficSettings) -> Meeting | None:
    """Find where two come near a collision, or get where the other one was.

    Args:
        one: A road user.
        other: Another one.
        settings: `ttc_s` and `pet_s` are the limits.

    Returns:
        The meeting; None where there is none, where one only follows the other, or where it is doubtful that places
        cross.
    """
    rows, seconds = _approaches(one, other, settings)
    least = int(seconds.argmin()) if len(seconds) else 0
    close = bool(len(seconds) and seconds[least] <= settings.ttc_s)
    reached = by_places(one, other, settings.pet_s)
    if reached is not None and reached.seconds == 0:
        reached = None  # they touch: places are not that exact
    if close:
        i, j = int(rows[0][least]), int(rows[1][least])
    elif reached is not None:
        times = (reached.first_s, reached.second_s)
        i, j = (_row(path, time_s) for path, time_s in zip((one, other), in_order(times, reached), strict=True))
    else:
        return None
    # Two that turn one behind the other head elsewhere at any moment, but not at any place.
    ways_deg = _angle_of_ways(one, other, i, j)
    if not close and ways_deg < REAR_END_DEG:
        return None  # one behind the other: that is a gap
    if not close and not surely_encroaches(one, other, i, j, settings.pet_s):
        return None
    return Meeting(
        one=one,
        other=other,
        rows=rows,
        seconds=seconds,
        moment=(i, j),
        ttc_s=float(seconds[least]) if close else math.nan,
        reached=reached,
        ways_deg=ways_deg,
    )


def rows_together(one: FootprintPath, other: FootprintPath) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The rows of the moments at which both are there, of each."""
    begin, end = max(one.ticks[0], other.ticks[0]), min(one.ticks[-1], other.ticks[-1]) + 1
    ticks = np.arange(begin, max(begin, end))
    return ticks - one.ticks[0], ticks - other.ticks[0]


def _approaches(
    one: FootprintPath, other: FootprintPath, settings: TrafficSettings
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], Array]:
    """The rows of moments at which the two are near, and the times to their collision."""
    a, b = rows_together(one, other)
    horizon = max(settings.ttc_s, HORIZON_S)
    speeds = one.speed[a] + other.speed[b]
    reach = one.radius + other.radius + speeds * horizon
    close = (np.linalg.norm(one.place[a] - other.place[b], axis=1) < reach) & (
        np.maximum(one.speed[a], other.speed[b]) >= _DRIVES
    )
    rows = a[close], b[close]
    parts = [(rows[0][k : k + _ROWS], rows[1][k : k + _ROWS]) for k in range(0, len(rows[0]), _ROWS)]
    seconds = [times_to_collision(one, other, part, horizon) for part in parts]
    return rows, np.concatenate([np.zeros(0), *seconds])


def _angle_of_ways(one: FootprintPath, other: FootprintPath, i: int, j: int) -> float:
    """Degrees between the ways of two, where the way of one is nearest to where the other one is."""
    here = int(np.linalg.norm(one.place - other.place[j], axis=1).argmin())
    there = int(np.linalg.norm(other.place - one.place[i], axis=1).argmin())
    return float(min(angle_deg(one.facing[here], other.facing[j]), angle_deg(one.facing[i], other.facing[there])))


def _row(path: FootprintPath, time_s: float) -> int:
    return int(np.abs(path.times_s - time_s).argmin())


def _behind(one: FootprintPath, other: FootprintPath, i: int, j: int) -> bool:
    """Whether `one` sees `other` ahead."""
    return bool((other.place[j] - one.place[i]) @ one.facing[i] > 0)
