"""Passages from one side of a line to the other, to stay there: one each, however a track jitters on the way.

What is looked at is a signed distance over time: of a gate's line, or of a zone's border. A point that lies exactly on
the line belongs to the side that it is about to reach, whichever that is (a half-open rule in time): who arrives at the
line has crossed it, and a track that begins on it had crossed it before. The other side counts when it is reached by
the hysteresis at two consecutive moments, so that a flicker of one frame is none, and not left again at once, as where
a box jumps back and forth.

Positions of a standing road user swing slowly, at times beyond their stated error. A stay between two passages is
therefore none where the road user neither left the line nor came back elsewhere along it: `leave` says how far. Its two
passages cancel each other, so that the net number of passages remains.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.types import Array

_SHORTEST_STAY_S: Final = 0.5
"""A road user that goes over and comes back within this, seconds, would have to brake and reverse harder than tyres
can."""


@dataclass(frozen=True, kw_only=True)
class LineCrossing:
    """From one side to the other."""

    came_from: int
    """Sign of the side before: 1 or -1."""
    time_s: float
    """Time at which the line was crossed, between the moments on either side of it; of several times back and forth the
    middle one."""
    spread_s: float
    """Half the time from the first to the last of these."""
    begins: bool
    """Whether the track begins so near to the line that the side before is in doubt."""
    ends: bool
    """Whether it ends so near to the line, or so soon after, that the side after is in doubt."""
    depth: float
    """Distance from the line on the side that is in doubt, in the distance's unit; infinite without doubt."""


def line_crossings(
    signed: Array,
    times_s: Array,
    *,
    hysteresis: float,
    least_travel: float = 0.0,
    leave: float = 0.0,
    places: Array | None = None,
) -> list[LineCrossing]:
    """All passages of a signed distance (M,) at times (M,) from one sign to the other, in order.

    Args:
        signed: Distances, positive on one side and negative on the other.
        times_s: Seconds, rising.
        hysteresis: How far on the other side it has to be for a passage to count.
        least_travel: How far it has to go from the farthest place before to the farthest place after, together.
        leave: How far it has to go between there and back for both to count: away from the line, or from its last
            place before there to its first place after back.
        places: (M, 2) places, for the second of these. Default: only the distance from the line counts.
    """
    sign = _sides(signed)
    if (sign == sign[0]).all():
        return []
    turns = list(_turns(signed, sign, times_s, hysteresis, leave, places))
    out = []
    for k, (a, b, came_from) in enumerate(turns):
        since = turns[k - 1][1] if k else 0
        until = turns[k + 1][0] if k + 1 < len(turns) else len(signed) - 1
        before = float((came_from * signed[since : b + 1]).max())
        after = float((-came_from * signed[a : until + 1]).max())
        if max(before, 0) + max(after, 0) < least_travel:
            continue
        times = _times_of_change(signed, sign, times_s, a, b)
        begins, ends = before < hysteresis, after < hysteresis or b == len(signed) - 1
        out.append(
            LineCrossing(
                came_from=came_from,
                # Where it ends on the line, jittering, it has arrived when it was there first.
                time_s=times[len(times) // 2] if len(times) % 2 else times[0],
                spread_s=(times[-1] - times[0]) / 2,
                begins=begins,
                ends=ends,
                depth=min(before if begins else np.inf, after if ends else np.inf),
            )
        )
    return out


def _sides(signed: Array) -> NDArray[np.int64]:
    """(M,) 1 or -1; what lies on the line is on the side that it has not come from."""
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
    """For each passage the last moment before and the first moment after that are sure, and the sign before."""
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
    # The track ends in doubt: having come to the line counts, unless it has gone back by the hysteresis since. Who
    # stands on the line at the end does not go back over it.
    if (sign[end:] == -side).any() and side * signed[last] < hysteresis:
        returned = _without_standing([*stays, _Stay(-side, last, last)], signed, leave, places)
        kept = returned if stays[-1] in returned else kept
    for before, after in itertools.pairwise(kept):
        if before.side != after.side:
            yield before.last, after.first, before.side


@dataclass(frozen=True)
class _Stay:
    """A stay on one side, from its first to its last sure moment."""

    side: int
    first: int
    last: int


def _stays(moments: NDArray[np.intp], sides: NDArray[np.int64]) -> list[_Stay]:
    bounds = [0, *(np.flatnonzero(np.diff(sides)) + 1).tolist(), len(sides)]
    return [_Stay(int(sides[a]), int(moments[a]), int(moments[b - 1])) for a, b in itertools.pairwise(bounds)]


def _without_standing(stays: list[_Stay], signed: Array, leave: float, places: Array | None) -> list[_Stay]:
    """Stays without those in which the road user stood on the line, neither the first stay nor the last one."""
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
    """Sure moments and their sides, without those on a side that is left too soon for anything on wheels or feet."""
    while True:
        starts = np.flatnonzero(np.diff(sides)) + 1
        bounds = np.array([0, *starts, len(sides)])
        for a, b in itertools.pairwise(bounds[1:-1]):  # not the first stay, nor the last one
            if times_s[moments[b]] - times_s[moments[a - 1]] < _SHORTEST_STAY_S:
                keep = np.r_[0:a, b : len(sides)]
                moments, sides = moments[keep], sides[keep]
                break
        else:
            return moments, sides


def _times_of_change(signed: Array, sign: NDArray[np.int64], times_s: Array, a: int, b: int) -> list[float]:
    """Times at which the line was crossed, either way, between the moments a and b."""
    at = a + np.flatnonzero(np.diff(sign[a : b + 1]))
    share = signed[at] / (signed[at] - signed[at + 1])
    return list(map(float, times_s[at] + share * (times_s[at + 1] - times_s[at])))
