"""Heights of the lanes in the network, and of the ground beside the roads, which follows them."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from skope.gen.towns.town_style import Terrain
from skope.types import Array


@dataclass(frozen=True)
class TerrainCells:
    """Cell sizes of sloped ground, and smoothing of heights."""

    softening_m: float = 0.25
    """Distance that is added in the weights of lanes to smooth heights, metres."""
    finest_m: float = 2.0
    """Size of the smallest cells of sloped ground, metres."""
    coarsest_m: int = 64
    """Size of the largest ground cells, metres; their sides are at multiples of it."""


TERRAIN_CELLS: Final = TerrainCells()


class Lanes:
    """Centre lines of lanes in space; the height beside them is the distance-weighted mean of the near lanes."""

    def __init__(self, lanes: Iterable[tuple[Any, float]]) -> None:
        """Store lanes of sumolib, each with the width of the strip beside it at its height, metres."""
        starts, ends, numbers, halves, verges = [], [], [], [], []
        for number, (lane, verge) in enumerate(lanes):
            line = np.array(lane.getShape3D())
            starts.append(line[:-1])
            ends.append(line[1:])
            numbers.append(np.full(len(line) - 1, number))
            halves.append(np.full(len(line) - 1, lane.getWidth() / 2))
            verges.append(np.full(len(line) - 1, verge))
        self._a, self._b = np.concatenate(starts), np.concatenate(ends)
        self._lane, self._half = np.concatenate(numbers), np.concatenate(halves)
        self._verge = np.concatenate(verges)
        self._tree = shapely.STRtree(shapely.linestrings(np.stack([self._a[:, :2], self._b[:, :2]], axis=1)))

    @property
    def points(self) -> Array:
        """(N, 3) points on the lanes."""
        return np.concatenate([self._a, self._b])

    @property
    def beside(self) -> float:
        """Largest distance from a lane's middle to the outer edge of the strip beside it, metres."""
        return float((self._half + self._verge).max())

    @cached_property
    def level(self) -> float | None:
        """Height of all lanes if they have a common one, else None."""
        z = self.points[:, 2]
        return float(z[0]) if np.ptp(z) < 1e-6 else None

    def near(self, places: Array, reach: float) -> tuple[Array, Array]:
        """Return lane heights (N,) at places (N, 2), and distances (N,) from strips beside lanes; nan, inf if far."""
        index, segment = self._tree.query(shapely.points(places), predicate="dwithin", distance=reach)
        a, along = self._a[segment], self._b[segment] - self._a[segment]
        squared = np.maximum((along[:, :2] ** 2).sum(axis=1), 1e-12)
        share = np.clip(((places[index] - a[:, :2]) * along[:, :2]).sum(axis=1) / squared, 0, 1)
        foot = a + share[:, None] * along
        distance = np.hypot(*(places[index] - foot[:, :2]).T)
        # Only the nearest segment of each lane is used.
        order = np.lexsort((distance, self._lane[segment], index))
        index, segment, foot, distance = index[order], segment[order], foot[order], distance[order]
        pair = np.stack([index, self._lane[segment]])
        first = np.ones(len(index), dtype=bool)
        first[1:] = (pair[:, 1:] != pair[:, :-1]).any(axis=0)
        index, segment, foot, distance = index[first], segment[first], foot[first], distance[first]
        beside = np.maximum(distance - self._half[segment], 0.0)
        weight = (beside + TERRAIN_CELLS.softening_m) ** -4.0
        total = np.bincount(index, weight, len(places))
        height = np.bincount(index, weight * foot[:, 2], len(places))
        away = np.full(len(places), np.inf)
        np.minimum.at(away, index, np.maximum(beside - self._verge[segment], 0.0))
        return np.divide(height, total, out=np.full(len(places), np.nan), where=total > 0), away


