"""Find line crossings from a signed distance over time: one per change of side, without jitter.

The distance is that from a gate's line or from a zone's border. A point exactly on the line belongs to the side that
the track reaches next (a half-open rule in time). A track that arrives at the line has crossed it, and a track that
begins on the line crossed it before.

The new side counts when the track is beyond the hysteresis at two consecutive positions. A flicker of one frame is
therefore no crossing. A box that jumps across the line and back at once makes no crossing either.

The measured position of a stopped road user drifts slowly, sometimes by more than its stated error. A stay on one side
therefore counts only if the road user moved at least `leave` away from the line, or returned that far along it.
Otherwise its two crossings cancel each other, which keeps the net number of crossings.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.types import Array

_SHORTEST_STAY_S: Final = 0.5
"""Shortest stay on one side of a line, seconds. A quicker return would need more deceleration than tyres allow."""


@dataclass(frozen=True, kw_only=True)
class LineCrossing:
    """Change from one side of a line to the other."""

    from_side: int
    """Sign of the side before: 1 or -1."""
    time_s: float
    """Time of the crossing, seconds, interpolated between positions. If the track jitters across the line: the middle
    one of the times of change."""
    spread_s: float
    """Half the time between the first and the last change of side, seconds."""
    begins: bool
    """Whether the side before is in doubt: the track begins too close to the line."""
    ends: bool
    """Whether the side after is in doubt: the track ends too close to the line, or at its first position beyond it."""
    depth: float
    """Distance from the line on the side that is in doubt, in the unit of the distance; infinite if no side is."""


def line_crossings(
    signed: Array,
    times_s: Array,
    *,
    hysteresis: float,
    least_travel: float = 0.0,
    leave: float = 0.0,
    places: Array | None = None,
) -> list[LineCrossing]:
    """Return all crossings in order of time.

    Args:
        signed: (M,) distances, positive on one side and negative on the other.
        times_s: (M,) times, seconds, increasing.
        hysteresis: Distance beyond the line that the track must reach for a crossing to count.
        least_travel: Minimum sum of the largest distances before and after the crossing.
        leave: Minimum distance between a crossing and its return for both to count. It is measured from the line, or
            between the last position before the crossing and the first one after the return.
        places: (M, 2) positions, for the second of these measures. Default: only the distance from the line counts.
    """
    sign = _sides(signed)
    if (sign == sign[0]).all():
        return []
    turns = list(_turns(signed, sign, times_s, hysteresis, leave, places))
    out = []
    for k, (a, b, from_side) in enumerate(turns):
        since = turns[k - 1][1] if k else 0
        until = turns[k + 1][0] if k + 1 < len(turns) else len(signed) - 1
        before = float((from_side * signed[since : b + 1]).max())
        after = float((-from_side * signed[a : until + 1]).max())
        if max(before, 0) + max(after, 0) < least_travel:
            continue
        times = _times_of_change(signed, sign, times_s, a, b)
        begins, ends = before < hysteresis, after < hysteresis or b == len(signed) - 1
        out.append(
            LineCrossing(
                from_side=from_side,
                # A track that ends on the line, jittering, arrives at its first change of side.
                time_s=times[len(times) // 2] if len(times) % 2 else times[0],
                spread_s=(times[-1] - times[0]) / 2,
                begins=begins,
                ends=ends,
                depth=min(before if begins else np.inf, after if ends else np.inf),
            )
        )
    return out


def _sides(signed: Array) -> NDArray[np.int64]:
    """Return the (M,) sides, 1 or -1. A point on the line is on the side opposite to the one before it."""
    sign = np.sign(signed).astype(np.int64)
    nonzero = np.flatnonzero(sign)
    if not len(nonzero):
        return np.ones_like(sign)
    latest = np.searchsorted(nonzero, np.arange(len(sign)), side="right") - 1
    before = np.where(latest >= 0, -sign[nonzero[latest.clip(0)]], sign[nonzero[0]])
    return np.where(sign == 0, before, sign)


def _turns(
    signed: Array, sign: NDArray[np.int64], times_s: Array, hysteresis: float, leave: float, places: Array | None
) -> Iterator[tuple[int, int, int]]:
    """Yield each crossing's last certain row before it, first certain row after it, and sign before it."""
    sure = np.where((np.abs(signed) >= hysteresis) & (signed != 0), sign, 0)
    beside = np.concatenate([[0], sure, [0]])
    alone = (beside[:-2] != sure) & (beside[2:] != sure)
    moments = np.flatnonzero((sure != 0) & ~alone)
    sides = sure[moments]
    last = len(signed) - 1
    if not len(moments):
        moments, sides = np.array([0]), sign[:1]
    elif sides[0] != sign[0]:
        moments, sides = np.concatenate([[0], moments]), np.concatenate([sign[:1], sides])
    moments, sides = _without_jumps(moments, sides, times_s)
    stays = _stays(moments, sides)
    end, side = stays[-1].last, stays[-1].side
    kept = _without_standing(stays, signed, leave, places)
    # The track ends in doubt: reaching the line counts, unless the track has moved back by the hysteresis since. A road
    # user that stops on the line at the end does not cross back over it.
    if (sign[end:] == -side).any() and side * signed[last] < hysteresis:
        returned = _without_standing([*stays, _Stay(-side, last, last)], signed, leave, places)
        kept = returned if stays[-1] in returned else kept
    for before, after in itertools.pairwise(kept):
        if before.side != after.side:
            yield before.last, after.first, before.side


@dataclass(frozen=True)
class _Stay:
    """Stay on one side, from its first to its last certain row."""

    side: int
    first: int
    last: int


def _stays(moments: NDArray[np.intp], sides: NDArray[np.int64]) -> list[_Stay]:
    bounds = [0, *(np.flatnonzero(np.diff(sides)) + 1).tolist(), len(sides)]
    return [_Stay(int(sides[a]), int(moments[a]), int(moments[b - 1])) for a, b in itertools.pairwise(bounds)]


def _without_standing(stays: list[_Stay], signed: Array, leave: float, places: Array | None) -> list[_Stay]:
    """Return the stays without those in which the road user stopped on the line. The first and last stay remain."""
    kept = stays[:1]
    for before, stay, after in zip(stays, stays[1:], stays[2:], strict=False):
        away = float((stay.side * signed[before.last : after.first + 1]).max())
        if places is not None:
            away = max(away, float(np.linalg.norm(places[after.first] - places[before.last])))
        if away >= leave:
            kept.append(stay)
    return [*kept, *stays[1:][-1:]]


def _without_jumps(
    moments: NDArray[np.intp], sides: NDArray[np.int64], times_s: Array
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return the certain rows and their sides, without stays shorter than `_SHORTEST_STAY_S`."""
    while True:
        starts = np.flatnonzero(np.diff(sides)) + 1
        bounds = np.array([0, *starts, len(sides)])
        for a, b in itertools.pairwise(bounds[1:-1]):  # all stays but the first and the last
            if times_s[moments[b]] - times_s[moments[a - 1]] < _SHORTEST_STAY_S:
                keep = np.r_[0:a, b : len(sides)]
                moments, sides = moments[keep], sides[keep]
                break
        else:
            return moments, sides


def _times_of_change(signed: Array, sign: NDArray[np.int64], times_s: Array, a: int, b: int) -> list[float]:
    """Return the times at which the line was crossed, in either direction, between the rows a and b."""
    at = a + np.flatnonzero(np.diff(sign[a : b + 1]))
    share = signed[at] / (signed[at] - signed[at + 1])
    return list(map(float, times_s[at] + share * (times_s[at + 1] - times_s[at])))
