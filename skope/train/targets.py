"""Boxes and keypoints of the vehicles of one image, and how they move when the pixels do."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from skope import boxes as boxes_module
from skope import keypoints
from skope.schema import Annotation, Image
from skope.types import Array

LEAST_INSIDE = 0.15
"""A vehicle of whose box less than this share stays in the image becomes an ignored one, as in the dataset."""


@dataclass(frozen=True)
class Vehicles:
    """Boxes and keypoints of the vehicles of one image, pixels."""

    boxes_xyxy: Array
    """(N, 4) boxes of the ground truth."""
    keypoints: Array
    """(N, 33, 3) x, y, v of the ground truth; x = y = 0 where v = 0."""
    ignored_xyxy: Array
    """(M, 4) boxes of the ignored vehicles."""

    def flipped(self, width: float) -> "Vehicles":
        """The vehicles in the mirrored image: x becomes width - x, and right and left keypoints change places.

        Only for scheme `skope33`, whose mirror partners are known.
        """
        points = self.keypoints[:, keypoints.FLIP].copy()
        points[..., 0] = np.where(points[..., 2] > 0, width - points[..., 0], 0.0)
        return Vehicles(_mirror(self.boxes_xyxy, width), points, _mirror(self.ignored_xyxy, width))

    def cropped(self, corner: tuple[float, float], scale: tuple[float, float], width: int, height: int) -> "Vehicles":
        """The vehicles in a part of the image that is cut out and enlarged.

        The part begins at `corner` (x, y), is enlarged by `scale` (x, y) and then has `width` x `height` pixels.

        Points outside become v = 0, boxes are clipped; what mostly leaves the image is ignored, what wholly leaves it
        goes.
        """
        offset, factor = np.array([*corner, *corner]), np.array([*scale, *scale])
        moved = (self.boxes_xyxy - offset) * factor
        clipped = boxes_module.clip(moved, width, height)
        share = np.divide(boxes_module.area(clipped), boxes_module.area(moved))  # no box is empty
        points = self.keypoints.copy()
        points[..., :2] = (points[..., :2] - offset[:2]) * factor[:2]
        inside = ((points[..., :2] >= 0) & (points[..., :2] < [width, height])).all(axis=-1)
        points = np.where((inside & (points[..., 2] > 0))[..., None], points, 0.0)
        ignored = boxes_module.clip((self.ignored_xyxy - offset) * factor, width, height)
        stays, sliver = share >= LEAST_INSIDE, (share > 0) & (share < LEAST_INSIDE)
        ignored = np.concatenate([ignored[boxes_module.area(ignored) > 0], clipped[sliver]])
        return Vehicles(clipped[stays], points[stays], ignored)

    def covered(self, box_xyxy: Array) -> "Vehicles":
        """The vehicles after something was put before `box_xyxy` (4,): visible points under it are hidden (v = 1)."""
        under = ((self.keypoints[..., :2] >= box_xyxy[:2]) & (self.keypoints[..., :2] < box_xyxy[2:])).all(axis=-1)
        points = self.keypoints.copy()
        points[..., 2] = np.where(under, np.minimum(points[..., 2], 1.0), points[..., 2])
        return replace(self, keypoints=points)

    def supervised(self, supervise: str) -> Array:
        """(N, 33, 3) the keypoints that are learnt: those not learnt have v = 0."""
        return np.where(self.keypoints[..., 2:] >= (2 if supervise == "visible" else 1), self.keypoints, 0.0)


def _mirror(boxes_xyxy: Array, width: float) -> Array:
    return np.stack(
        [width - boxes_xyxy[:, 2], boxes_xyxy[:, 1], width - boxes_xyxy[:, 0], boxes_xyxy[:, 3]], axis=1
    ).reshape(-1, 4)


def vehicles_of(image: Image, annotations: Sequence[Annotation]) -> Vehicles:
    """Ground truth and ignored vehicles; boxes without area inside the image are left out."""
    corners = boxes_module.xywh_to_xyxy(np.array([a.bbox for a in annotations]).reshape(-1, 4))
    corners = boxes_module.clip(corners, image.width, image.height)
    solid = (corners[:, 2:] > corners[:, :2]).all(axis=1)
    ignored = np.array([a.ignored for a in annotations], dtype=bool)
    points = np.array([a.keypoints for a in annotations]).reshape(-1, keypoints.K, 3)
    points = np.where(points[..., 2:] > 0, points, 0.0)
    return Vehicles(corners[solid & ~ignored], points[solid & ~ignored], corners[solid & ignored])
