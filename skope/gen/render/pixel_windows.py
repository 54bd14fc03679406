"""Windows of pixels that vehicles may cover, on a canvas of three times the image's width and height."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.vehicles.model import MODEL_PARTS, Body, straight_lwh
from skope.pictures.draw import DRAWING_STYLE
from skope.types import Array

Window = tuple[int, int, int, int]
"""Columns and rows x0, y0, x1, y1 of the image; may extend beyond it."""


@dataclass(frozen=True)
class WindowLimits:
    """Margins of the windows that change in a frame."""

    clip_depth_m: float = 0.3
    """Silhouettes are clipped at this depth, metres."""
    tile_px: int = 8
    """Side of a tile, pixels. The changed parts of a frame are drawn in whole tiles."""
    outside_box_m: float = 1.0
    """Maximum distance of any part of a vehicle, such as a mirror or a sign, outside the box of its dimensions,
    metres."""
    contact_m: float = 1.8
    """Distance around a vehicle within which it hides sky from the road, metres."""


WINDOW_LIMITS: Final = WindowLimits()


def window_of(hull: Array, camera: Camera) -> Window | None:
    """Return the pixels that a vehicle with this hull may cover, within the canvas.

    None if none of them is in the image.
    """
    if not len(hull):
        return None
    width, height = camera.width, camera.height
    (left, top), (right, bottom) = hull.min(axis=0).tolist(), hull.max(axis=0).tolist()
    if left >= width or top >= height or right <= 0 or bottom <= 0:
        return None
    x0, y0 = max(math.floor(left) - 1, -width), max(math.floor(top) - 1, -height)
    x1, y1 = min(math.ceil(right) + 1, 2 * width), min(math.ceil(bottom) + 1, 2 * height)
    return x0, y0, x1, y1


def hull_of(vehicle: Body, T_world_parts: Array, camera: Camera) -> Array:
    """Return a convex polygon (N, 2) around the pixels that a vehicle may cover; may be empty.

    Args:
        vehicle: The vehicle.
        T_world_parts: (8, 4, 4) poses of its parts (see `Moment.part_poses`).
        camera: The image's camera.
    """
    return _projected_hull(_corners_world(_box_corners(vehicle), T_world_parts), camera)


def may_be_seen(vehicle: Body, T_world_parts: Array, camera: Camera) -> bool:
    """Return whether the image may show a vehicle, from its dimensions only. If not, `window_of` returns None.

    Args:
        vehicle: The body.
        T_world_parts: (8, 4, 4) poses of its parts (see `Moment.part_poses`), metres.
        camera: The image's camera.
    """
    length, width, height = vehicle.size_lwh
    half = [length / 2 + WINDOW_LIMITS.outside_box_m, width / 2 + WINDOW_LIMITS.outside_box_m]
    corners = [
        _corners_between(
            np.array([*np.negative(half), -WINDOW_LIMITS.outside_box_m]),
            np.array([*half, height + WINDOW_LIMITS.outside_box_m]),
        )
    ]
    if vehicle.trailer is not None:
        low, high = vehicle.trailer.corners
        corners.append(_corners_between(low - WINDOW_LIMITS.outside_box_m, high + WINDOW_LIMITS.outside_box_m))
    return window_of(_project(_corners_world(corners, T_world_parts), camera), camera) is not None


def shadow_hull_of(vehicle: Body, T_world_parts: Array, camera: Camera, sun_direction: Array) -> Array:
    """Return a convex polygon (N, 2) around the pixels that a vehicle may cover or shade.

    Shadows are followed for at most 25 m.

    Args:
        vehicle: The body.
        T_world_parts: (8, 4, 4) poses of its parts, metres.
        camera: The image's camera.
        sun_direction: (3,) unit vector towards the sun, world axes.
    """
    corners, height = _box_corners(vehicle), straight_lwh(vehicle)[2]
    around = [_around(box) for box in corners]
    world = _corners_world([np.concatenate(pair) for pair in zip(corners, around, strict=True)], T_world_parts)
    upper = _corners_world(corners, T_world_parts)
    length = min(height / max(sun_direction[2], 1e-3), 25.0)
    return _projected_hull(np.concatenate([world, upper - length * sun_direction]), camera)


def _around(corners: Array) -> Array:
    """Return the corners (8, 3) of the region of ground in which the contents of a box may hide sky."""
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2 * [1, 0, 0]
    return np.asarray(
        corners * [1, 1, 0] + np.sign(corners - middle) * [WINDOW_LIMITS.contact_m, WINDOW_LIMITS.contact_m, 0]
    )


def beam_corners(reach: float) -> Array:
    """Return the corners (4, 2) of the ground that lamps may light.

    `reach` is the distance ahead of the bumper, metres; negative: behind it.
    """
    return np.array([[0.0, -4.0], [reach, -14.0], [reach, 14.0], [0.0, 4.0]])


def beam_hull_of(vehicle: Body, T_world_chassis: Array, camera: Camera, reach: float) -> Array:
    """Return a convex polygon (N, 2) around the pixels of road, and of objects on it, that headlights may light.

    Args:
        vehicle: The body.
        T_world_chassis: (4, 4) its pose, metres.
        camera: The image's camera.
        reach: Reach of the lamps ahead of the front bumper, metres; negative: behind the rear bumper.
    """
    ahead = beam_corners(reach) + [np.copysign(vehicle.size_lwh[0] / 2, reach), 0]
    points = np.concatenate([np.column_stack([ahead, np.full(4, z)]) for z in (0.0, 1.5)])
    return _projected_hull(points @ T_world_chassis[:3, :3].T + T_world_chassis[:3, 3], camera)


def mirror_hull_of(vehicle: Body, T_world_parts: Array, camera: Camera, mirror: Array) -> Array:
    """Return a convex polygon (N, 2) around the pixels that a vehicle may cover in a mirror.

    Args:
        vehicle: The body.
        T_world_parts: (8, 4, 4) poses of its parts, metres.
        camera: The image's camera.
        mirror: (4, 4) the reflection, about the camera's place (see `Plane.mirror`).
    """
    world = _corners_world(_box_corners(vehicle), T_world_parts)
    return _projected_hull((world - camera.position) @ mirror[:3, :3].T + mirror[:3, 3] + camera.position, camera)


def tiles(hulls: Iterable[Array], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask (rows, columns) of the tiles that polygons touch, and some neighbours.

    `size` is the width and height of the image, pixels.
    """
    columns, rows = (-(-side // WINDOW_LIMITS.tile_px) for side in size)
    touched = np.zeros((rows, columns), dtype=np.uint8)
    for hull in hulls:
        if len(hull):
            corners = np.rint((hull / WINDOW_LIMITS.tile_px - 0.5) * 2**DRAWING_STYLE.subpixel_bits).astype(np.int32)
            cv2.fillConvexPoly(touched, corners, 1, shift=DRAWING_STYLE.subpixel_bits)
    # Filled tiles have their centre in a polygon or lie on its edge; the dilation adds their neighbours.
    return np.asarray(cv2.dilate(touched, np.ones((3, 3), dtype=np.uint8)) > 0)


def tile_runs(touched: NDArray[np.bool_], size: tuple[int, int]) -> list[Window]:
    """Return windows of the touched tiles of an image of `size` (width, height), with neighbours in a row merged."""
    edges = np.diff(np.pad(touched, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, first = np.nonzero(edges == 1)
    _, end = np.nonzero(edges == -1)
    low, high = (
        np.stack([first, rows], axis=1) * WINDOW_LIMITS.tile_px,
        np.stack([end, rows + 1], axis=1) * WINDOW_LIMITS.tile_px,
    )
    return [(x0, y0, x1, y1) for (x0, y0), (x1, y1) in zip(low.tolist(), np.minimum(high, size).tolist(), strict=True)]


def tile_mask(touched: NDArray[np.bool_], window: Window) -> NDArray[np.uint8]:
    """Return a mask (h, w): 1 for pixels in a touched tile, else 0. The window begins at the corner of a tile."""
    x0, y0, x1, y1 = window
    touched_tiles = touched[
        y0 // WINDOW_LIMITS.tile_px : -(-y1 // WINDOW_LIMITS.tile_px),
        x0 // WINDOW_LIMITS.tile_px : -(-x1 // WINDOW_LIMITS.tile_px),
    ].view(np.uint8)
    return np.asarray(
        touched_tiles.repeat(WINDOW_LIMITS.tile_px, axis=0).repeat(WINDOW_LIMITS.tile_px, axis=1)[: y1 - y0, : x1 - x0]
    )


def crossing(a: Window, b: Window) -> bool:
    """Return whether two windows share pixels."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def inside_image(window: Window, camera: Camera) -> Window:
    """Return the part of a window that lies in the image."""
    x0, y0, x1, y1 = window
    return max(x0, 0), max(y0, 0), min(x1, camera.width), min(y1, camera.height)


def union(windows: Sequence[Window]) -> Window:
    """Return the smallest window that contains all windows, at least one."""
    x0, y0, x1, y1 = zip(*windows, strict=True)
    return min(x0), min(y0), max(x1), max(y1)


def _projected_hull(points_world: Array, camera: Camera) -> Array:
    pixels = _project(points_world, camera)
    if not len(pixels):
        return np.zeros((0, 2))
    return cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(np.float64)


def _project(points_world: Array, camera: Camera) -> Array:
    """Return pixels (N, 2) around the part of the points' hull that lies before the camera."""
    p = _in_front(camera.to_camera(points_world))
    return np.asarray(p[:, :2] / p[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2])


@lru_cache(maxsize=256)
def _box_corners(vehicle: Body) -> list[Array]:
    """Return the corners (8, 3) of the boxes around a vehicle and its trailer, with mirrors and steered wheels.

    Each box is in the frame of its part.
    """
    boxes = []
    for extent in (vehicle.extent, *([vehicle.trailer.extent] if vehicle.trailer else [])):
        low, high = extent.copy()
        low[2] = -0.1
        boxes.append(_corners_between(low, high))
    return boxes


def _corners_world(corners: Sequence[Array], T_world_parts: Array) -> Array:
    """Return world points (N, 3) of a vehicle's body, and of its trailer if `corners` has two arrays."""
    poses = T_world_parts[[0, MODEL_PARTS.trailer_part]]
    return np.concatenate([p @ T[:3, :3].T + T[:3, 3] for p, T in zip(corners, poses, strict=False)])


def _corners_between(low: Array, high: Array) -> Array:
    """Return the corners (8, 3) of the box between two opposite corners."""
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T


def _in_front(corners: Array) -> Array:
    """Return points around the part beyond the near plane of the hull of `corners` (N, 3), camera frame."""
    before = corners[:, 2] >= WINDOW_LIMITS.clip_depth_m
    if before.all():
        return corners
    a, b = corners[before][:, None], corners[~before][None]
    share = (WINDOW_LIMITS.clip_depth_m - a[..., 2:]) / (b[..., 2:] - a[..., 2:])
    return np.concatenate([corners[before], (a + share * (b - a)).reshape(-1, 3)])
