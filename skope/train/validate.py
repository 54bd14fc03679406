"""Validation: quality of the model after an epoch, on images that are not used for training."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchvision.models.detection import KeypointRCNN

from skope import boxes
from skope.dataset.folder import read_image
from skope.detector.detect import detect, detect_on_boxes
from skope.metrics.pck_precision_recall import MetricOptions, score_split
from skope.metrics.road_users import category_figures
from skope.schema import VEHICLE_ALONE, AnnotationFile, Result, RoadUserResult

Figures = dict[str, Any]

VALIDATION_IOU = "0.6"
"""IoU threshold of the validation: the lowest of the paper, because early epochs detect boxes roughly."""


def detect_in_image(
    model: KeypointRCNN,
    pixels: Any,
    image_id: int,
    device: torch.device,
    score: float,
    categories: tuple[str, ...] = VEHICLE_ALONE,
) -> tuple[list[Result], list[RoadUserResult]]:
    """Detect road users in one image; vehicles go through the keypoint head.

    Args:
        model: The model.
        pixels: (H, W, 3) RGB.
        image_id: Id of the image, for the results.
        device: Device of the model.
        score: Score threshold.
        categories: Names of the network's labels.
    """
    (found,) = detect(model, [pixels], device, min_score=score, categories=categories)
    return found.to_results(image_id), found.road_users.to_results(image_id)


@dataclass(frozen=True)
class ValidationResults:
    """Results of a model on the images of a split."""

    detected: list[Result]
    """Detected vehicles."""
    given: list[Result]
    """Keypoints localised inside the ground-truth boxes, one result per vehicle."""
    road_users: list[RoadUserResult] = field(default_factory=list)
    """Detected other road users."""


def validate(model: KeypointRCNN, file: AnnotationFile, paths: Sequence[Path], device: torch.device) -> Figures:
    """Run a model on images and return the result of `figures`.

    Args:
        model: The model.
        file: The ground truth.
        paths: Files of its images.
        device: Device of the model.
    """
    return figures(file, run_model(model, file, paths, device))


def run_model(
    model: KeypointRCNN, file: AnnotationFile, paths: Sequence[Path], device: torch.device
) -> ValidationResults:
    """Run a model on images.

    Args:
        model: The model. It has the categories of `file`.
        file: The ground truth.
        paths: Files of its images.
        device: Device of the model.
    """
    vehicles = file.by_image()
    detected: list[Result] = []
    given: list[Result] = []
    road_users: list[RoadUserResult] = []
    for image, path in zip(file.images, paths, strict=True):
        pixels = read_image(path, size=(image.width, image.height))
        found, found_users = detect_in_image(model, pixels, image.id, device, MetricOptions().score, file.categories)
        detected += found
        road_users += found_users
        truth = sorted((a for a in vehicles[image.id] if not a.ignored), key=lambda a: a.id)
        corners = boxes.xywh_to_xyxy(np.array([a.bbox for a in truth]).reshape(-1, 4))
        points = detect_on_boxes(model, pixels, corners, device)
        rows = zip(truth, points, strict=True)
        given += [Result(image_id=image.id, bbox=a.bbox, score=1.0, keypoints=p) for a, p in rows]
    return ValidationResults(detected, given, road_users)


def figures(file: AnnotationFile, found: ValidationResults) -> Figures:
    """Return pooled metrics of a split, at a score above 0.9 and an IoU of 0.6.

    `pck` is the PCK of matched vehicles. `pck_given` is the PCK inside the ground-truth boxes, which separates
    localisation from detection. Both are None if the denominator is 0. Each further category that `file` labels has
    precision and recall of boxes, at the same score and an IoU of 0.5.
    """
    options = MetricOptions()
    split = score_split(file, found.detected, options)
    at = split["iou"][VALIDATION_IOU]
    road_users = category_figures(file, found.road_users, score=options.score, all_scores=False)
    return {
        "images": split["images"],
        "vehicles": split["ground_truth"],
        "pck": at["pck"],
        "pck_given": score_split(file, found.given, options)["iou"][VALIDATION_IOU]["pck"],
        **{name: at[name]["pooled"] for name in ("box_precision", "box_recall", "keypoint_recall")},
        **{
            f"{category}_{name}": by_size["all"][name]
            for category, by_size in road_users.items()
            for name in ("precision", "recall")
        },
    }


def rank(figures: Figures) -> list[float]:
    """Return the sort key of the best epoch: keypoint recall, then PCK inside the ground-truth boxes.

    Only vehicles count.
    """
    return [figures["keypoint_recall"] or 0.0, figures["pck_given"] or 0.0]
