"""Ray casting against triangles, written independently of any renderer: what labels and depth are held against."""

import numpy as np
from numpy.typing import NDArray

from skope.gen.scene.recording import Moment, body_of

Array = NDArray[np.float64]


def cast(origins: Array, directions: Array, triangles: Array) -> tuple[Array, NDArray[np.int64]]:
    """First hits of N rays with T triangles (T, 3, 3): parameter along the direction (inf: none) and triangle index.

    Moeller and Trumbore's test, one ray at a time.
    """
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    hits, which = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for i, (origin, direction) in enumerate(zip(np.broadcast_to(origins, directions.shape), directions, strict=True)):
        p = np.cross(direction, ac)
        det = (ab * p).sum(1)
        crosses = np.abs(det) > 1e-14
        inverse = np.divide(1, det, out=np.zeros_like(det), where=crosses)
        s = origin - a
        u = (s * p).sum(1) * inverse
        q = np.cross(s, ab)
        v = (q @ direction) * inverse
        t = (ac * q).sum(1) * inverse
        ok = crosses & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-6)
        if ok.any():
            t = np.where(ok, t, np.inf)
            hits[i], which[i] = t.min(), int(t.argmin())
    return hits, which


def vehicle_triangles(moment: Moment, i: int) -> Array:
    """(T, 3, 3) world triangles of the i-th vehicle with its wheels."""
    body = body_of(moment.vehicles[i])
    poses = [moment.T_world_chassis[i], *moment.T_world_wheels[i], *moment.T_world_trailer[i]]
    parts = zip(body.parts, poses[: len(body.parts)], strict=True)
    return np.concatenate([(m.vertices @ T[:3, :3].T + T[:3, 3])[m.triangles] for m, T in parts])


def distance_to_triangles(point: Array, triangles: Array) -> float:
    """Distance from a point to the nearest of T triangles, by the plane inside and by the edges outside."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    flat = length > 1e-12
    n = normal[flat] / length[flat, None]
    height = ((point - a[flat]) * n).sum(1)
    foot = point - height[:, None] * n
    inside = np.ones(len(foot), dtype=bool)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(q[flat] - p[flat], foot - p[flat]) * n).sum(1) >= -1e-12
    best = float(np.abs(height[inside]).min()) if inside.any() else np.inf
    for p, q in ((a, b), (b, c), (c, a)):
        edge = q - p
        share = np.clip(((point - p) * edge).sum(1) / np.maximum((edge * edge).sum(1), 1e-18), 0, 1)
        best = min(best, float(np.linalg.norm(p + share[:, None] * edge - point, axis=1).min()))
    return best
