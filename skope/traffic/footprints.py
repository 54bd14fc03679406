"""Footprints of road users (rectangles on the road), and the time at which two of them meet."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.tracks.track import Track
from skope.types import Array

_UNIT_CORNERS: Final = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])
_NODE_M: Final = 0.3
"""Minimum distance between nodes of a path, metres, so that jitter of positions does not lengthen the path."""
_SLACK_M: Final = 1e-6
"""Margin of the comparison of circumscribed circles, metres, against rounding."""


@dataclass(frozen=True, eq=False)
class Footprints:
    """Footprints of one road user: rectangles of one size."""

    centre: Array
    """(..., 2) centres, metres."""
    facing: Array
    """(..., 2) unit vectors to the front."""
    size: tuple[float, float]
    """Length and width, metres."""

    def __getitem__(self, index: Any) -> "Footprints":
        """Return the footprints that an index of numpy selects."""
        return Footprints(self.centre[index], self.facing[index], self.size)

    def broadcast(self, shape: tuple[int, ...]) -> "Footprints":
        """Return the footprints broadcast to a shape."""
        centre, facing = (np.broadcast_to(values, (*shape, 2)) for values in (self.centre, self.facing))
        return Footprints(centre, facing, self.size)

    def scaled(self, factor: float) -> "Footprints":
        """Return footprints with the same centres, and length and width multiplied by `factor`."""
        return Footprints(self.centre, self.facing, (factor * self.size[0], factor * self.size[1]))

    @property
    def radius(self) -> float:
        """Half the diagonal, metres."""
        return math.hypot(*self.size) / 2

    @property
    def corners(self) -> Array:
        """(..., 4, 2) corners, metres."""
        offsets = _UNIT_CORNERS * self.size
        aside = _turned(self.facing)[..., None, :]
        return np.asarray(
            self.centre[..., None, :] + offsets[:, :1] * self.facing[..., None, :] + offsets[:, 1:] * aside
        )


def _turned(vectors: Array) -> Array:
    """Return vectors (..., 2) turned left by a right angle."""
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def _dot(a: Array, b: Array) -> Array:
    """Return (...,) dot products of vectors (..., 2). This is faster than einsum for two components."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1])


def _axes(first: Footprints, second: Footprints) -> Iterator[tuple[Array, Array]]:
    """Yield the directions (..., 2) of the sides of two rectangles.

    Each comes with the distance (...,) of the centres along it up to which the projections of both rectangles overlap.
    """
    aside = _turned(first.facing), _turned(second.facing)
    same, across = np.abs(_dot(first.facing, second.facing)), np.abs(_dot(aside[0], second.facing))
    for footprints, left, other in ((first, aside[0], second), (second, aside[1], first)):
        length, width = footprints.size
        other_length, other_width = other.size
        yield footprints.facing, (length + other_length * same + other_width * across) / 2
        yield left, (width + other_length * across + other_width * same) / 2


def overlap(first: Footprints, second: Footprints) -> NDArray[np.bool_]:
    """Return (...,) whether footprints overlap or touch. The shapes of both are broadcast.

    Two rectangles overlap if their projections on the directions of all sides overlap (separating axes).
    """
    away = second.centre - first.centre
    return np.asarray(
        np.logical_and.reduce([np.abs(_dot(away, axis)) <= reach for axis, reach in _axes(first, second)])
    )


def meeting(first: Footprints, second: Footprints, velocity: Array) -> tuple[Array, Array]:
    """Return the period in which footprints with constant velocities overlap, by separating axes.

    Args:
        first: (...,) footprints of the first road user.
        second: (...,) footprints of the second road user.
        velocity: (..., 2) velocities of the second road user relative to the first, m/s.

    Returns:
        (...,) start and (...,) end of the overlap, seconds from now. Start > end if they never overlap.
    """
    away = second.centre - first.centre
    begin, end = np.full(away.shape[:-1], -np.inf), np.full(away.shape[:-1], np.inf)
    for axis, reach in _axes(first, second):
        apart, rate = _dot(away, axis), _dot(velocity, axis)
        still = np.abs(rate) < 1e-12
        safe = np.where(still, 1.0, rate)
        middle, around = -apart / safe, np.abs(reach / safe)
        never = still & (np.abs(apart) > reach)
        begin = np.maximum(begin, np.where(still, np.where(never, np.inf, -np.inf), middle - around))
        end = np.minimum(end, np.where(still, np.where(never, -np.inf, np.inf), middle + around))
    return begin, end


