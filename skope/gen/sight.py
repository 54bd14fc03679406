"""The camera's own rays to points, against the triangles of a moment's vehicles. Pure numpy."""

from collections.abc import Sequence
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from skope.camera import Camera
from skope.gen.recording import Moment
from skope.gen.vehicles.model import Body

Array = NDArray[np.float64]


class Sight:
    """What of a moment's N vehicles a ray from the camera meets first."""

    def __init__(self, moment: Moment, vehicles: Sequence[Body], camera: Camera) -> None:
        self._moment, self._vehicles, self._camera = moment, vehicles, camera
        self._placed: dict[int, Array] = {}

    def first_hits(self, points: Array) -> Array:
        """World points (R, 3) -> (R,) metres from the camera to what its rays to them meet first; inf where nothing."""
        ahead = self._camera.to_camera(points)
        rays = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
        along = rays @ self._centers.T
        across = np.linalg.norm(self._centers - along[..., None] * rays[:, None], axis=-1)
        near = (along > -self._radii) & (across < self._radii)
        hits = np.full(len(points), np.inf)
        for i in np.flatnonzero(near.any(axis=0)):
            chosen = near[:, i]
            hits[chosen] = np.minimum(hits[chosen], self._hits(int(i), rays[chosen]))
        return hits

    @cached_property
    def _radii(self) -> Array:
        """(N,) of spheres around the vehicles, wheels and mirrors included."""
        return np.array([0.5 * np.linalg.norm(vehicle.size_lwh) + 0.4 for vehicle in self._vehicles])

    @cached_property
    def _centers(self) -> Array:
        """(N, 3) their centres in the camera frame."""
        up = np.array([[0, 0, vehicle.size_lwh[2] / 2] for vehicle in self._vehicles]).reshape(-1, 3)
        T = self._moment.T_world_chassis
        return self._camera.to_camera(np.einsum("nij,nj->ni", T[:, :3, :3], up) + T[:, :3, 3])

    def _hits(self, i: int, rays: Array) -> Array:
        triangles = _triangles(self._vehicles[i])
        if i not in self._placed:
            self._placed[i] = self._place(i)
        vertices = self._placed[i]
        if vertices[:, 2].min() > 1e-3:
            triangles = triangles[_around(vertices, triangles, rays)]
        return Fan(vertices[triangles]).first_hits(rays)[0] if len(triangles) else np.full(len(rays), np.inf)

    def _place(self, i: int) -> Array:
        """(V, 3) a vehicle's vertices in the camera frame, body first."""
        vehicle, moment, camera = self._vehicles[i], self._moment, self._camera
        poses = camera.T_camera_world @ np.concatenate([moment.T_world_chassis[i][None], moment.T_world_wheels[i]])
        parts = zip(vehicle.parts, poses, strict=True)
        return np.concatenate([mesh.vertices @ T[:3, :3].T + T[:3, 3] for mesh, T in parts])


@lru_cache(maxsize=256)
def _triangles(vehicle: Body) -> NDArray[np.int64]:
    """(T, 3) of a vehicle's parts, into the vertices of all of them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in vehicle.parts)])
    return np.concatenate([part.triangles + start for part, start in zip(vehicle.parts, starts, strict=False)])


def _around(vertices: Array, triangles: NDArray[np.int64], rays: Array) -> NDArray[np.bool_]:
    """(T,) which triangles, all before the camera, have any of the rays (R, 3) in the box around them."""
    places = (vertices[:, :2] / vertices[:, 2:]).astype(np.float32)
    a, b, c = (places[triangles[:, k]] for k in range(3))
    # Single precision is enough for boxes that are a little too large.
    low, high = np.minimum(np.minimum(a, b), c) - 1e-6, np.maximum(np.maximum(a, b), c) + 1e-6
    out = np.zeros(len(triangles), dtype=bool)
    for u, v in (rays[:, :2] / rays[:, 2:]).astype(np.float32):
        out |= (low[:, 0] <= u) & (high[:, 0] >= u) & (low[:, 1] <= v) & (high[:, 1] >= v)
    return out


class Fan:
    """Triangles (T, 3, 3) as seen from the origin."""

    def __init__(self, triangles: Array) -> None:
        a, b, c = triangles.swapaxes(0, 1)
        self._edges = np.cross(a, b), np.cross(b, c), np.cross(c, a)
        """Normals of the planes through the origin and each edge, (T, 3) each; their sum is the triangle's own."""
        self._volume = (a * sum(self._edges)).sum(axis=-1)

    def first_hits(self, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Rays (R, 3) from the origin -> how far they get, in their own lengths, and whether they meet a front there.

        inf and False where they meet nothing. Fronts are counter-clockwise.
        """
        # A ray passes inside a triangle when it is on the same side of all three planes.
        sides = [rays @ edge.T for edge in self._edges]
        inside = ((sides[0] >= 0) & (sides[1] >= 0) & (sides[2] >= 0)) | (
            (sides[0] <= 0) & (sides[1] <= 0) & (sides[2] <= 0)
        )
        facing = sides[0] + sides[1] + sides[2]
        crosses = inside & (np.abs(facing) > 1e-12)
        reach = np.divide(self._volume, facing, out=np.full(facing.shape, np.inf), where=crosses)
        reach[reach <= 0] = np.inf
        first = reach.argmin(axis=1)
        row = np.arange(len(rays))
        return reach[row, first], np.isfinite(reach[row, first]) & (facing[row, first] < 0)
