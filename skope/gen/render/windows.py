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
TILE: Final = 32
"""Pixels; what changes in a frame is drawn in whole tiles."""
CONTACT: Final = 1.1
"""How far around itself a vehicle takes sky from the road, metres."""


def window_of(vehicle: Vehicle, T_world_chassis: Array, camera: Camera) -> Window | None:
    """Pixels that a vehicle may cover, within the canvas; None when none of them is in the image."""
    return _bounds(_corners(vehicle) @ T_world_chassis[:3, :3].T + T_world_chassis[:3, 3], camera, canvas=1)


def window_with_shadow(vehicle: Vehicle, T_world_chassis: Array, camera: Camera, sun_direction: Array) -> Window | None:
    """Pixels of the image that a vehicle, its shadow or the sky that it takes from the road may touch.

    Shadows are followed for 25 m at most. None when they are all outside the image.
    """
    corners = _corners(vehicle)
    around = corners * [1, 1, 0] + np.sign(corners) * [CONTACT, CONTACT, 0]
    world = np.concatenate([corners, around]) @ T_world_chassis[:3, :3].T + T_world_chassis[:3, 3]
    length = min(vehicle.shape.height / max(sun_direction[2], 1e-3), 25.0)
    return _bounds(np.concatenate([world, world[:8] - length * sun_direction]), camera, canvas=0)


def runs(windows: list[Window], size: tuple[int, int]) -> list[Window]:
    """The image's tiles that windows touch, neighbours in a row put together."""
    width, height = size
    touched = np.zeros((-(-height // TILE), -(-width // TILE) + 1), dtype=bool)
    for x0, y0, x1, y1 in windows:
        if x0 < x1 and y0 < y1:
            touched[
                max(y0, 0) // TILE : -(-min(y1, height) // TILE), max(x0, 0) // TILE : -(-min(x1, width) // TILE)
            ] = True
    out = []
    for row, line in enumerate(touched):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
        for first, last in edges.reshape(-1, 2):
            y = row * TILE
            out.append((int(first) * TILE, y, min(int(last) * TILE, width), min(y + TILE, height)))
    return out


def _bounds(points_world: Array, camera: Camera, canvas: int) -> Window | None:
    """Pixels around what of the points' hull lies before the camera; `canvas` image sizes are added on each side."""
    p = _in_front(camera.to_camera(points_world))
    pixels = p[:, :2] / p[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    size = np.array([camera.width, camera.height])
    low, high = pixels.min(axis=0, initial=np.inf), pixels.max(axis=0, initial=-np.inf)
    if (low >= size).any() or (high <= 0).any():
        return None
    x0, y0 = np.maximum(np.floor(low) - 1, -canvas * size).astype(int).tolist()
    x1, y1 = np.minimum(np.ceil(high) + 1, (1 + canvas) * size).astype(int).tolist()
    return x0, y0, x1, y1


@cache
def _corners(vehicle: Vehicle) -> Array:
    """(8, 3) corners of the box around a vehicle with its mirrors and steered wheels, a hand's breadth wider."""
    points = np.concatenate([vehicle.mesh.vertices, vehicle.shape.wheel_centers()])
    low, high = points.min(axis=0) - 0.1, points.max(axis=0) + 0.1
    low[2] = -0.1
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T


def _in_front(corners: Array) -> Array:
    """Points (N, 3) in the camera frame -> points whose hull is the part of theirs that lies beyond the near plane."""
    before = corners[:, 2] >= NEAR
    a, b = corners[before][:, None], corners[~before][None]
    share = (NEAR - a[..., 2:]) / (b[..., 2:] - a[..., 2:])
    return np.concatenate([corners[before], (a + share * (b - a)).reshape(-1, 3)])
