"""Cut triangles along the edges of convex polygons, and cut whole bodies across.

The first is the arithmetic for panels on a shell. The second adds the wall that closes the cut.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope.gen.mesh import Mesh, from_triangles, merged
from skope.types import Array


@dataclass(frozen=True)
class CutLimits:
    """Precision of cuts through meshes."""

    wall_corners: int = 40
    """Number of corners of the wall around its middle."""
    snap_m: float = 8e-4
    """Distance from a vertex within which a cut goes through the vertex, metres."""


CUT_LIMITS: Final = CutLimits()


def clipped(mesh: Mesh, x: float) -> Mesh:
    """Return the part of a mesh ahead of `x`; open there."""
    ahead = mesh.vertices[:, 0] > x
    count = ahead[mesh.triangles].sum(axis=1)
    corners, normals, material = [], [], []
    for t in np.flatnonzero((count > 0) & (count < 3)):
        loop_v, loop_n = [], []
        index = mesh.triangles[t]
        for a, b in zip(index, np.roll(index, -1), strict=True):
            if ahead[a]:
                loop_v.append(mesh.vertices[a])
                loop_n.append(mesh.normals[a])
            if ahead[a] != ahead[b]:
                share = (x - mesh.vertices[a, 0]) / (mesh.vertices[b, 0] - mesh.vertices[a, 0])
                loop_v.append(mesh.vertices[a] + share * (mesh.vertices[b] - mesh.vertices[a]))
                loop_n.append(mesh.normals[a] + share * (mesh.normals[b] - mesh.normals[a]))
        for k in range(1, len(loop_v) - 1):
            corners += [loop_v[0], loop_v[k], loop_v[k + 1]]
            normals += [loop_n[0], loop_n[k], loop_n[k + 1]]
            material.append(mesh.material[t])
    whole = mesh.taken(count == 3)
    if not corners:
        return whole
    n = np.array(normals)
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    return merged([whole, Mesh(np.array(corners), n, triangles, mesh.materials, np.array(material))])


def rear_wall(mesh: Mesh, x: float, material: str) -> Mesh:
    """Return a wall that closes the left half of a body that was clipped at `x`."""
    edge = mesh.vertices[np.abs(mesh.vertices[:, 0] - x) < 1e-6][:, 1:]
    middle = np.array([0.0, (edge[:, 1].min() + edge[:, 1].max()) / 2])
    away = edge - middle
    turn, reach = np.arctan2(away[:, 1], away[:, 0]), np.hypot(*away.T)
    ring = [(0.0, edge[:, 1].min())]
    bounds = np.linspace(-np.pi / 2, np.pi / 2, CUT_LIMITS.wall_corners + 1)
    for low, high in pairwise(bounds):
        held = np.flatnonzero((turn >= low) & (turn <= high))
        if len(held):
            ring.append(tuple(edge[held[reach[held].argmax()]]))
    ring.append((0.0, edge[:, 1].max()))
    return _wall_fan(np.array([middle, *ring]), x - 0.002, material)


def _wall_fan(points: Array, x: float, material: str) -> Mesh:
    """Return triangles around the first of the points (N, 2), y and z, that face the rear."""
    corners = np.column_stack([np.full(len(points), x), points])
    return from_triangles(corners, [[0, k + 1, k] for k in range(1, len(points) - 1)], material)


Indices = NDArray[np.int64]

NORMAL_COLUMNS: Final = slice(3, 6)
"""Columns of a vertex that are a direction, which is normalised again between two vertices."""
TRIANGLE_EDGES: Final = np.array([[0, 1], [1, 2], [2, 0]])
"""The two corners of each of a triangle's edges."""
_SPLIT_TRIANGLES: Final = {
    1: np.array([(0, 3, 2), (3, 1, 2)]),
    2: np.array([(3, 1, 4), (0, 3, 4), (0, 4, 2)]),
    3: np.array([(0, 3, 5), (3, 1, 4), (4, 2, 5), (3, 4, 5)]),
}
"""Triangles that replace a split triangle, by its number of split edges. 0-2 are its corners, 3-5 the middles of its
edges."""


@dataclass(frozen=True, eq=False)
class ConvexPolygon:
    """Convex polygon of E edges in a projection of vertices, counter-clockwise."""

    low: Array
    """(2,) minimum corner of the box around it."""
    high: Array
    """(2,) maximum corner of the box around it."""
    starts: Array
    """(E, 2) a point on each edge."""
    normals: Array
    """(E, 2) unit normals of the edges, inwards."""

    @classmethod
    def of(cls, corners: ArrayLike) -> "ConvexPolygon":
        """Return the polygon of corners (N, 2) in either direction; edges without length are left out."""
        p = np.asarray(corners, dtype=np.float64)
        if (p[:, 0] * np.roll(p[:, 1], -1) - np.roll(p[:, 0], -1) * p[:, 1]).sum() < 0:
            p = p[::-1]
        edge = np.roll(p, -1, axis=0) - p
        across = np.stack([-edge[:, 1], edge[:, 0]], axis=-1)
        length = np.linalg.norm(across, axis=1)
        proper = length > 1e-9
        return cls(p.min(axis=0), p.max(axis=0), p[proper], across[proper] / length[proper, None])


