"""Detect small objects in tiles: overlapping parts of an image that pass through the network unscaled.

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
    """Rules for cutting an image into tiles and merging their detections."""

    worth_factor: float = 1.25
    """Ratio of the image size to its size inside the network, above which the image is cut into tiles."""
    overlap: float = 0.15
    """Minimum overlap of neighbouring tiles, as a share of their sides."""
    edge_px: float = 3.0
    """Distance from an edge of its tile below which a box counts as cut by the tile, pixels."""
    same_iou: float = 0.5
    """IoU above which boxes belong to the same vehicle, as inside the network."""
    inside_share: float = 0.7
    """Minimum share of a box inside a vehicle cut by its tile for the box to count as a part of that vehicle."""


TILE_LIMITS: Final = TileLimits()


_Scored: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]]
"""(N, 4) boxes xyxy, pixels, and their (N,) scores."""


@dataclass(frozen=True)
class Tile:
    """Part of an image, pixels."""

    x: int
    y: int
    width: int
    height: int

    def of(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the part of (H, W, 3) pixels."""
        return image[self.y : self.y + self.height, self.x : self.x + self.width]


def tiles_of(width: int, height: int, *, short: int, long: int) -> list[Tile]:
    """Return overlapping tiles that cover an image; none if the image enters the network nearly unscaled.

    Args:
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        short: Short side of images inside the network, pixels.
        long: Maximum long side of images inside the network, pixels.
    """
    if min(width, height) <= TILE_LIMITS.worth_factor * short and max(width, height) <= TILE_LIMITS.worth_factor * long:
        return []
    across, down = (long, short) if width >= height else (short, long)
    w, h = min(across, width), min(down, height)
    return [Tile(x, y, w, h) for y in _begins(height, h) for x in _begins(width, w)]


def _begins(whole: int, part: int) -> list[int]:
    """Return the starts of parts that cover a side evenly and overlap by at least `TILE_LIMITS.overlap`."""
    count = max(1, math.ceil((whole - TILE_LIMITS.overlap * part) / ((1 - TILE_LIMITS.overlap) * part)))
    return [round(i * (whole - part) / max(1, count - 1)) for i in range(count)]


def join_tiles(whole: Detections, parts: Sequence[tuple[Tile, Detections]]) -> Detections:
    """Merge the detections in the whole image and in its tiles (in pixels of the tiles) to those of one image.

    Vehicles that a tile cuts are left to the other parts. Of several boxes on a vehicle, the best is kept. The other
    road users of each category are merged in the same way.
    """
    found = [whole, *(_whole_vehicles(tile, part, whole) for tile, part in parts)]
    users = [whole.road_users, *(_whole_road_users(tile, part.road_users, whole) for tile, part in parts)]
    rectangles = np.concatenate([part.boxes_xyxy for part in found])
    scores = np.concatenate([part.scores for part in found])
    kept = nms(torch.from_numpy(rectangles), torch.from_numpy(scores), TILE_LIMITS.same_iou).numpy()
    points = np.concatenate([part.keypoints for part in found])
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
    """Return the vehicles that a tile does not cut, in pixels of the whole image."""
    corner = np.array([tile.x, tile.y], dtype=np.float64)
    rectangles = part.boxes_xyxy + np.tile(corner, 2)
    kept = _uncut(tile, whole.size, (rectangles, part.scores), (whole.boxes_xyxy, whole.scores))
    points = part.keypoints + np.array([*corner, 0.0])
    return replace(part, boxes_xyxy=rectangles[kept], scores=part.scores[kept], keypoints=points[kept])


def _whole_road_users(tile: Tile, part: RoadUserDetections, whole: Detections) -> RoadUserDetections:
    """Return the road users that a tile does not cut, in pixels of the whole image."""
    moved = replace(part, boxes_xyxy=part.boxes_xyxy + np.tile(np.array([tile.x, tile.y], dtype=np.float64), 2))
    kept = np.zeros(len(part), dtype=bool)
    for category in np.unique(part.categories):
        of_category, whole_users = (
            moved.categories == category,
            whole.road_users.of(whole.road_users.categories == category),
        )
        seen = (moved.boxes_xyxy[of_category], moved.scores[of_category])
        kept[of_category] = _uncut(tile, whole.size, seen, (whole_users.boxes_xyxy, whole_users.scores))
    return moved.of(kept)


def _uncut(tile: Tile, size: tuple[int, int], part: _Scored, whole: _Scored) -> NDArray[np.bool_]:
    """Return (N,) whether a tile's box is neither cut nor part of a higher-scoring box that the tile cuts.

    Args:
        tile: The tile.
        size: Width and height of the whole image, pixels.
        part: Detections of the tile, in pixels of the whole image.
        whole: Detections of the whole image of the same category.
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
