"""The camera's own rays to points, against the triangles of a moment's vehicles. Pure numpy."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from skope.camera import Camera
from skope.gen.recording import Moment
from skope.gen.vehicles import Vehicle

Array = NDArray[np.float64]


class Sight:
    """What of a moment's N vehicles a ray from the camera meets first."""

    def __init__(self, moment: Moment, vehicles: Sequence[Vehicle], camera: Camera) -> None:
        self._moment, self._vehicles, self._camera = moment, vehicles, camera
        self._edges: dict[int, tuple[Array, Array, Array, Array]] = {}

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
        up = np.array([[0, 0, vehicle.shape.height / 2] for vehicle in self._vehicles]).reshape(-1, 3)
        T = self._moment.T_world_chassis
        return self._camera.to_camera(np.einsum("nij,nj->ni", T[:, :3, :3], up) + T[:, :3, 3])

    def _hits(self, i: int, rays: Array) -> Array:
        if i not in self._edges:
            self._edges[i] = self._normals(i)
        ab, bc, ca, volume = self._edges[i]
        # A ray from the origin passes inside a triangle when it is on the same side of the planes through the origin
        # and each edge; the three products add up to that with the triangle's own normal.
        sides = [rays @ edge.T for edge in (ab, bc, ca)]
        inside = ((sides[0] >= 0) & (sides[1] >= 0) & (sides[2] >= 0)) | (
            (sides[0] <= 0) & (sides[1] <= 0) & (sides[2] <= 0)
        )
        facing = sides[0] + sides[1] + sides[2]
        crosses = inside & (np.abs(facing) > 1e-12)
        metres = np.divide(volume, facing, out=np.full(facing.shape, np.inf), where=crosses)
        return np.asarray(np.where(metres > 0, metres, np.inf).min(axis=1))

    def _normals(self, i: int) -> tuple[Array, Array, Array, Array]:
        """Of the planes through the camera and each edge of a vehicle's T triangles, (T, 3) each; and (T,) volumes."""
        vehicle, moment = self._vehicles[i], self._moment
        right, left = vehicle.wheel.mirrored(), vehicle.wheel
        parts = zip(
            (vehicle.mesh, right, left, right, left),
            (moment.T_world_chassis[i], *moment.T_world_wheels[i]),
            strict=True,
        )
        placed = [self._camera.to_camera(mesh.vertices @ T[:3, :3].T + T[:3, 3])[mesh.triangles] for mesh, T in parts]
        a, b, c = np.concatenate(placed).swapaxes(0, 1)
        ab, bc, ca = np.cross(a, b), np.cross(b, c), np.cross(c, a)
        return ab, bc, ca, np.asarray((a * (ab + bc + ca)).sum(axis=-1))
