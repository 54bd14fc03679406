"""Tiles for what is too small in the whole image: overlapping parts of it go through the network unscaled too.

The idea is that of slicing-aided inference (Akyon et al., 2022).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.ops import batched_nms, nms

from skope import boxes
from skope.detections import Detections, RoadUserDetections


@dataclass(frozen=True)
class TileLimits:
    """When an image is cut into tiles, and how their detections are merged."""

    worth_factor: float = 1.25
    """Factor over the size inside the network from which an image is cut into tiles."""
    overlap: float = 0.15
    """Least overlap of neighbours, as a share of their sides."""
    edge_px: float = 3.0
    """A box that ends this close to an edge of its tile is cut by the tile, pixels."""
    same_iou: float = 0.5
    """IoU above which boxes are of one vehicle, as inside the network."""
    inside_share: float = 0.7
    """A box with this share inside a vehicle that its tile cuts is a part of it."""


TILE_LIMITS: Final = TileLimits()


_Scored: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]]
"""(N, 4) boxes xyxy, pixels, and their (N,) scores."""


@dataclass(frozen=True)
class Tile:
    """A part of an image, pixels."""

    x: int
    y: int
    width: int
    height: int

    def of(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The part of (H, W, 3) pixels."""
        return image[self.y : self.y + self.height, self.x : self.x + self.width]


def tiles_of(width: int, height: int, *, short: int, long: int) -> list[Tile]:
    """Tiles that cover an image and overlap; none where the image enters the network nearly unscaled.

    Args:
        width: Of the image, pixels.
        height: Of the image, pixels.
        short: Short side of images inside the network, pixels.
        long: Most that their long side has there, pixels.
    """
    if min(width, height) <= TILE_LIMITS.worth_factor * short and max(width, height) <= TILE_LIMITS.worth_factor * long:
        return []
    across, down = (long, short) if width >= height else (short, long)
    w, h = min(across, width), min(down, height)
    return [Tile(x, y, w, h) for y in _begins(height, h) for x in _begins(width, w)]


def _begins(whole: int, part: int) -> list[int]:
    """Begins of parts that cover a side evenly, each a share of `TILE_LIMITS.overlap` or more over the next one."""
    count = max(1, math.ceil((whole - TILE_LIMITS.overlap * part) / ((1 - TILE_LIMITS.overlap) * part)))
    return [round(i * (whole - part) / max(1, count - 1)) for i in range(count)]


def join_tiles(whole: Detections, parts: Sequence[tuple[Tile, Detections]]) -> Detections:
    """Detections in the whole image and in its tiles, (in pixels of the tiles), as those of one image.

    Vehicles that a tile cuts are left to the others; of several boxes on a vehicle the best one stays. So it is with
    the other road users of each category.
    """
    found = [whole, *(_whole_vehicles(tile, part, whole) for tile, part in parts)]
    users = [whole.road_users, *(_whole_road_users(tile, part.road_users, whole) for tile, part in parts)]
    rectangles = np.concatenate([one.boxes_xyxy for one in found])
    scores = np.concatenate([one.scores for one in found])
    kept = nms(torch.from_numpy(rectangles), torch.from_numpy(scores), TILE_LIMITS.same_iou).numpy()
    points = np.concatenate([one.keypoints for one in found])
    road_users = _best_of_each(RoadUserDetections.together(users))
    return Detections(rectangles[kept], scores[kept], points[kept], whole.size, road_users=road_users)


def _best_of_each(users: RoadUserDetections) -> RoadUserDetections:
    """Return detections without a better overlapping one of their category, best first."""
    of_category = torch.from_numpy(users.categories)
    kept = batched_nms(
        torch.from_numpy(users.boxes_xyxy), torch.from_numpy(users.scores), of_category, TILE_LIMITS.same_iou
    )
    return users.of(kept.numpy())


def _whole_vehicles(tile: Tile, part: Detections, whole: Detections) -> Detections:
    """The vehicles that a tile shows uncut, in pixels of the whole image."""
    corner = np.array([tile.x, tile.y], dtype=np.float64)
    rectangles = part.boxes_xyxy + np.tile(corner, 2)
    kept = _uncut(tile, whole.size, (rectangles, part.scores), (whole.boxes_xyxy, whole.scores))
    points = part.keypoints + np.array([*corner, 0.0])
    return replace(part, boxes_xyxy=rectangles[kept], scores=part.scores[kept], keypoints=points[kept])


def _whole_road_users(tile: Tile, part: RoadUserDetections, whole: Detections) -> RoadUserDetections:
    """The road users that a tile shows uncut, in pixels of the whole image."""
    moved = replace(part, boxes_xyxy=part.boxes_xyxy + np.tile(np.array([tile.x, tile.y], dtype=np.float64), 2))
    kept = np.zeros(len(part), dtype=bool)
    for category in np.unique(part.categories):
        own, others = moved.categories == category, whole.road_users.of(whole.road_users.categories == category)
        seen = (moved.boxes_xyxy[own], moved.scores[own])
        kept[own] = _uncut(tile, whole.size, seen, (others.boxes_xyxy, others.scores))
    return moved.of(kept)


def _uncut(tile: Tile, size: tuple[int, int], part: _Scored, whole: _Scored) -> NDArray[np.bool_]:
    """(N,) whether a tile's box is neither cut by its edge nor part of a surer box of the whole image that it cuts.

    Args:
        tile: The tile.
        size: Width and height of the whole image, pixels.
        part: What the tile shows, in pixels of the whole image.
        whole: What the whole image shows, of the same category.
    """
    rectangles, scores = part
    corner = np.array([tile.x, tile.y], dtype=np.float64)
    end = corner + (tile.width, tile.height)
    inner = np.concatenate([corner > 0, end < size])
    cut = (np.abs(rectangles - np.concatenate([corner, end])) < TILE_LIMITS.edge_px) & inner
    boxes_xyxy, surer = whole
    beyond = np.concatenate([boxes_xyxy[:, :2] < corner, boxes_xyxy[:, 2:] > end], axis=1).any(axis=1)
    inside = boxes.share_inside(rectangles, boxes_xyxy[beyond])
    better = surer[beyond] > scores[:, None]
    return np.asarray(~cut.any(axis=1) & ~((inside > TILE_LIMITS.inside_share) & better).any(axis=1))
