"""Cuts bodies across: what lies ahead of a plane, and the wall that closes it there."""

from itertools import pairwise
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, from_triangles, merged
from skope.types import Array

_RAYS: Final = 40
"""Corners of the wall around its middle."""


def clipped(mesh: Mesh, x: float) -> Mesh:
    """The part of a mesh that lies ahead of `x`; open there."""
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
    """A wall that closes the left half of a body that was clipped at `x`."""
    edge = mesh.vertices[np.abs(mesh.vertices[:, 0] - x) < 1e-6][:, 1:]
    middle = np.array([0.0, (edge[:, 1].min() + edge[:, 1].max()) / 2])
    away = edge - middle
    turn, reach = np.arctan2(away[:, 1], away[:, 0]), np.hypot(*away.T)
    ring = [(0.0, edge[:, 1].min())]
    bounds = np.linspace(-np.pi / 2, np.pi / 2, _RAYS + 1)
    for low, high in pairwise(bounds):
        held = np.flatnonzero((turn >= low) & (turn <= high))
        if len(held):
            ring.append(tuple(edge[held[reach[held].argmax()]]))
    ring.append((0.0, edge[:, 1].max()))
    return _fan(np.array([middle, *ring]), x - 0.002, material)


def _fan(points: Array, x: float, material: str) -> Mesh:
    """Triangles around the first of the points (N, 2), y and z, that face the rear."""
    corners = np.column_stack([np.full(len(points), x), points])
    return from_triangles(corners, [[0, k + 1, k] for k in range(1, len(points) - 1)], material)
