"""Overlays for judging a camera: a grid of metres, posts, boxes of the size of cars, the horizon.

All are polylines in pixels, clipped to the camera's view.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.types import Array


@dataclass(frozen=True)
class OverlayGrid:
    """Grid, posts and cars drawn on the road."""

    steps_m: tuple[int, ...] = (1, 2, 5, 10, 20)
    """Spacings of the grid's lines, metres."""
    lines: int = 10
    """Approximate number of lines of the grid away from the camera."""
    reach_heights: float = 12.0
    """End of the grid, in heights of the camera."""
    reach_m: tuple[float, float] = (20.0, 120.0)
    """Minimum and maximum end of the grid, metres."""
    post_m: float = 3.0
    """Height of the posts, metres."""
    car_lwh: tuple[float, float, float] = (4.5, 1.8, 1.5)
    """Length, width and height of a car, metres."""
    margin: float = 0.5
    """Margin outside the image in which lines are drawn, as a share of its size."""


OVERLAY_GRID: Final = OverlayGrid()

UNIT_BOX: Final = np.array(list(itertools.product((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0))))
UNIT_BOX_EDGES: Final = tuple(
    (a, b) for a, b in itertools.combinations(range(8), 2) if int(np.sum(UNIT_BOX[a] != UNIT_BOX[b])) == 1
)

Polyline = list[list[float]]


def overlays(camera: Camera, toward: Array | None = None) -> dict[str, Any]:
    """Return polylines by kind (`grid`, `horizon`, `posts`, `boxes`), labels with their pixels, and a description.

    Args:
        camera: The camera, over a road at z = 0.
        toward: (2,) direction along the road, in the world; None: the viewing direction of the camera.
    """
    ahead, left, foot = axes(camera)
    reach = float(np.clip(OVERLAY_GRID.reach_heights * camera.position[2], *OVERLAY_GRID.reach_m))
    step = next((m for m in OVERLAY_GRID.steps_m if reach / m <= OVERLAY_GRID.lines), OVERLAY_GRID.steps_m[-1])
    along, side = np.arange(0, reach + 0.1, 0.5), np.arange(-reach / 2, reach / 2 + 0.1, 0.5)
    grid = []
    for k in np.arange(-(reach // 2 // step) * step, reach / 2 + 0.1, step).tolist():
        grid += polylines_of(camera, foot + left * k + ahead * along[:, None])
    labels = []
    for k in range(1, int(reach // step) + 1):
        grid += polylines_of(camera, foot + ahead * (k * step) + left * side[:, None])
        pixel, _, valid = camera.project(foot + ahead * (k * step))
        if valid and camera.inside(pixel):
            labels.append({"at": _rounded(pixel), "text": f"{k * step} m"})
    places, beside = _standing(camera, (0.3, 0.7)), _standing(camera, (0.12, 0.88))
    way = ahead[:2] if toward is None else toward / np.linalg.norm(toward)
    return {
        "grid": grid,
        "step_m": step,
        "labels": labels,
        "horizon": horizon_line(camera),
        "posts": [
            line
            for position in beside
            for line in polylines_of(camera, position + [[0, 0, 0], [0, 0, OVERLAY_GRID.post_m]])
        ],
        "post_m": OVERLAY_GRID.post_m,
        "boxes": [line for position in places for line in car_edges(camera, position, way)],
        "box_lwh": list(OVERLAY_GRID.car_lwh),
    }


def axes(camera: Camera) -> tuple[Array, Array, Array]:
    """Return (3,) unit vectors along the road ahead of a camera and to its left, and the position below it."""
    yaw, _, _ = camera.angles
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    return ahead, np.array([-ahead[1], ahead[0], 0.0]), np.array([*camera.position[:2], 0.0])


def horizon_line(camera: Camera) -> list[Polyline]:
    """Return the horizon of a level road as polylines."""
    ahead, left, foot = axes(camera)
    turn = np.linspace(-1.3, 1.3, 105)[:, None]
    level = [0.0, 0.0, float(camera.position[2])]
    return polylines_of(camera, foot + level + 1e6 * (np.cos(turn) * ahead + np.sin(turn) * left))


def car_edges(camera: Camera, position: Array, way: Array) -> list[Polyline]:
    """Return the visible edges of a car of `OVERLAY_GRID.car_lwh` on the road.

    Args:
        camera: The camera.
        position: (3,) middle of the car on the road, metres.
        way: (2,) unit vector of its heading.

    Returns:
        The visible parts of its edges, pixels.
    """
    turn = np.array([[way[0], -way[1], 0], [way[1], way[0], 0], [0, 0, 1]])
    corners = position + (UNIT_BOX * OVERLAY_GRID.car_lwh) @ turn.T
    return [line for a, b in UNIT_BOX_EDGES for line in polylines_of(camera, corners[[a, b]])]


def polylines_of(camera: Camera, points: Array) -> list[Polyline]:
    """Return a line through points (N, 3) as polylines in pixels, clipped behind the camera and far off the image."""
    pixels, _, valid = camera.project(points)
    size = np.array([camera.width, camera.height])
    near = valid & (np.abs(np.nan_to_num(pixels, nan=1e9) - size / 2) <= (0.5 + OVERLAY_GRID.margin) * size).all(
        axis=-1
    )
    out: list[Polyline] = []
    for inside, run in itertools.groupby(range(len(points)), key=lambda i: bool(near[i])):
        row = list(run)
        if inside and len(row) > 1:
            out.append([_rounded(pixels[i]) for i in row])
    return out


def _standing(camera: Camera, columns: tuple[float, ...]) -> list[Array]:
    """Return positions (3,) from near to far at some columns of the image, given as shares of its width."""
    rows = np.linspace(0.95, 0.3, 60) * camera.height
    out: list[Array] = []
    for share in columns:
        places = intersect_ground(camera, np.stack([np.full(60, share * camera.width), rows], axis=-1))
        away = np.linalg.norm(places - camera.position, axis=-1)
        last = 0.0
        for position, distance in zip(places, away.tolist(), strict=True):
            if np.isfinite(distance) and distance < OVERLAY_GRID.reach_m[1] and distance > max(last * 1.6, last + 6):
                out.append(position)
                last = distance
    return out


def _rounded(pixel: Array) -> list[float]:
    return [round(float(v), 1) for v in pixel]
