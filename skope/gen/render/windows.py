"""Which pixels a vehicle may cover, on a canvas of three times the image's width and height."""

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.camera import Camera
from skope.gen.vehicles import Vehicle

Array = NDArray[np.float64]
Window = tuple[int, int, int, int]
"""Columns and rows x0, y0, x1, y1 of the image; may go beyond it."""

NEAR: Final = 0.3
"""Silhouettes are clipped at this depth, metres."""
_PAIRS: Final = [(i, j) for i in range(8) for j in range(i + 1, 8)]


def window_of(vehicle: Vehicle, T_world_chassis: Array, camera: Camera) -> Window | None:
    """Pixels that a vehicle may cover, within the canvas; None when none of them is in the image."""
    T = camera.T_camera_world @ T_world_chassis
    p = _in_front(_corners(vehicle) @ T[:3, :3].T + T[:3, 3])
    pixels = p[:, :2] / p[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    size = np.array([camera.width, camera.height])
    low, high = pixels.min(axis=0, initial=np.inf), pixels.max(axis=0, initial=-np.inf)
    if (low >= size).any() or (high <= 0).any():
        return None
    x0, y0 = np.maximum(np.floor(low) - 1, -size).astype(int).tolist()
    x1, y1 = np.minimum(np.ceil(high) + 1, 2 * size).astype(int).tolist()
    return x0, y0, x1, y1


@cache
def _corners(vehicle: Vehicle) -> Array:
    """(8, 3) corners of the box around a vehicle with its mirrors and steered wheels, a hand's breadth wider."""
    points = np.concatenate([vehicle.mesh.vertices, vehicle.shape.wheel_centers()])
    low, high = points.min(axis=0) - 0.1, points.max(axis=0) + 0.1
    low[2] = -0.1
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T


def _in_front(corners: Array) -> Array:
    """Corners (8, 3) in the camera frame -> corners of the part of their hull that lies beyond the near plane."""
    z = corners[:, 2]
    cut = []
    for i, j in _PAIRS:
        if (z[i] < NEAR) != (z[j] < NEAR):
            share = (NEAR - z[i]) / (z[j] - z[i])
            cut.append(corners[i] + share * (corners[j] - corners[i]))
    return np.concatenate([corners[z >= NEAR], np.array(cut).reshape(-1, 3)])
