"""Lofts: the left half of a shell, made of plan outlines stacked in height, with panels drawn on its surface.

A shell's columns run from the middle of the front around the left corner, along the side and around the rear corner to
the middle of the rear. Its rows run from the middle of the floor outwards, up the wall and over the top to the middle.
Panels are convex polygons in some projection of the surface. There are three ways to add them:
- Painted (panes and larger panels): triangles are split along its edges and get its material. The shell stays closed.
- Sunk (lamps and intakes): the painted area moves inwards, and walls close the rim.
- Drawn (small or thin panels): a copy of the surface in the polygon floats a millimetre above the shell, which is not
  split.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope.gen.mesh import Mesh, cross, from_triangles, merged, numbered_rows
from skope.gen.vehicles.triangle_cuts import TRIANGLE_EDGES, ConvexPolygon, Indices, cut
from skope.types import Array

X, Y, Z, NX, NY, NZ, W, T = range(8)
"""Columns of a surface's vertices: position, normal, metres along the outline from the middle of the front, row."""
WRAP_AXES: Final = (W, Z)
ROW_AXES: Final = (W, T)
SIDE_AXES: Final = (X, Z)
TOP_AXES: Final = (X, Y)

FLOOR, INNER, BOTTOM, SHOULDER, DECK, CENTER = -2.0, -1.0, 0.0, 1.0, 2.0, 3.0
"""Rows (T) of a shell: the floor's middle and inner edge, the wall's ends, the rim, the top's middle."""

_FRONT_INTERVALS, _CORNER_INTERVALS = 4, 4
"""Number of intervals between columns over half the front or rear, and around a corner."""
LAYER_LIFT_M: Final = 0.0012
"""Distance of each layer of drawn panels above the layer below, metres."""
CREASE_COS: Final = np.cos(np.radians(38))
_SAME_ROW: Final = 1e-6


@dataclass(frozen=True)
class Plan:
    """Horizontal section of a shell, metres."""

    half_width: float
    front: float
    """x of the front in the middle."""
    rear: float
    front_round: float
    """Distance of the corners behind the middle of the front."""
    rear_round: float
    front_radius: float
    rear_radius: float
    front_taper: float = 0.0
    """Reduction of the half width from the middle of the vehicle to the corner."""
    rear_taper: float = 0.0

    def outline(self, stations: Array) -> Array:
        """Return the outline (columns, 2), x and y.

        `stations` are positions on the side, from 0 (front) to 1 (rear).
        """
        front, rear = self._end_outline(1.0), self._end_outline(-1.0)[::-1]
        x = front[-1, 0] + (rear[0, 0] - front[-1, 0]) * stations[1:-1]
        return np.concatenate([front, np.stack([x, self._side_half_width(x)], axis=-1), rear])

    def _side_half_width(self, x: Array) -> Array:
        middle, half = (self.front + self.rear) / 2, (self.front - self.rear) / 2
        share = (x - middle) / half
        taper = np.where(share > 0, self.front_taper, self.rear_taper)
        return np.asarray(self.half_width - taper * np.abs(share) ** 3)

    def _end_outline(self, sign: float) -> Array:
        """Return points from the middle of one end to the side, around its corner."""
        ahead, back, radius = (
            (self.front, self.front_round, self.front_radius)
            if sign > 0
            else (-self.rear, self.rear_round, self.rear_radius)
        )
        corner = ahead - back
        half = float(self._side_half_width(np.array([sign * (corner - radius)]))[0])
        y = np.linspace(0, half - radius, _FRONT_INTERVALS + 1)
        x = ahead - back * (y / half) ** 2
        slope = 2 * back * y[-1] / half**2
        bend = np.array([x[-1] - slope * radius * 0.9, half])
        t = np.linspace(0, 1, _CORNER_INTERVALS + 1)[1:, None]
        start, end = np.array([x[-1], y[-1]]), np.array([bend[0] - radius, half])
        end[1] = float(self._side_half_width(np.array([sign * end[0]]))[0])
        # Slightly fuller than the parabola through three points, close to a circular arc.
        curve = (1 - t) ** 2 * start + 2 * t * (1 - t) * bend + t**2 * end
        outline = np.concatenate([np.stack([x, y], axis=-1), curve])
        return np.asarray(outline * [sign, 1.0])


