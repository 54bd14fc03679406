"""Triangle meshes with a material per triangle, and the basic shapes that models and scenery are built from."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope.types import Array

FEW_TRIANGLES: Final = 500
"""Number of triangles below which a mesh is not simplified."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, counter-clockwise seen from outside."""

    vertices: Array
    """(V, 3) metres."""
    normals: Array
    """(V, 3) unit vectors; vertices on a hard edge are duplicated."""
    triangles: NDArray[np.int64]
    """(T, 3) vertex indices."""
    materials: tuple[str, ...]
    """Names of the materials that occur."""
    material: NDArray[np.int64]
    """(T,) index into `materials`."""

    def moved(self, offset: ArrayLike, yaw: float = 0.0) -> "Mesh":
        """Return the mesh rotated about z by `yaw` radians, then shifted."""
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return Mesh(
            self.vertices @ R.T + np.asarray(offset), self.normals @ R.T, self.triangles, self.materials, self.material
        )

    def mirrored(self) -> "Mesh":
        """Return the mesh mirrored left to right (y -> -y), still counter-clockwise seen from outside."""
        flip = np.array([1.0, -1.0, 1.0])
        return Mesh(self.vertices * flip, self.normals * flip, self.triangles[:, ::-1], self.materials, self.material)

    def taken(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> "Mesh":
        """Return the mesh with some of its triangles, selected by indices (in their order) or by a mask."""
        return Mesh(self.vertices, self.normals, self.triangles[chosen], self.materials, self.material[chosen])

    def to_arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Return arrays to be stored in a file, one per field; their names are `name`, an underscore and the field."""
        fields = {
            "vertices": self.vertices,
            "normals": self.normals,
            "triangles": self.triangles,
            "material": self.material,
            "materials": np.array(self.materials, dtype=str),
        }
        return {f"{name}_{field}": values for field, values in fields.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], name: str) -> "Mesh":
        """Return the mesh that `to_arrays` stored under `name`."""
        vertices, normals, triangles, material, materials = (
            arrays[f"{name}_{field}"] for field in ("vertices", "normals", "triangles", "material", "materials")
        )
        return cls(vertices, normals, triangles, tuple(materials.tolist()), material)

    def by_material(self) -> dict[str, "Mesh"]:
        """Return one mesh per material, in the order of `materials`, without unused vertices."""
        out = {}
        for i, name in enumerate(self.materials):
            chosen = self.triangles[self.material == i]
            if len(chosen):
                used, index = np.unique(chosen, return_inverse=True)
                triangles = index.reshape(chosen.shape)
                out[name] = Mesh(
                    self.vertices[used], self.normals[used], triangles, (name,), np.zeros(len(chosen), np.int64)
                )
        return out


def cross(a: Array, b: Array) -> Array:
    """Return cross products of vectors (N, 3); for small N many times faster than `np.cross`."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def numbered_rows(rows: Array, decimals: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number rows (N, C) in sorted order; rows that are equal after rounding to `decimals` get the same number.

    The result is that of `np.unique` along an axis, which takes ten times as long because it compares rows bytewise.

    Returns:
        (N,) number of each row; (U,) index of the first row with each number.
    """
    cells = np.rint(np.asarray(rows) * 10.0**decimals).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    key, most = np.zeros(len(cells), dtype=np.int64), 1
    for column in cells.T:
        span = int(column.max(initial=0)) + 1
        if most * span > np.iinfo(np.int64).max:
            used, key = np.unique(key, return_inverse=True)
            most = len(used)
        key, most = key * span + column, most * span
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    return number, first


def simplified(mesh: Mesh, share: float) -> Mesh:
    """Return a mesh with about a `share` of the triangles, for distant objects. Closed meshes stay closed.

    Meshes with fewer than `FEW_TRIANGLES` triangles are returned unchanged.

    Quadric error decimation (Garland and Heckbert, 1997). Edges where materials meet or the surface ends have extra
    perpendicular planes, so that they stay in place. The remaining triangles keep material and normals.
    """
    if len(mesh.triangles) < FEW_TRIANGLES:
        return mesh
    from fast_simplification import replay_simplification, simplify

    index, first = numbered_rows(mesh.vertices, 5)
    points, triangles = np.round(mesh.vertices[first], 5), index[mesh.triangles]
    kept = _proper(triangles)
    fins, apexes = _fins(points, triangles[kept], mesh.material[kept])
    corners = np.concatenate([points, apexes])
    faces = np.concatenate([triangles[kept], fins]).astype(np.int32)
    reduction = 1 - share * len(kept) / len(faces)
    *_, collapses = simplify(corners, faces, target_reduction=reduction, agg=3, return_collapses=True)
    moved, _, target = replay_simplification(corners, faces, collapses)
    after = target[triangles[kept]]
    left = _proper(after)
    kept, after = kept[left], after[left]
    normals = mesh.normals[mesh.triangles[kept]].reshape(-1, 3)
    corner, first = numbered_rows(np.column_stack([after.ravel(), normals]), 2)
    return Mesh(
        moved[after.ravel()[first]],
        normals[first],
        corner.reshape(-1, 3).astype(np.int64),
        mesh.materials,
        mesh.material[kept],
    )


def _proper(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices of the triangles with three different corners."""
    a, b, c = triangles.T
    return np.flatnonzero((a != b) & (b != c) & (c != a))


def _fins(points: Array, triangles: NDArray[np.int64], material: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
    """Return triangles perpendicular to the surface, on edges that belong to one triangle of a material; and apexes."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(np.arange(len(triangles)), 3)
    key = np.column_stack([np.sort(edges, axis=1), material[owner]])
    index, first = numbered_rows(key, 0)
    once = first[np.bincount(index) == 1]
    a, b = points[edges[once]].swapaxes(0, 1)
    corners = points[triangles[owner[once]]]
    up = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-12)
    length = np.linalg.norm(b - a, axis=1, keepdims=True)
    apex = len(points) + np.arange(len(once))
    return np.column_stack([edges[once], apex]), (a + b) / 2 + up * length


def merged(meshes: Iterable[Mesh]) -> Mesh:
    """Return one mesh with all triangles of several meshes."""
    parts = list(meshes)
    names = tuple(dict.fromkeys(name for part in parts for name in part.materials))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]),
        names,
        np.concatenate([np.array([names.index(n) for n in part.materials])[part.material] for part in parts]),
    )


def from_triangles(vertices: ArrayLike, triangles: ArrayLike, material: str) -> Mesh:
    """Return a smooth mesh of one material; normals are area-weighted means of the triangles around each vertex."""
    v = np.asarray(vertices, dtype=np.float64)
    t = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    face = cross(v[t[:, 1]] - v[t[:, 0]], v[t[:, 2]] - v[t[:, 0]])
    normals = np.zeros_like(v)
    for corner in range(3):
        np.add.at(normals, t[:, corner], face)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.tile([0.0, 0.0, 1.0], (len(v), 1)), where=length > 1e-12)
    return Mesh(v, normals, t, (material,), np.zeros(len(t), dtype=np.int64))


def grid(points: ArrayLike, cells: Sequence[Sequence[str]]) -> Mesh:
    """Return a smooth surface over a grid of points (R, C, 3) with a material name for each of its (R-1, C-1) cells.

    Its front is the side from which rows run upwards and columns to the right.
    """
    p = np.asarray(points, dtype=np.float64)
    rows, columns = p.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    smooth = from_triangles(p.reshape(-1, 3), triangles, "")
    names = tuple(dict.fromkeys(name for row in cells for name in row))
    material = np.array([[names.index(name) for name in row] for row in cells]).repeat(2)
    return Mesh(smooth.vertices, smooth.normals, triangles, names, material)


def flat(polygons: Iterable[ArrayLike], material: str) -> Mesh:
    """Return a mesh of convex planar polygons (N, 3), counter-clockwise from outside, with hard edges between them."""
    parts = []
    for polygon in polygons:
        p = np.asarray(polygon, dtype=np.float64)
        fan = [[0, i, i + 1] for i in range(1, len(p) - 1)]
        parts.append(from_triangles(p, fan, material))
    return merged(parts)


def quads(corners: ArrayLike, material: str) -> Mesh:
    """Return a mesh of planar quadrilaterals (N, 4, 3), counter-clockwise from outside, with hard edges.

    A quadrilateral with equal last two corners is a triangle.
    """
    c = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 3)
    normals = cross(c[:, 2] - c[:, 0], c[:, 3] - c[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    first = 4 * np.arange(len(c))[:, None, None]
    halves = first + np.array([[0, 1, 2], [0, 2, 3]])
    proper = np.stack([np.ones(len(c), bool), (c[:, 2] != c[:, 3]).any(axis=1)], axis=1)
    triangles = halves[proper]
    return Mesh(
        c.reshape(-1, 3), normals.repeat(4, axis=0), triangles, (material,), np.zeros(len(triangles), dtype=np.int64)
    )


def box(low: ArrayLike, high: ArrayLike, material: str) -> Mesh:
    """Return an axis-aligned box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float), np.asarray(high, float)
    faces = [
        [(x0, y0, z0), (x0, y1, z0), (x1, y1, z0), (x1, y0, z0)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
        [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
        [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
    ]
    return flat(faces, material)


def lathe(profile: ArrayLike, materials: Sequence[str], sides: int, axis: str) -> Mesh:
    """Return the surface of a profile rotated about an axis; segments that rise along the axis face outwards.

    Args:
        profile: (N, 2) positions along the axis and radii, metres.
        materials: N - 1 materials, one per segment.
        sides: Number of sides of the polygon that approximates a circle.
        axis: "y" or "z".
    """
    p = np.asarray(profile, dtype=np.float64)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    parts = []
    for (a0, r0), (a1, r1), material in zip(p, p[1:], materials, strict=False):
        along = np.array([a0, a1])[:, None] + np.zeros_like(angle)
        radius = np.array([r0, r1])[:, None]
        u, w = radius * np.cos(angle), radius * np.sin(angle)
        points = np.stack([u, w, along] if axis == "z" else [w, along, u], axis=-1)
        ring = grid(points, [[material] * sides])
        # At a pole, half of the triangles have no area.
        poles = np.arange(2 * sides) % 2 == (1 if r1 < 1e-9 else 0 if r0 < 1e-9 else 2)
        parts.append(ring.taken(~poles))
    return merged(parts)


def tube(path: ArrayLike, radii: Sequence[float], material: str, sides: int) -> Mesh:
    """Return a round pipe, open at both ends.

    Args:
        path: (N, 3) points on its centre line, metres.
        radii: Radius at each point, metres.
        material: Its material.
        sides: Number of sides of the polygon that approximates a circle.
    """
    p = np.asarray(path, dtype=np.float64)
    along = np.gradient(p, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Pipes bend so little that one direction is perpendicular to all of their segments.
    chord = p[-1] - p[0]
    side = np.cross(chord, np.eye(3)[np.abs(chord).argmin()])
    u = np.cross(side, along)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    w = np.cross(along, u)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    rings = [
        center + radius * (np.cos(angle) * a + np.sin(angle) * b)
        for center, radius, a, b in zip(p, radii, u, w, strict=True)
    ]
    return grid(np.stack(rings), [[material] * sides] * (len(p) - 1))
