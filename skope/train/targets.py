"""Training targets of one image: boxes and keypoints of vehicles, boxes of other road users, and their transforms."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from skope import boxes as boxes_module
from skope import keypoints
from skope.schema import VEHICLE_ALONE, Annotation, Image, Labelled, RoadUser
from skope.types import Array

LEAST_INSIDE = 0.15
"""Minimum fraction of a vehicle's box inside the image, as in the dataset. Below it the vehicle is ignored."""


@dataclass(frozen=True)
class Vehicles:
    """Boxes and keypoints of the vehicles of one image, and boxes of the other trained road users; pixels."""

    boxes_xyxy: Array
    """(N, 4) boxes of the ground truth."""
    keypoints: Array
    """(N, 33, 3) x, y, v of the ground truth; x = y = 0 where v = 0."""
    ignored_xyxy: Array
    """(M, 4) ignored boxes of all categories."""
    road_users_xyxy: Array = field(default_factory=lambda: np.zeros((0, 4)))
    """(P, 4) boxes of the other road users of the ground truth."""
    road_user_labels: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(P,) their labels in the network, from 2: label k is the k-th of the trained categories."""

    def flipped(self, width: float) -> "Vehicles":
        """Mirror the targets: x becomes width - x, and left and right keypoints are swapped.

        Only for scheme `skope33`, which has known mirror partners.
        """
        points = self.keypoints[:, keypoints.FLIP].copy()
        points[..., 0] = np.where(points[..., 2] > 0, width - points[..., 0], 0.0)
        boxes = (_mirror(each, width) for each in (self.boxes_xyxy, self.ignored_xyxy, self.road_users_xyxy))
        vehicles, ignored, users = boxes
        return Vehicles(vehicles, points, ignored, users, self.road_user_labels)

    def cropped(self, corner: tuple[float, float], scale: tuple[float, float], width: int, height: int) -> "Vehicles":
        """Return the vehicles in a part of the image that is cut out and enlarged.

        The part begins at `corner` (x, y), is enlarged by `scale` (x, y) and then has `width` x `height` pixels.

        Points outside get v = 0, and boxes are clipped. Vehicles that are mostly outside are ignored; those completely
        outside are removed.
        """
        offset, factor = np.array([*corner, *corner]), np.array([*scale, *scale])

        def clipped(boxes_xyxy: Array) -> tuple[Array, Array]:
            """Return boxes moved with the image and clipped to it, and the remaining share of each; no box is empty."""
            moved = (boxes_xyxy - offset) * factor
            inside = boxes_module.clip(moved, width, height)
            return inside, np.divide(boxes_module.area(inside), boxes_module.area(moved))

        vehicles, share = clipped(self.boxes_xyxy)
        users, share_of_users = clipped(self.road_users_xyxy)
        points = self.keypoints.copy()
        points[..., :2] = (points[..., :2] - offset[:2]) * factor[:2]
        inside = ((points[..., :2] >= 0) & (points[..., :2] < [width, height])).all(axis=-1)
        points = np.where((inside & (points[..., 2] > 0))[..., None], points, 0.0)
        ignored, share_of_ignored = clipped(self.ignored_xyxy)
        slivers = [
            each[(left > 0) & (left < LEAST_INSIDE)] for each, left in ((vehicles, share), (users, share_of_users))
        ]
        ignored = np.concatenate([ignored[share_of_ignored > 0], *slivers])
        stays, users_stay = share >= LEAST_INSIDE, share_of_users >= LEAST_INSIDE
        return Vehicles(vehicles[stays], points[stays], ignored, users[users_stay], self.road_user_labels[users_stay])

    def covered(self, box_xyxy: Array) -> "Vehicles":
        """Return the vehicles after an object has covered `box_xyxy` (4,): visible points under it are hidden (v = 1).

        Road users that are mostly covered are ignored.
        """
        under = ((self.keypoints[..., :2] >= box_xyxy[:2]) & (self.keypoints[..., :2] < box_xyxy[2:])).all(axis=-1)
        points = self.keypoints.copy()
        points[..., 2] = np.where(under, np.minimum(points[..., 2], 1.0), points[..., 2])
        seen = boxes_module.share_inside(self.road_users_xyxy, box_xyxy)[:, 0] <= 1 - LEAST_INSIDE
        return replace(
            self,
            keypoints=points,
            ignored_xyxy=np.concatenate([self.ignored_xyxy, self.road_users_xyxy[~seen]]),
            road_users_xyxy=self.road_users_xyxy[seen],
            road_user_labels=self.road_user_labels[seen],
        )

    def supervised(self, supervise: str) -> Array:
        """Return (N, 33, 3) keypoints for training; all others have v = 0."""
        return np.where(self.keypoints[..., 2:] >= (2 if supervise == "visible" else 1), self.keypoints, 0.0)


def _mirror(boxes_xyxy: Array, width: float) -> Array:
    return np.stack(
        [width - boxes_xyxy[:, 2], boxes_xyxy[:, 1], width - boxes_xyxy[:, 0], boxes_xyxy[:, 3]], axis=1
    ).reshape(-1, 4)


def vehicles_of(
    image: Image,
    annotations: Sequence[Annotation],
    road_users: Sequence[RoadUser] = (),
    categories: Sequence[str] = VEHICLE_ALONE,
) -> Vehicles:
    """Return the targets of an image, with ignored boxes. Boxes without area inside the image are omitted.

    Args:
        image: The image.
        annotations: Its vehicles.
        road_users: Its other road users, of `categories`.
        categories: Names of the classes, in the order of the network's labels.
    """
    corners, known, ignored = _in_image(image, annotations)
    points = np.array([a.keypoints for a in annotations]).reshape(-1, keypoints.K, 3)
    points = np.where(points[..., 2:] > 0, points, 0.0)
    user_corners, users_known, users_ignored = _in_image(image, road_users)
    labels = np.array([1 + categories.index(user.category) for user in road_users], dtype=np.int64)
    return Vehicles(
        corners[known],
        points[known],
        np.concatenate([corners[ignored], user_corners[users_ignored]]),
        user_corners[users_known],
        labels[users_known],
    )


def _in_image(image: Image, labels: Sequence[Labelled]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (N, 4) boxes clipped to the image, and (N,) whether each is ground truth and whether it is ignored."""
    corners = boxes_module.xywh_to_xyxy(np.array([label.bbox for label in labels]).reshape(-1, 4))
    corners = boxes_module.clip(corners, image.width, image.height)
    solid = (corners[:, 2:] > corners[:, :2]).all(axis=1)
    ignored = np.array([label.ignored for label in labels], dtype=bool)
    return corners, solid & ~ignored, solid & ignored