FRONT_END: Final = _FRONT_INTERVALS
"""Column where the front's corner begins; counted from the last column, where the rear's corner begins."""
SIDE_START: Final = _FRONT_INTERVALS + _CORNER_INTERVALS
"""Column where the side begins; counted from the last column, where it ends."""


class Surface:
    """Left half of a shell; `half` and `whole` are its meshes."""

    def __init__(
        self,
        rows: Sequence[Array],
        levels: Sequence[float],
        along: Array,
        material: str,
        *,
        creases: Collection[float] = (),
    ) -> None:
        """Build the surface.

        Args:
            rows: Positions (columns, 3) of each row.
            levels: T of each row.
            along: W of each column.
            material: Material of the surface.
            creases: Rows at which the normals are discontinuous.
        """
        self._creases = np.array(sorted(creases))
        self._drawn: list[Mesh] = []
        points = np.stack(rows)
        count, columns = points.shape[:2]
        index = np.arange(count * columns).reshape(count, columns)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
        coordinates = np.stack(np.broadcast_arrays(along[None, :], np.array(levels)[:, None]), axis=-1)
        self._set_up(points.reshape(-1, 3), coordinates.reshape(-1, 2), triangles)
        self._names = [material]

    def _set_up(self, points: Array, coordinates: Array, triangles: Indices) -> None:
        """Compute smooth normals, broken at creases and mirrored at the middle; drop triangles without area."""
        face = cross(
            points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
        )
        area = np.linalg.norm(face, axis=1)
        triangles, face = triangles[area > 1e-9], face[area > 1e-9]
        unit = face / np.linalg.norm(face, axis=1, keepdims=True)
        # Rows may share points where a part of the shell has no height: normals are summed by position.
        same, _ = numbered_rows(points, 6)
        corners = triangles.ravel()
        owner = np.repeat(np.arange(len(triangles)), 3)
        order = np.argsort(same[corners], kind="stable")
        group = same[corners][order]
        starts = np.flatnonzero(np.r_[True, group[1:] != group[:-1]])
        normals = np.empty((len(corners), 3))
        above = coordinates[triangles, 1].mean(axis=1)
        broken = np.isin(coordinates[:, 1], self._creases)
        for start, stop in zip(starts, [*starts[1:], len(group)], strict=True):
            at = order[start:stop]
            unit_normals = unit[owner[at]]
            near = (unit_normals @ unit_normals.T) > CREASE_COS
            if broken[corners[at[0]]]:
                upper = above[owner[at]] > coordinates[corners[at[0]], 1]
                near &= upper[:, None] == upper[None, :]
            total = near @ face[owner[at]]
            if points[corners[at[0]], 1] < 1e-9:
                total[:, 1] = np.where(np.abs(unit_normals[:, 1]) < 0.6, 0.0, total[:, 1])
            normals[at] = total
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        rows = np.column_stack([points[corners], normals, coordinates[corners]])
        index, first = numbered_rows(rows, 9)
        self._vertices = np.asarray(np.round(rows[first], 9), dtype=np.float64)
        self._set_triangles(index.reshape(-1, 3).astype(np.int64), np.zeros(len(triangles), dtype=np.int64))

    def paint(
        self,
        polygon: ArrayLike,
        projection: tuple[int, int],
        material: str,
        *,
        levels: tuple[float, float] = (BOTTOM, SHOULDER),
        facing: tuple[float, float, float] | None = None,
    ) -> Array:
        """Give the area in a convex polygon of a projection a material; return the (N, 8) vertices of that area.

        Only triangles between the two rows `levels` are used and, if `facing` is given, only those within 45 degrees of
        it.
        """
        chosen = self._cut_polygon(polygon, projection, levels, facing)
        self._material[chosen] = self._material_number(material)
        return self._vertices[np.unique(self._triangles[chosen])]

    def _cut_polygon(
        self,
        polygon: ArrayLike,
        projection: tuple[int, int],
        levels: tuple[float, float],
        facing: tuple[float, float, float] | None,
    ) -> Indices:
        """Split triangles along a polygon's edges; return those inside."""
        outline = ConvexPolygon.of(polygon)
        active = self._reached(outline, projection, levels, facing)
        if not active.any():
            return np.zeros(0, dtype=np.int64)
        touched = np.zeros(len(self._vertices), dtype=bool)
        touched[self._triangles[active]] = True
        # Neighbours are split too, so that the shell stays closed.
        local = touched[self._triangles].any(axis=1)
        used, triangles = _renumbered(self._triangles[local])
        made = cut(self._vertices[used], triangles, active[local], outline, projection, keep_outside=True)
        added = len(self._vertices) + np.arange(len(made.vertices) - len(used))
        number = np.concatenate([used, added])
        material = self._material[local][made.parent]
        kept = int((~local).sum())
        self._vertices = np.concatenate([self._vertices, made.vertices[len(used) :]])
        self._set_triangles(
            np.concatenate([self._triangles[~local], number[made.triangles]]),
            np.concatenate([self._material[~local], material]),
        )
        return kept + np.flatnonzero(made.inside)

    def _reached(
        self,
        polygon: ConvexPolygon,
        projection: tuple[int, int],
        levels: tuple[float, float],
        facing: tuple[float, float, float] | None,
    ) -> NDArray[np.bool_]:
        """Return a mask (T,) of the triangles between two rows that face `facing` and may lie in a polygon."""
        active = self._between(levels)
        for column, start, end in zip(projection, polygon.low, polygon.high, strict=True):
            low, high = self._extremes(column)
            active = active & (high > start) & (low < end)
        if facing is not None:
            at = np.flatnonzero(active)
            active[at] = (self._vertices[:, NX:W][self._triangles[at]].mean(axis=1) @ np.array(facing)) > 0.7
        return active

    def _between(self, levels: tuple[float, float]) -> NDArray[np.bool_]:
        """Return a mask (T,) of the triangles between two rows."""
        low, high = self._extremes(T)
        return np.asarray((low >= levels[0] - 1e-6) & (high <= levels[1] + 1e-6))

    def _extremes(self, column: int) -> tuple[Array, Array]:
        """Return the minimum and maximum (T,) of a column over each triangle's corners."""
        if column not in self._known_extremes:
            a, b, c = self._vertices[:, column][self._triangles].T
            self._known_extremes[column] = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        return self._known_extremes[column]

    def _set_triangles(self, triangles: Indices, material: Indices) -> None:
        self._triangles, self._material = triangles, material
        self._known_extremes: dict[int, tuple[Array, Array]] = {}

    def sink(
        self,
        polygon: ArrayLike,
        projection: tuple[int, int],
        depth: float,
        material: str,
        *,
        wall: str = "trim",
        levels: tuple[float, float] = (BOTTOM, SHOULDER),
    ) -> None:
        """Move the area in a convex polygon `depth` metres horizontally inwards, and close its rim with walls."""
        chosen = self._cut_polygon(polygon, projection, levels, None)
        if not len(chosen):
            return
        start, end = self._rim_edges(self._triangles[chosen])
        inner = (self._vertices[start, Y] > 1e-9) | (self._vertices[end, Y] > 1e-9)
        start, end = start[inner], end[inner]
        used, index = np.unique(self._triangles[chosen], return_inverse=True)
        floor = self._vertices[used]
        floor[:, :NX] -= depth * self._outward_directions(used)
        at = np.full(len(self._vertices), -1)
        at[used] = np.arange(len(used))
        corners = np.stack([self._vertices[start], self._vertices[end], floor[at[end]], floor[at[start]]], axis=1)
        normal = cross(corners[:, 2, :NX] - corners[:, 0, :NX], corners[:, 3, :NX] - corners[:, 1, :NX])
        corners[:, :, NX:W] = (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))[:, None]
        base = len(self._vertices)
        self._vertices = np.concatenate([self._vertices, floor, corners.reshape(-1, 8)])
        first = base + len(floor) + 4 * np.arange(len(corners))[:, None]
        walls = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
        self._triangles[chosen] = base + index.reshape(-1, 3)
        self._material[chosen] = self._material_number(material)
        self._set_triangles(
            np.concatenate([self._triangles, walls]),
            np.concatenate([self._material, np.full(len(walls), self._material_number(wall))]),
        )

    def _outward_directions(self, used: Indices) -> Array:
        """Return horizontal outward unit vectors, equal for all vertices at one position.

        With these, creases stay closed and heights do not change.
        """
        same, _ = numbered_rows(self._vertices[used, :NX], 6)
        total = np.zeros((len(used), 3))
        np.add.at(total, same, self._vertices[used, NX:W])
        normal = total[same] * [1, 1, 0]
        return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))

    def _rim_edges(self, triangles: Indices) -> tuple[Indices, Indices]:
        """Return starts and ends of the edges around triangles, counter-clockwise."""
        used, local = _renumbered(triangles)
        same, _ = numbered_rows(self._vertices[used, :NX], 6)
        edges = triangles[:, TRIANGLE_EDGES].reshape(-1, 2)
        keys = same[local[:, TRIANGLE_EDGES].reshape(-1, 2)]
        base = int(keys.max()) + 1
        rim = ~np.isin(keys[:, 0] * base + keys[:, 1], keys[:, 1] * base + keys[:, 0])
        return edges[rim, 0], edges[rim, 1]

    def _material_number(self, material: str) -> int:
        if material not in self._names:
            self._names.append(material)
        return self._names.index(material)

    def draw(
        self,
        polygon: ArrayLike,
        projection: tuple[int, int],
        material: str,
        *,
        layer: float = 1,
        levels: tuple[float, float] = (BOTTOM, SHOULDER),
        facing: tuple[float, float, float] | None = None,
    ) -> None:
        """Draw a material over the area in a convex polygon of a projection, above lower layers."""
        outline = ConvexPolygon.of(polygon)
        at = np.flatnonzero(self._reached(outline, projection, levels, facing))
        if not len(at):
            return
        used, triangles = _renumbered(self._triangles[at])
        every = np.ones(len(at), dtype=bool)
        made = cut(self._vertices[used], triangles, every, outline, projection, keep_outside=False)
        inside = made.triangles[made.inside]
        a, b, c = np.moveaxis(made.vertices[:, projection][inside], 1, 0)
        # Walls around sunk areas have no area in this projection and are not visible.
        inside = inside[np.abs(_cross(b - a, c - a)) > 1e-9]
        if not len(inside):
            return
        used, index = _renumbered(inside)
        v = made.vertices[used]
        position = v[:, :NX] + layer * LAYER_LIFT_M * v[:, NX:W]
        kind = np.zeros(len(inside), dtype=np.int64)
        self._drawn.append(Mesh(position, v[:, NX:W], index, (material,), kind))

    def corner(self, level: float, *, rear: bool = False) -> Array:
        """Return the position (3,) at which a row turns from the front, or the rear, to the side.

        It is the farthest point outwards along the diagonal, where the tangent is at 45 degrees.
        """
        row = self._vertices[np.abs(self._vertices[:, T] - level) < _SAME_ROW]
        outwards = np.array([-1.0 if rear else 1.0, 1.0])
        return np.asarray(row[(row[:, [X, Y]] @ outwards).argmax(), :NX])

    def place(
        self,
        point: ArrayLike,
        projection: tuple[int, int] = (W, Z),
        *,
        levels: tuple[float, float] = (BOTTOM, SHOULDER),
    ) -> tuple[Array, Array]:
        """Return position and unit normal (3,) of the surface's outermost point at a point of a projection."""
        triangles = self._triangles[self._between(levels)]
        a, b, c = np.moveaxis(self._vertices[:, projection][triangles], 1, 0)
        p = np.asarray(point, dtype=np.float64)
        area = _cross(b - a, c - a)
        flat = np.abs(area) < 1e-10
        area = np.where(flat, 1.0, area)
        shares = np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], axis=-1) / area[:, None]
        shares[flat] = -9.0
        # In a hole, use the nearest triangle's edge.
        least = np.minimum(np.minimum(shares[:, 0], shares[:, 1]), shares[:, 2])
        inside = np.flatnonzero(least > min(-1e-6, float(least.max()) - 1e-9))
        weights = np.clip(shares[inside], 0, 1)
        weights /= weights.sum(axis=1, keepdims=True)
        found = (self._vertices[triangles[inside]] * weights[..., None]).sum(axis=1)
        best = found[(found[:, :NX] * found[:, NX:W]).sum(axis=1).argmax()]
        return best[:NX], best[NX:W] / np.linalg.norm(best[NX:W])

    def side(self, position: Array) -> float:
        """Return y of the surface's outermost point at a position x, z."""
        return float(self.place(position, SIDE_AXES)[0][1])

    def line(
        self,
        points: ArrayLike,
        projection: tuple[int, int],
        material: str = "gap",
        *,
        width: float = 0.009,
        layer: float = 1,
        levels: tuple[float, float] = (BOTTOM, SHOULDER),
        facing: tuple[float, float, float] | None = None,
    ) -> None:
        """Draw a thin line through points (N, 2) of a projection."""
        p = np.asarray(points, dtype=np.float64)
        for start, end in pairwise(p):
            along = (end - start) / np.hypot(*(end - start))
            across = np.array([-along[1], along[0]]) * width / 2
            reach = along * width / 2
            quad = [start - across - reach, end - across + reach, end + across + reach, start + across - reach]
            self.draw(quad, projection, material, layer=layer, levels=levels, facing=facing)

    def carve_well(self, polygon: ArrayLike, inner: float) -> tuple[Mesh, Array]:
        """Cut a wheel well to the depth y = `inner`; `polygon` is its outline in side view.

        Returns:
            Its lining, and the (N, 2, 3) edges of the hole in the wall, each counter-clockwise around the hole.
        """
        gone = self._cut_polygon(polygon, SIDE_AXES, (INNER, SHOULDER), None)
        removed = self._triangles[gone]
        self._set_triangles(np.delete(self._triangles, gone, axis=0), np.delete(self._material, gone))
        position = self._vertices[:, :3]
        start, end = self._rim_edges(removed)
        a, b = position[start], position[end]
        a2, b2 = a.copy(), b.copy()
        a2[:, 1] = b2[:, 1] = inner
        center = np.tile((a.min(axis=0) + a.max(axis=0)) / 2, (len(a), 1))
        center[:, 1] = inner
        corners = np.concatenate([np.stack([a, b, b2], 1), np.stack([a, b2, a2], 1), np.stack([a2, b2, center], 1)])
        area = np.linalg.norm(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        corners = corners[area > 1e-8]
        lining = from_triangles(corners.reshape(-1, 3), np.arange(3 * len(corners)), "under")
        level = self._vertices[:, T]
        wall = (level[start] >= 0) & (level[end] >= 0)
        return lining, np.stack([a, b], axis=1)[wall & (np.abs(a[:, 2] - b[:, 2]) + np.abs(a[:, 0] - b[:, 0]) > 1e-6)]

    @property
    def half(self) -> Mesh:
        used, index = np.unique(self._triangles, return_inverse=True)
        v = self._vertices[used]
        shell = Mesh(v[:, :3], v[:, NX:W], index.reshape(-1, 3), tuple(self._names), self._material)
        return merged([shell, *self._drawn])


def _renumbered(triangles: Indices) -> tuple[Indices, Indices]:
    """Return the vertices that triangles (T, 3) use, in ascending order, and the triangles with indices into them."""
    used, index = np.unique(triangles, return_inverse=True)
    return used, index.reshape(-1, 3)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def metres_along(outline: Array) -> Array:
    """Return the distance along an outline (columns, 2) from its first point, metres."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
