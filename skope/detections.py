"""What a detector found in an image."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope import boxes
from skope.keypoints import SKOPE33, Scheme
from skope.schema import Result, RoadUserResult

AnyResult: TypeAlias = Result | RoadUserResult


@dataclass(frozen=True)
class RoadUserDetections:
    """People on foot and on two wheels found in one image, best score first; they have no keypoints."""

    boxes_xyxy: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4)))
    """(M, 4) pixels of the original image."""
    scores: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """(M,) confidence that this is one of its category, 0 to 1."""
    categories: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(M,) ids of their categories, 2 to 4, see `schema.CATEGORIES`."""

    def __len__(self) -> int:
        return len(self.scores)

    def of(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Self:
        """Some of them: (M,) whether each is chosen, or the numbers of those that are, in their new order."""
        return replace(
            self, boxes_xyxy=self.boxes_xyxy[chosen], scores=self.scores[chosen], categories=self.categories[chosen]
        )

    @classmethod
    def together(cls, parts: Sequence["RoadUserDetections"]) -> "RoadUserDetections":
        """Those of all parts, of which there is one at least, in their order."""
        names = ("boxes_xyxy", "scores", "categories")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def to_results(self, image_id: int) -> list[RoadUserResult]:
        """The detections as COCO results of image `image_id`."""
        rows = zip(boxes.xyxy_to_xywh(self.boxes_xyxy), self.scores, self.categories.tolist(), strict=True)
        return [
            RoadUserResult(image_id=image_id, bbox=box, score=float(score), category_id=category)
            for box, score, category in rows
        ]


@dataclass(frozen=True)
class Detections:
    """Vehicles found in one image, best score first."""

    boxes_xyxy: NDArray[np.float64]
    """(N, 4) pixels of the original image."""
    scores: NDArray[np.float64]
    """(N,) confidence that this is a vehicle, 0 to 1."""
    keypoints: NDArray[np.float64]
    """(N, 33, 3) x, y, p: pixels of the original image, and the sigmoid of the heat map's peak, 0 to 1.

    p grows with the network's certainty but is not calibrated, and says nothing on whether a point is hidden. It is
    taken in float64, from which the peak can be had back (`skope.eval.inference.score_calibration` does).
    """
    size: tuple[int, int]
    """Width and height of the image, pixels."""
    scheme: Scheme = SKOPE33
    """What the keypoints are, and by which edition of their definition they are marked."""
    road_users: RoadUserDetections = field(default_factory=RoadUserDetections)
    """Who else was found, by a detector that has learnt other categories; no vehicles."""

    def __len__(self) -> int:
        return len(self.scores)

    def above(self, score: float) -> Self:
        """The detections that score higher than `score`, which is from 0 to 1."""
        kept = self.scores > score
        others = self.road_users.of(self.road_users.scores > score)
        return replace(
            self,
            boxes_xyxy=self.boxes_xyxy[kept],
            scores=self.scores[kept],
            keypoints=self.keypoints[kept],
            road_users=others,
        )

    def to_results(self, image_id: int) -> list[Result]:
        """The vehicles as COCO results of image `image_id`, for `skope.dataset.coco` and `skope.score`."""
        return results(image_id, self.boxes_xyxy, self.scores, self.keypoints)

    def all_results(self, image_id: int) -> list[AnyResult]:
        """Vehicles, then other road users, as COCO results of image `image_id`, for `skope.dataset.coco`."""
        return [*self.to_results(image_id), *self.road_users.to_results(image_id)]


def apart(found: Iterable[AnyResult]) -> tuple[list[Result], list[RoadUserResult]]:
    """The vehicles among results, and the other road users, in their order."""
    vehicles: list[Result] = []
    road_users: list[RoadUserResult] = []
    for one in found:
        if isinstance(one, Result):
            vehicles.append(one)
        else:
            road_users.append(one)
    return vehicles, road_users


def results(image_id: int, boxes_xyxy: ArrayLike, scores: ArrayLike, points: ArrayLike) -> list[Result]:
    """Detections in an image, (N, 4), (N,) and (N, 33, 3) as in `Detections`, as N COCO results."""
    rows = zip(boxes.xyxy_to_xywh(boxes_xyxy), np.asarray(scores), np.asarray(points), strict=True)
    return [Result(image_id=image_id, bbox=box, score=float(score), keypoints=found) for box, score, found in rows]
