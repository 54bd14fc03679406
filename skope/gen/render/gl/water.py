"""The plane of the road, in which wet ground mirrors what stands on it."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.types import Array

_NEAR_ROAD: Final = 45.0
"""Depth up to which the plane is fitted to the ground, metres."""
_LEVEL_NORMAL_Z: Final = 0.97
"""Least z of the normal of what is taken for ground."""


@dataclass(frozen=True, eq=False)
class Plane:
    normal: Array
    """(3,) unit normal, upwards."""
    distance: float
    """Height of the camera over the plane, metres."""

    @property
    def uniform(self) -> Array:
        return np.array([*self.normal, self.distance])

    @property
    def mirror(self) -> Array:
        """(4, 4) reflection in it, in world axes relative to the camera."""
        out = np.eye(4)
        out[:3, :3] -= 2 * np.outer(self.normal, self.normal)
        out[:3, 3] = -2 * self.distance * self.normal
        return out


def plane_of(camera: Camera, depth: NDArray[np.float32], slope: NDArray[np.float32]) -> Plane:
    """The plane nearest to the level ground in view; below the camera when there is none.

    `depth` (H, W) is +inf for sky; `slope` (H, W, 2) its change per pixel.
    """
    step = max(1, camera.width // 160)
    z, dz = depth[::step, ::step].astype(np.float64), slope[::step, ::step].astype(np.float64)
    rows, columns = np.mgrid[: depth.shape[0] : step, : depth.shape[1] : step]
    rays, _ = camera.rays(np.stack([columns, rows], axis=-1) + 0.5)
    near = z < _NEAR_ROAD
    rays, z, dz = rays[near], z[near], dz[near]
    focal = camera.K[[0, 1], [0, 1]]
    right = rays * dz[:, :1] + z[:, None] * np.array([1 / focal[0], 0, 0])
    down = rays * dz[:, 1:] + z[:, None] * np.array([0, 1 / focal[1], 0])
    R = camera.T_camera_world[:3, :3]
    normals = np.cross(down, right) @ R
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = (rays * z[:, None] @ R)[np.abs(normals[:, 2]) > _LEVEL_NORMAL_Z]
    if len(points) < 30:
        return Plane(np.array([0.0, 0.0, 1.0]), float(camera.position[2]))
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    kept = np.abs(points[:, 2] - np.median(points[:, 2])) < 3.0
    for _ in range(4):
        solution = np.linalg.lstsq(design[kept], points[kept, 2], rcond=None)[0]
        off = np.abs(design @ solution - points[:, 2])
        kept = off < max(0.1, float(np.quantile(off[kept], 0.8)))
    normal = np.array([-solution[0], -solution[1], 1.0])
    length = float(np.linalg.norm(normal))
    return Plane(normal / length, float(-solution[2] / length))


def uniforms_of(plane: Plane) -> dict[str, Any]:
    return {"u_plane": plane.uniform}
