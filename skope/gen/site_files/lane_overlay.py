"""A network's lanes drawn over what a site's camera sees: whether they belong together shows at a glance."""

from typing import Final

import cv2
import numpy as np

from skope.gen.towns.road_graph import RoadGraph, driven
from skope.gen.towns.town import Town
from skope.gen.towns.user_road import OwnRoad
from skope.pictures.draw import SUBPIXEL_BITS
from skope.types import Array, Pixels

_DRAWN_WITHIN_M: Final = 200.0
"""Distance up to which lanes are drawn, metres."""
_SAMPLE_M: Final = 1.0
_ARROWS: Final = 15.0
"""Metres from arrow to arrow."""
_LANE_COLORS, _ARROW, _OCCLUDER, _SHADE = (255, 200, 40), (60, 220, 255), (255, 60, 160), (80, 80, 255)
_GREY: Final = 90


def draw_lanes(road: OwnRoad) -> Pixels:
    """(H, W, 3) RGB: the photograph, or grey, with both edges of each lane, arrows along it, occluders and shades."""
    camera, graph = road.camera, RoadGraph.of(Town.of(road))
    size = (camera.width, camera.height)
    image = road.picture(size) if road.photograph else np.full((size[1], size[0], 3), _GREY, dtype=np.uint8)
    for edge in graph.edges:
        for lane in driven(edge):
            middle, across = _along(np.array(lane.getShape3D()))
            for side in (-0.5, 0.5):
                _draw(image, road, graph, middle + side * lane.getWidth() * across, _LANE_COLORS)
            for k in range(3, len(middle), int(_ARROWS / _SAMPLE_M)):
                barbs = middle[[k - 3, k, k - 3]] + np.array([[0.5], [0.0], [-0.5]]) * across[k]
                _draw(image, road, graph, barbs, _ARROW)
    outlines = [*((one.polygon, _OCCLUDER) for one in road.occluders), *((one, _SHADE) for one in road.shades)]
    for outline, color in outlines:
        corners = np.rint((np.array(outline) - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.polylines(image, [corners], True, color, 1, cv2.LINE_AA, SUBPIXEL_BITS)
    return image


def _along(line: Array) -> tuple[Array, Array]:
    """(N, 3) places along a line and unit vectors to its left."""
    marks = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    at = np.linspace(0.0, marks[-1], max(2, round(marks[-1] / _SAMPLE_M)))
    middle = np.column_stack([np.interp(at, marks, column) for column in line.T])
    ahead = np.gradient(middle[:, :2], axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))])
    return middle, left / np.hypot(*ahead.T)[:, None].clip(1e-9)


def _draw(image: Pixels, road: OwnRoad, graph: RoadGraph, line: Array, color: tuple[int, int, int]) -> None:
    """A line (N, 3) of the graph where it is before the camera."""
    pixels, depth, valid = road.camera.project(graph.world(line))
    near = valid & (depth < _DRAWN_WITHIN_M) & (np.abs(np.nan_to_num(pixels)) < 1e4).all(axis=-1)
    at = np.rint((np.where(near[:, None], pixels, 0.0) - 0.5) * 2**SUBPIXEL_BITS).astype(int).tolist()
    for k in np.flatnonzero(near[:-1] & near[1:]):
        cv2.line(image, at[k], at[k + 1], color, 2, cv2.LINE_AA, SUBPIXEL_BITS)
