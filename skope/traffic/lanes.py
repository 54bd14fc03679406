"""Lanes of road users, and lane changes."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.confidence_level import at_most
from skope.site.gates_zones_lanes import DEFAULT_LANE_M, Lane
from skope.tracks.track import Track, is_in_traffic
from skope.types import Array


@dataclass(frozen=True)
class LaneLimits:
    """Limits of lane changes."""

    stay_s: float = 1.0
    """Minimum time in each of the two lanes of a change, seconds."""
    between_s: float = 3.0
    """Maximum time between the two lanes of a change, seconds."""
    parallel_cos: float = math.cos(math.radians(45))
    """Cosine of the largest angle between lanes of one direction. Lanes at a larger angle are two arms of a
    junction."""
    no_lane: int = -1
    """Index that means "in no lane"."""


LANE_LIMITS: Final = LaneLimits()


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneChange:
    """Change of a road user from one lane to another lane of the same direction."""

    trajectory: Track
    time_s: float
    """Middle of the time between the two lanes, seconds."""
    position: Array
    """(2,) position at `time_s`, metres."""
    from_lane: str
    to_lane: str
    probability: float
    """Probability that the road user was in `from_lane` before and in `to_lane` after."""


class LaneMap:
    """Map of the lanes, which finds the lane of a position."""

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self.lanes = tuple(lanes)
        self._lines = [_without_repeats(np.array(lane.line)) for lane in lanes]
        self._half = np.array([(lane.width or DEFAULT_LANE_M) / 2 for lane in lanes])

    def indices(self, places: Array, least: float = 0.0) -> tuple[NDArray[np.int64], Array, Array]:
        """Return the lane of each position.

        If lanes overlap, the lane with the nearest centre line is taken, relative to the width of the lane.

        Args:
            places: (M, 2) positions, metres.
            least: Minimum distance inside the edges of the lane, metres.

        Returns:
            (M,) index or -1, (M,) distance to the centre line (metres), and (M, 2) direction of the lane there.
        """
        if not self.lanes:
            count = len(places)
            return np.full(count, LANE_LIMITS.no_lane), np.full(count, np.inf), np.zeros((count, 2))
        found = [_from_line(line, places) for line in self._lines]
        away = np.stack([distance for distance, _ in found])
        ways = np.stack([way for _, way in found])
        share = np.where(away <= (self._half - least).clip(0)[:, None], away / self._half[:, None], np.inf)
        best = share.argmin(axis=0)
        column = np.arange(len(places))
        inside = np.isfinite(share[best, column])
        return np.where(inside, best, LANE_LIMITS.no_lane), away[best, column], ways[best, column]

    def along(self, lane: int, places: Array) -> Array:
        """Return (M,) distances of positions (M, 2) along a lane, metres from its start."""
        line = self._lines[lane]
        step = np.diff(line, axis=0)
        length = np.linalg.norm(step, axis=1)
        away = places[:, None] - line[None, :-1]
        t = (np.einsum("mki,ki->mk", away, step) / length).clip(0, length)
        beside = np.linalg.norm(away - (t / length)[..., None] * step, axis=2)
        k = beside.argmin(axis=1)
        return np.asarray((np.cumsum(length) - length)[k] + t[np.arange(len(places)), k])

    def lane_at(self, position: Array, covariance: Array) -> tuple[str, float]:
        """Return the name of the lane at a position (2,), "" for none, and the probability that it is right."""
        index, away, way = self.indices(position[None])
        if index[0] == LANE_LIMITS.no_lane:
            return "", 1.0
        across = np.array([-way[0, 1], way[0, 0]])
        sigma = math.sqrt(max(1e-12, float(across @ covariance @ across)))
        half = float(self._half[index[0]])
        inside = at_most((half - away[0]) / sigma) - at_most((-half - away[0]) / sigma)
        return self.lanes[index[0]].name, inside


def _without_repeats(line: Array) -> Array:
    """Return a line (N, 2) without repeated points. A single point becomes two points 1 mm apart."""
    kept = line[np.concatenate([[True], (np.diff(line, axis=0) != 0).any(axis=1)])]
    return kept if len(kept) > 1 else np.stack([kept[0], kept[0] + [1e-3, 0]])


def _from_line(line: Array, places: Array) -> tuple[Array, Array]:
    """Return distances from a polyline and its direction at the nearest point.

    Returns:
        (M,) distances of positions (M, 2), infinite before its start and after its end, and (M, 2) directions.
    """
    a, b = line[:-1], line[1:]
    step = b - a
    length = np.linalg.norm(step, axis=1)
    along = step / length[:, None]
    away = places[:, None] - a[None]
    t = np.einsum("mki,ki->mk", away, along)
    beside = np.abs(along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0])
    bounded = t.clip(0, length)
    distance = np.hypot(t - bounded, beside)
    k = distance.argmin(axis=1)
    m = np.arange(len(places))
    beyond = ((k == 0) & (t[m, k] < 0)) | ((k == len(length) - 1) & (t[m, k] > length[k]))
    return np.where(beyond, np.inf, distance[m, k]), along[k]


def lane_changes(trajectories: Sequence[Track], lanes: LaneMap, hysteresis_m: float) -> list[LaneChange]:
    """Return all lane changes, in order of time.

    Args:
        trajectories: All tracks. Tracks that are not confirmed or never moved have no lane changes.
        lanes: The lanes. With a single lane there are no changes.
        hysteresis_m: Minimum distance inside the edges of a lane for a road user to be in it, metres.
    """
    found: list[LaneChange] = []
    if len(lanes.lanes) > 1:
        for trajectory in filter(is_in_traffic, trajectories):
            found += _changes(trajectory, lanes, hysteresis_m)
    return sorted(found, key=lambda change: (change.time_s, change.trajectory.number))


def _changes(trajectory: Track, lanes: LaneMap, hysteresis_m: float) -> list[LaneChange]:
    index, _, ways = lanes.indices(trajectory.xy, hysteresis_m)
    times = trajectory.times_s
    runs: list[NDArray[np.intp]] = []
    for run in np.split(np.arange(len(index)), np.flatnonzero(np.diff(index)) + 1):
        if index[run[0]] != LANE_LIMITS.no_lane:
            if runs and index[runs[-1][0]] == index[run[0]]:
                runs[-1] = np.arange(runs[-1][0], run[-1] + 1)
            else:
                runs.append(run)
    runs = [run for run in runs if times[run[-1]] - times[run[0]] >= LANE_LIMITS.stay_s]
    out = []
    for before, after in itertools.pairwise(runs):
        left, entered = before[-1], after[0]
        changed = index[left] != index[entered] and times[entered] - times[left] <= LANE_LIMITS.between_s
        if not changed or float(ways[left] @ ways[entered]) < LANE_LIMITS.parallel_cos:
            continue
        time_s = float(times[left] + times[entered]) / 2
        sure = [
            lanes.lane_at(trajectory.xy[i], trajectory.total_covariance[i])[1]
            for i in (before[len(before) // 2], after[len(after) // 2])
        ]
        out.append(
            LaneChange(
                trajectory=trajectory,
                time_s=time_s,
                position=trajectory.at(trajectory.xy, time_s),
                from_lane=lanes.lanes[index[left]].name,
                to_lane=lanes.lanes[index[entered]].name,
                probability=math.prod(sure),
            )
        )
    return out
