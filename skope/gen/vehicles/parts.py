"""Small parts that stand out from a body's left side: mirrors, handles, rails, arch lips."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope.gen.mesh import Mesh, box, from_triangles, grid, lathe, merged

Array = NDArray[np.float64]


def block(low: ArrayLike, high: ArrayLike, material: str, bevel: float) -> Mesh:
    """A box with rounded vertical and horizontal edges: a superellipsoid's coarse cousin."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    center, half = (a + b) / 2, (b - a) / 2
    share = np.minimum(bevel / half, 0.99)
    turn, rise = np.linspace(0, 2 * np.pi, 9), np.linspace(-np.pi / 2, np.pi / 2, 5)
    turn = turn + np.pi / 8
    c, s = np.cos(turn)[None], np.sin(turn)[None]
    flat, up = np.cos(rise)[:, None], np.sin(rise)[:, None]
    unit = np.stack(np.broadcast_arrays(flat * c, flat * s, up), axis=-1)
    # Corners of a sphere's octants, pushed apart: flat faces lie between.
    points = center + np.sign(np.round(unit, 9)) * half * (1 - share) + unit * half * share
    return grid(points, [[material] * 8] * 4)


def mirror(base: tuple[float, float, float], tall: bool) -> tuple[Mesh, Array]:
    """A door mirror on its foot beside the windscreen's corner, and its outer tip."""
    size = np.array([0.09, 0.11, 0.16]) if tall else np.array([0.085, 0.115, 0.075])
    x, y, z = base
    center = np.array([x - 0.02, y + 0.115, z + (0.1 if tall else 0.06)])
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    profile = np.stack([np.sin(angle), np.abs(np.cos(angle)) ** 0.62], axis=-1)
    shell = lathe(profile, ["paint" if not tall else "trim"] * 8, 12, "y")
    vertices = shell.vertices * size
    vertices[:, 0] = np.maximum(vertices[:, 0], -0.55 * size[0])
    normals = shell.normals / size
    normals[vertices[:, 0] <= -0.549 * size[0]] = [-1, 0, 0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    housing = Mesh(vertices + center, normals, shell.triangles, shell.materials, shell.material)
    pane = 0.74 * size
    behind = -0.55 * size[0] - 0.002
    turn = np.linspace(0, 2 * np.pi, 13)[:-1]
    ring = np.stack([0 * turn + behind, pane[1] * np.cos(turn), pane[2] * np.sin(turn)], axis=-1)
    fan = [[0, i + 1, i] for i in range(1, 11)]
    glass = from_triangles(ring + center, fan, "glass_mirror")
    foot = box((x - 0.04, y - 0.06, z), (x + 0.02, y + 0.09, z + 0.035), "trim")
    tip = center + np.array([0, size[1], 0])
    return merged([housing, glass, foot]), tip


def handle(at: tuple[float, float, float]) -> Mesh:
    """A door handle."""
    x, y, z = at
    return block((x - 0.095, y - 0.01, z - 0.014), (x + 0.095, y + 0.03, z + 0.016), "paint", 0.014)


def rail(path: Array) -> Mesh:
    """A roof rail along points (N, 3), with feet at its ends."""
    low, high = path + np.array([0, 0, 0.022]), path + np.array([0, 0, 0.046])
    a, b = np.array([0, 0.018, 0]), np.array([0, -0.018, 0])
    # Around the bar, counter-clockwise seen from the rear.
    ring = np.stack([low + b, high + b, high + a, low + a, low + b])
    bar = grid(ring, [["rail"] * (len(path) - 1)] * 4)
    feet = [
        box(path[i] + [-0.05, -0.017, -0.05], path[i] + [0.05, 0.017, 0.045], "rail") for i in (0, len(path) // 2, -1)
    ]
    return merged([bar, *feet])


def arch_lip(edges: Array, center: tuple[float, float], material: str) -> Mesh:
    """A rolled lip along a wheel arch's edges (N, 2, 3) around the axle at x, z."""
    axle = np.array([center[0], 0.0, center[1]])
    outward = (edges - axle) * [1, 0, 1]
    outward[..., 2] = np.maximum(outward[..., 2], 0)
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    outer = edges + 0.034 * outward + [0, -0.004, 0]
    crest = edges + 0.012 * outward + [0, 0.011, 0]
    inner = edges + np.array([0, -0.05, 0])
    corners = []
    for near, far, out in ((outer, crest, outward * 0.2 + [0, 1, 0]), (crest, inner, -outward)):
        quad = np.stack([near[:, 0], near[:, 1], far[:, 1], far[:, 0]], axis=1)
        normal = np.cross(quad[:, 2] - quad[:, 0], quad[:, 3] - quad[:, 1])
        wrong = (normal * out.mean(axis=1)).sum(axis=1) < 0
        corners.append(np.where(wrong[:, None, None], quad[:, ::-1], quad))
    c = np.concatenate(corners)
    t = np.concatenate([c[:, [0, 1, 2]], c[:, [0, 2, 3]]]).reshape(-1, 3)
    unique, index = np.unique(np.round(t, 6), axis=0, return_inverse=True)
    return from_triangles(unique, index.reshape(-1, 3), material)
