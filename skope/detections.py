"""Detections of a detector in one image."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope import boxes, keypoints
from skope.dataset import coco
from skope.errors import UserError
from skope.keypoints import SKOPE33, Scheme
from skope.pictures import draw
from skope.records import check_image
from skope.schema import AnyResult, Result, RoadUserResult
from skope.types import Pixels

Chosen: TypeAlias = int | slice | Sequence[int] | Sequence[bool] | NDArray[np.bool_] | NDArray[np.integer]
"""Selection of rows: a number, a slice, indices, or a mask."""


@dataclass(frozen=True)
class RoadUserDetections:
    """Pedestrians and two-wheelers found in one image, best score first; they have no keypoints."""

    boxes_xyxy: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4)))
    """(M, 4) pixels of the original image."""
    scores: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """(M,) confidence that the category is right, 0 to 1."""
    categories: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(M,) category ids, 2 to 4, see `schema.CATEGORY_NAMES`."""

    def __len__(self) -> int:
        return len(self.scores)

    def of(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Self:
        """Return selected detections. The selection is a mask (M,), or indices in the new order."""
        return replace(
            self, boxes_xyxy=self.boxes_xyxy[chosen], scores=self.scores[chosen], categories=self.categories[chosen]
        )

    @classmethod
    def together(cls, parts: Sequence["RoadUserDetections"]) -> "RoadUserDetections":
        """Concatenate detections of one or more parts, in their order."""
        names = ("boxes_xyxy", "scores", "categories")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def to_results(self, image_id: int) -> list[RoadUserResult]:
        """Return the detections as COCO results of image `image_id`."""
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

    p increases with the certainty of the network. It is not calibrated, and independent of whether a point is hidden.
    It is float64, so that the peak can be recovered (see `skope.detector.score_calibration`)."""
    size: tuple[int, int]
    """Width and height of the image, pixels."""
    scheme: Scheme = SKOPE33
    """Scheme of the keypoints."""
    road_users: RoadUserDetections = field(default_factory=RoadUserDetections)
    """Other road users than vehicles, from a detector that has learnt their categories."""
    numbers: NDArray[np.int64] | None = None
    """(N,) number of the vehicle, shared by the frames of its video; -1 if not known. None for a single image."""
    interpolated: NDArray[np.bool_] | None = None
    """(N,) whether it was tracked from other frames of its video. None for a single image, in which all were
    detected."""

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, chosen: Chosen) -> Self:
        """Return some of the vehicles as detections: `found[0]`, `found[:5]`, `found[found.scores > 0.8]`.

        The other road users of the image are kept.
        """
        rows = np.array([chosen]) if isinstance(chosen, int | np.integer) else chosen
        if not isinstance(rows, slice):
            rows = np.asarray(rows)
            rows = rows if rows.size else rows.astype(np.int64)
            if rows.dtype == bool and rows.shape != (len(self),):
                raise IndexError(f"expected ({len(self)},) whether each vehicle is chosen, got {rows.shape}")
        columns = ("boxes_xyxy", "scores", "keypoints", "numbers", "interpolated")
        given = {name: values for name in columns if (values := getattr(self, name)) is not None}
        return replace(self, **{name: values[rows] for name, values in given.items()})

    def __iter__(self) -> Iterator[Self]:
        """Yield the vehicles one by one, each as detections without other road users."""
        alone = replace(self, road_users=RoadUserDetections())
        return (alone[i] for i in range(len(self)))

    def above(self, score: float) -> Self:
        """Return the detections with a score above `score`, which is from 0 to 1."""
        return replace(self[self.scores > score], road_users=self.road_users.of(self.road_users.scores > score))

    def draw(self, image: Pixels, *, scale: int = 1) -> Pixels:
        """Draw the detections on a copy of the image, the best one on top.

        Args:
            image: (H, W, 3) RGB pixels of type uint8.
            scale: Enlargement factor, for small images.

        Returns:
            (scale H, scale W, 3) RGB pixels; `draw.write` writes them.

        Raises:
            UserError: The pixels are of another shape or type, or the image is of another size.
        """
        image = check_image("image", image)
        if image.shape[:2] != self.size[::-1]:
            width, height = self.size
            raise UserError(f"image: expected ({height}, {width}, 3) as it was seen, got {image.shape}")
        return draw.results(image, self.to_results(1), self.road_users.to_results(1), scale=scale, scheme=self.scheme)

    def save(self, path: str | Path, *, image_id: int = 1) -> None:
        """Write vehicles and other road users as COCO results, atomically.

        Args:
            path: The .json file.
            image_id: The image's id in the file.

        Raises:
            UserError: The name does not end in .json, or the file cannot be written.
        """
        if Path(path).suffix.lower() != ".json":
            raise UserError(f"{path}: detections are saved as .json; `draw.write` writes what `draw` gives")
        coco.write_results(Path(path), self.all_results(image_id))

    def to_results(self, image_id: int) -> list[Result]:
        """Return the vehicles as COCO results of image `image_id`, for `skope.dataset.coco` and `skope.score`."""
        made = results_of(image_id, self.boxes_xyxy, self.scores, self.keypoints)
        if self.numbers is not None:
            numbers = self.numbers.tolist()
            made = [replace(result, track_id=n if n >= 0 else None) for result, n in zip(made, numbers, strict=True)]
        if self.interpolated is not None:
            followed = self.interpolated.tolist()
            made = [replace(result, interpolated=yes) for result, yes in zip(made, followed, strict=True)]
        return made

    def all_results(self, image_id: int) -> list[AnyResult]:
        """Return vehicles, then other road users, as COCO results of image `image_id`, for `skope.dataset.coco`."""
        return [*self.to_results(image_id), *self.road_users.to_results(image_id)]


def detections_of_results(found: Iterable[AnyResult], size: tuple[int, int], scheme: Scheme = SKOPE33) -> Detections:
    """Return the results of one frame of a video as `Detections`.

    Args:
        found: Vehicles and other road users, best first.
        size: Width and height of the image, pixels.
        scheme: Scheme of the keypoints.
    """
    vehicles, road_users = apart(found)
    return Detections(
        boxes_xyxy=boxes.xywh_to_xyxy(np.array([vehicle.bbox for vehicle in vehicles]).reshape(-1, 4)),
        scores=np.array([vehicle.score for vehicle in vehicles], dtype=np.float64),
        keypoints=np.array([vehicle.keypoints for vehicle in vehicles]).reshape(-1, keypoints.K, 3),
        size=size,
        scheme=scheme,
        road_users=RoadUserDetections(
            boxes.xywh_to_xyxy(np.array([user.bbox for user in road_users]).reshape(-1, 4)),
            np.array([user.score for user in road_users], dtype=np.float64),
            np.array([user.category_id for user in road_users], dtype=np.int64),
        ),
        numbers=np.array(
            [-1 if vehicle.track_id is None else vehicle.track_id for vehicle in vehicles], dtype=np.int64
        ),
        interpolated=np.array([vehicle.interpolated for vehicle in vehicles], dtype=bool),
    )


def apart(found: Iterable[AnyResult]) -> tuple[list[Result], list[RoadUserResult]]:
    """Return the vehicles among results, and the other road users, in their order."""
    vehicles: list[Result] = []
    road_users: list[RoadUserResult] = []
    for result in found:
        if isinstance(result, Result):
            vehicles.append(result)
        else:
            road_users.append(result)
    return vehicles, road_users


def results_of(image_id: int, boxes_xyxy: ArrayLike, scores: ArrayLike, points: ArrayLike) -> list[Result]:
    """Return COCO results of the vehicles found in an image.

    Args:
        image_id: Id of the image.
        boxes_xyxy: (N, 4) pixels.
        scores: (N,) 0 to 1.
        points: (N, 33, 3) x, y (pixels) and probability.

    Returns:
        N COCO results, in the same order.

    Raises:
        ValueError: The numbers of boxes, scores and points differ.
    """
    rows = zip(boxes.xyxy_to_xywh(boxes_xyxy), np.asarray(scores), np.asarray(points), strict=True)
    return [Result(image_id=image_id, bbox=box, score=float(score), keypoints=found) for box, score, found in rows]
