"""Footprints of road users (rectangles on the road), and the time at which two of them meet."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.tracks.track import Track
from skope.types import Array

UNIT_CORNERS: Final = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])
_NODE_M: Final = 0.3
"""Minimum distance between nodes of a path, metres, so that jitter of positions does not lengthen the path."""


def footprint_corners(centre: Array, facing: Array, size: tuple[float, float]) -> Array:
    """Return the corners of rectangles.

    Args:
        centre: (..., 2) centres, metres.
        facing: (..., 2) unit vectors along the length.
        size: Length and width, metres.

    Returns:
        (..., 4, 2) corners, metres.
    """
    across = np.stack([-facing[..., 1], facing[..., 0]], axis=-1)
    offsets = UNIT_CORNERS * size
    along, aside = offsets[:, :1] * facing[..., None, :], offsets[:, 1:] * across[..., None, :]
    return np.asarray(centre[..., None, :] + along + aside)


def meeting(first: Array, first_velocity: Array, second: Array, second_velocity: Array) -> tuple[Array, Array]:
    """Return the period in which two rectangles with constant velocities overlap.

    The method is that of separating axes: rectangles overlap if their projections on the directions of all sides
    overlap.

    Args:
        first: (..., 4, 2) corners of the first rectangle.
        first_velocity: (..., 2) its velocity, m/s.
        second: (..., 4, 2) corners of the second rectangle.
        second_velocity: (..., 2) its velocity, m/s.

    Returns:
        (...,) start and (...,) end of the overlap, seconds from now. Start > end if they never overlap.
    """
    away = second.mean(axis=-2) - first.mean(axis=-2)
    rate_xy = second_velocity - first_velocity
    halves = [(shape[..., 0, :] - shape[..., k, :]) / 2 for shape in (first, second) for k in (1, 3)]
    begin, end = np.full(away.shape[:-1], -np.inf), np.full(away.shape[:-1], np.inf)
    for axis in halves:
        reach = sum(np.abs(_dot(half, axis)) for half in halves)
        apart, rate = _dot(away, axis), _dot(rate_xy, axis)
        still = np.abs(rate) < 1e-12
        safe = np.where(still, 1.0, rate)
        middle, around = -apart / safe, np.abs(reach / safe)
        never = still & (np.abs(apart) > reach)
        begin = np.maximum(begin, np.where(still, np.where(never, np.inf, -np.inf), middle - around))
        end = np.minimum(end, np.where(still, np.where(never, -np.inf, np.inf), middle + around))
    return begin, end


def _dot(a: Array, b: Array) -> Array:
    """Return (...,) dot products of vectors (..., 2). This is faster than einsum for two components."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1])


def overlap(first: Array, second: Array) -> NDArray[np.bool_]:
    """Return (...,) whether rectangles (..., 4, 2) overlap or touch."""
    still = np.zeros((*first.shape[:-2], 2))
    begin, end = meeting(first, still, second, still)
    return np.asarray(begin <= end)


class FootprintPath:
    """Track resampled at times that all tracks have in common, with its path by travelled distance."""

    def __init__(self, trajectory: Track, step_s: float) -> None:
        """Resample a track at the multiples of `step_s`, seconds."""
        times = trajectory.times_s
        self.trajectory, self.size = trajectory, trajectory.size
        first, last = int(np.ceil(times[0] / step_s - 1e-9)), int(np.floor(times[-1] / step_s + 1e-9))
        self.ticks = np.arange(first, last + 1)
        self.times_s = np.asarray(self.ticks * step_s, dtype=np.float64)
        self.position, self.facing = self.at(self.times_s)
        self.speed = trajectory.at(trajectory.speed, self.times_s)
        self.corners = footprint_corners(self.position, self.facing, self.size)
        self._radius = float(np.hypot(*self.size)) / 2
        self._nodes = self._by_length()
        self.along = np.interp(self.ticks, self._nodes[0], self._nodes[1][:-1])

    @property
    def radius(self) -> float:
        """Half the diagonal of the footprint, metres."""
        return self._radius

    def at(self, times_s: Array) -> tuple[Array, Array]:
        """Return positions (..., 2) and unit vectors (..., 2) to the front at times (...,)."""
        position = self.trajectory.at(self.trajectory.xy, times_s)
        facing = self.trajectory.at(self.trajectory.facing, times_s)
        return position, facing / np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-9)

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