def meeting_within(first: Footprints, second: Footprints, velocity: Array, until_s: float) -> tuple[Array, Array]:
    """Return the part of the period of `meeting` from now to `until_s`.

    The shapes of both are broadcast. Footprints are compared only where their circumscribed circles meet.

    Returns:
        (...,) start and (...,) end of the overlap, seconds from now. Without an overlap, start is infinite and end is
        minus infinity.
    """
    away, rate = np.broadcast_arrays(second.centre - first.centre, velocity)
    nearest_s = np.clip(-_dot(away, rate) / np.maximum(_dot(rate, rate), 1e-12), 0, until_s)
    gap = away + rate * nearest_s[..., None]
    near = _dot(gap, gap) <= (first.radius + second.radius + _SLACK_M) ** 2
    begin, end = np.full(near.shape, np.inf), np.full(near.shape, -np.inf)
    if near.any():
        pair = [footprints.broadcast(near.shape)[near] for footprints in (first, second)]
        since, until = meeting(pair[0], pair[1], rate[near])
        met = (since <= until) & (until >= 0) & (since <= until_s)
        begin[near] = np.where(met, np.maximum(since, 0), np.inf)
        end[near] = np.where(met, np.minimum(until, until_s), -np.inf)
    return begin, end


class FootprintPath:
    """Track resampled at times that all tracks have in common, with its path by travelled distance."""

    def __init__(self, trajectory: Track, step_s: float) -> None:
        """Resample a track at the multiples of `step_s`, seconds."""
        times = trajectory.times_s
        self.trajectory, self.size = trajectory, trajectory.size
        first, last = int(np.ceil(times[0] / step_s - 1e-9)), int(np.floor(times[-1] / step_s + 1e-9))
        self.ticks = np.arange(first, last + 1)
        self.times_s = np.asarray(self.ticks * step_s, dtype=np.float64)
        self.footprints = self.at(self.times_s)
        self.position, self.facing = self.footprints.centre, self.footprints.facing
        self.speed = trajectory.at(trajectory.speed, self.times_s)
        self._nodes = self._by_length()
        self.along = np.interp(self.ticks, self._nodes[0], self._nodes[1][:-1])

    @property
    def radius(self) -> float:
        """Half the diagonal of the footprint, metres."""
        return self.footprints.radius

    @cached_property
    def headings_deg(self) -> tuple[float, float]:
        """Heading of the path's mean direction, and the largest angle between it and a heading of the path, degrees."""
        east, north = self.facing.sum(axis=0)
        middle = math.atan2(north, east)
        turned = np.arctan2(self.facing[:, 1], self.facing[:, 0]) - middle
        spread = np.abs((turned + math.pi) % math.tau - math.pi).max(initial=0.0)
        return math.degrees(middle), math.degrees(spread)

    def at(self, times_s: Array) -> Footprints:
        """Return the footprints at times (...,), seconds."""
        position = self.trajectory.at(self.trajectory.xy, times_s)
        facing = self.trajectory.at(self.trajectory.facing, times_s)
        norm = np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-9)
        return Footprints(position, facing / norm, self.size)

    def _by_length(self) -> tuple[Array, Array, Array, Array]:
        """Return ticks (N,) of the nodes, and distances, positions and headings of the nodes and of a straight end."""
        rows = [0] if len(self.ticks) else []
        for i in range(1, len(self.ticks)):
            if np.hypot(*(self.position[i] - self.position[rows[-1]])) >= _NODE_M:
                rows.append(i)
        places, facings, ticks = self.position[rows], self.facing[rows], self.ticks[rows].astype(float)
        far = 1000.0
        places = np.concatenate([places, places[-1:] + far * facings[-1:]])
        facings = np.concatenate([facings, facings[-1:]])
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
        return ticks, lengths, places, facings

    def ahead(self, rows: NDArray[np.intp], metres: Array) -> tuple[Array, Array]:
        """Return positions and headings (..., 2) after travelling `metres` (...,) from the times of `rows` (...,)."""
        _, lengths, places, facings = self._nodes
        along = self.along[rows] + metres
        at = np.stack([np.interp(along, lengths, places[:, k]) for k in (0, 1)], axis=-1)
        # Between nodes the position is slightly beside the straight line from node to node.
        here = np.stack([np.interp(self.along[rows], lengths, places[:, k]) for k in (0, 1)], axis=-1)
        facing = np.stack([np.interp(along, lengths, facings[:, k]) for k in (0, 1)], axis=-1)
        norm = np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-9)
        return at + self.position[rows] - here, facing / norm


def footprint_paths(trajectories: Sequence[Track], step_s: float) -> list[FootprintPath]:
    """Return the paths of tracks with at least two sampled times."""
    made = [
        FootprintPath(trajectory, step_s)
        for trajectory in trajectories
        if trajectory.times_s[-1] - trajectory.times_s[0] >= 2 * step_s
    ]
    return [path for path in made if len(path.ticks) > 1]