class GroundSurface:
    """Heights of the carriageways on the ground and of the ground beside them."""

    def __init__(self, style: Terrain, driven: Lanes, shaping: Lanes) -> None:
        """Create the surface from `driven`, all lanes on the ground, and `shaping`, those that shape the ground."""
        self._style, self._driven, self._shaping = style, driven, shaping

    @cached_property
    def flat(self) -> bool:
        """Whether all heights are 0."""
        return self.level == 0.0

    @property
    def level(self) -> float | None:
        """Common height of all ground, or None if heights vary."""
        same = self._driven.level == self._style.level and not self._style.waves
        return self._style.level if same else None

    def road(self, places: Array) -> Array:
        """Return the heights (N,) of the carriageway at places (N, 2)."""
        if self.flat:
            return np.zeros(len(places))
        height, _ = self._driven.near(places, 12.0)
        far = np.isnan(height)
        if far.any():
            height[far] = self.natural(places[far])
        return height

    def beside(self, places: Array) -> Array:
        """Return the ground heights (N,) at places (N, 2), without kerbs; banks connect roads and natural ground."""
        if self.flat:
            return np.zeros(len(places))
        around = self.natural(places)
        if self._shaping.level == 0.0 and not around.any():
            return around
        height, away = self._shaping.near(places, self._reach)
        near = np.isfinite(away)
        rise = self._style.slope * away[near]
        around[near] = np.clip(around[near], height[near] - rise, height[near] + rise)
        return around

    @cached_property
    def _reach(self) -> float:
        """Distance from a lane at which its banks end, metres."""
        points = self._shaping.points
        highest = np.abs(points[:, 2] - self.natural(points[:, :2])).max()
        return self._shaping.beside + (float(highest) + 1.0) / self._style.slope

    def natural(self, places: Array) -> Array:
        """Return the heights (N,) of the ground without roads."""
        out = np.full(len(places), self._style.level)
        for amplitude, length, direction, phase in self._style.waves:
            angle = np.radians(direction)
            along = places @ np.array([np.cos(angle), np.sin(angle)])
            out += amplitude * np.sin(2 * np.pi * along / length + np.radians(phase))
        return out

    def cells(self, bounds: tuple[float, float, float, float], road: Any) -> NDArray[np.object_]:
        """Return squares that cover a rectangle, small enough for the ground in each to be nearly plane.

        Their outlines include the corners of all neighbours, so that there are no gaps between large and small squares.
        """
        unit, size = TERRAIN_CELLS.finest_m, int(TERRAIN_CELLS.coarsest_m // TERRAIN_CELLS.finest_m)
        low = np.floor(np.array(bounds[:2]) / TERRAIN_CELLS.coarsest_m) * TERRAIN_CELLS.coarsest_m
        count = np.ceil((np.array(bounds[2:]) - low) / TERRAIN_CELLS.coarsest_m).astype(int)
        corners = np.stack(np.meshgrid(*(np.arange(n) * size for n in count)), axis=-1).reshape(-1, 2)
        leaves = []
        while True:
            middle = low + unit * (corners + size / 2)
            split = self._bends(middle, unit * size, road) if size > 1 else np.zeros(len(corners), dtype=bool)
            leaves.append(np.column_stack([corners[~split], np.full((~split).sum(), size)]))
            if not split.any():
                break
            size //= 2
            corners = (corners[split][:, None] + size * np.array([[0, 0], [1, 0], [0, 1], [1, 1]])).reshape(-1, 2)
        return _with_corners(np.concatenate(leaves), low, unit)

    def _bends(self, middles: Array, size: float, road: Any) -> NDArray[np.bool_]:
        """Return whether (N,) the ground in squares around `middles` deviates from a plane."""
        steps = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]), axis=-1).reshape(-1, 2)
        places = (middles[:, None] + size * steps).reshape(-1, 2)
        by_road = shapely.dwithin(road, shapely.points(middles), 0.75 * size + 5.0)
        out = _unevenness(self.beside(places).reshape(-1, 9)) > np.where(by_road, 0.02, 0.12)
        if by_road.any():
            near = places.reshape(-1, 9, 2)[by_road].reshape(-1, 2)
            out[by_road] |= _unevenness(self.road(near).reshape(-1, 9)) > 0.0025
        return np.asarray(out)


def _unevenness(heights: Array) -> Array:
    """Return the deviation (N,) of heights (N, 9) on a 3 x 3 grid from the surface through the corners."""
    corners = heights[:, [0, 2, 6, 8]]
    flat = np.stack(
        [
            corners[:, [0, 1]].mean(axis=1),
            corners[:, [0, 2]].mean(axis=1),
            corners.mean(axis=1),
            corners[:, [1, 3]].mean(axis=1),
            corners[:, [2, 3]].mean(axis=1),
        ],
        axis=1,
    )
    twist = np.abs(corners[:, 0] + corners[:, 3] - corners[:, 1] - corners[:, 2]) / 4
    return np.asarray(np.maximum(np.abs(heights[:, [1, 3, 4, 5, 7]] - flat).max(axis=1), twist))


def _with_corners(leaves: NDArray[np.int64], low: Array, unit: float) -> NDArray[np.object_]:
    """Return the polygons of squares (column, row, size), including other squares' corners on their edges."""
    corners = {(x + dx * s, y + dy * s) for x, y, s in leaves.tolist() for dx in (0, 1) for dy in (0, 1)}
    out = []
    for x, y, s in leaves.tolist():
        steps = range(s)
        ring = [(x + i, y) for i in steps] + [(x + s, y + i) for i in steps]
        ring += [(x + s - i, y + s) for i in steps] + [(x, y + s - i) for i in steps]
        out.append(shapely.Polygon(low + unit * np.array([corner for corner in ring if corner in corners])))
    return np.array(out, dtype=object)