@dataclass(frozen=True, eq=False)
class CutTriangles:
    """Triangles after a cut, with their vertices."""

    vertices: Array
    """(V', C) the original vertices, then those added on edges."""
    triangles: Indices
    """(T', 3) indices of vertices."""
    parent: Indices
    """(T',) the original triangle that each triangle is part of."""
    inside: NDArray[np.bool_]
    """(T',) whether each triangle lies in the polygon."""


def cut(
    vertices: Array,
    triangles: Indices,
    inside: NDArray[np.bool_],
    polygon: ConvexPolygon,
    projection: tuple[int, int],
    *,
    keep_outside: bool,
) -> CutTriangles:
    """Split triangles along a polygon's edges.

    Args:
        vertices: (V, C); columns 3 to 5 are a normal.
        triangles: (T, 3) indices of vertices.
        inside: (T,) mask of the triangles to cut; others are split only if they share an edge with these.
        polygon: The polygon that cuts.
        projection: Columns of `vertices` in which the polygon is given.
        keep_outside: Whether triangles outside the polygon are kept.
    """
    parent = np.arange(len(triangles))
    offsets = (polygon.starts * polygon.normals).sum(axis=1)
    for start, normal in zip(polygon.starts, polygon.normals, strict=True):
        # Triangles that are completely outside one edge need no cuts by the other edges.
        inside[inside] = _reach_inside(vertices, triangles[inside], polygon.normals, offsets, projection)
        if not keep_outside:
            triangles, parent, inside = triangles[inside], parent[inside], inside[inside]
        value = _heights(vertices, projection, start, normal)
        before = len(vertices)
        vertices, triangles, origin = _split_edges(vertices, triangles, inside, value)
        value = np.concatenate([value, _heights(vertices[before:], projection, start, normal)])
        a, b, c = value[triangles].T
        parent, inside = parent[origin], inside[origin] & (a + b + c > 0)
        if not inside.any():
            break
    return CutTriangles(vertices, triangles, parent, inside)


def _reach_inside(
    vertices: Array, triangles: Indices, normals: Array, offsets: Array, projection: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return whether triangles have a corner on the inner side of every edge, (T,)."""
    u, v = (vertices[:, column][triangles] for column in projection)
    out = np.ones(len(triangles), dtype=bool)
    for (nu, nv), offset in zip(normals.tolist(), offsets.tolist(), strict=True):
        out &= (u * nu + v * nv - offset > CUT_LIMITS.snap_m).any(axis=1)
    return out


def _heights(vertices: Array, projection: tuple[int, int], start: Array, normal: Array) -> Array:
    """Return the distances (V,) of vertices from an edge, inwards; 0 for vertices that a cut goes through."""
    u, v = projection
    value: Array = (vertices[:, u] - start[0]) * normal[0] + (vertices[:, v] - start[1]) * normal[1]
    value[np.abs(value) < CUT_LIMITS.snap_m] = 0
    return value


def _split_edges(
    vertices: Array, triangles: Indices, inside: NDArray[np.bool_], value: Array
) -> tuple[Array, Indices, Indices]:
    """Split edges of triangles `inside` at which the sign of `value` (V,) changes.

    Returns:
        The vertices with new ones at the end, the new triangles, and the original triangle of each.
    """
    at_corners = value[triangles]
    crossing = inside[:, None] & (at_corners * at_corners[:, [1, 2, 0]] < 0)
    if not crossing.any():
        return vertices, triangles, np.arange(len(triangles))
    base, after = len(vertices), triangles[:, [1, 2, 0]]
    key = np.minimum(triangles, after) * base + np.maximum(triangles, after)
    keys = np.sort(key[crossing])
    keys = keys[np.append(True, keys[1:] != keys[:-1])]
    a, b = np.divmod(keys, base)
    share = (value[a] / (value[a] - value[b]))[:, None]
    new = vertices[a] + (vertices[b] - vertices[a]) * share
    new[:, NORMAL_COLUMNS] /= np.maximum(np.linalg.norm(new[:, NORMAL_COLUMNS], axis=1, keepdims=True), 1e-9)
    found = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
    hit = keys[found] == key
    middle = base + found
    count = hit.sum(axis=1)
    whole = np.flatnonzero(count == 0)
    out, origin = [triangles[whole]], [whole]
    for splits, parts in _SPLIT_TRIANGLES.items():
        at = np.flatnonzero(count == splits)
        if not len(at):
            continue
        # Rotated so that the first edge is the split one, or the last edge the one that is not split.
        is_split = hit[at]
        start = {1: is_split.argmax(axis=1), 2: (~is_split).argmax(axis=1) + 1, 3: 0 * at}[splits]
        turn = (start[:, None] + np.arange(3)) % 3
        corners = np.concatenate([triangles[at[:, None], turn], middle[at[:, None], turn]], axis=1)
        out.append(corners[:, parts].swapaxes(0, 1).reshape(-1, 3))
        origin += [at] * len(parts)
    return np.concatenate([vertices, new]), np.concatenate(out), np.concatenate(origin)
