"""Validation: how good the model is after an epoch, on images that it does not learn from."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchvision.models.detection import KeypointRCNN

from skope import boxes
from skope.dataset.folder import read_image
from skope.detections import results
from skope.detector.detect import detect, detect_on_boxes
from skope.metrics.precision_recall import Options, score_split
from skope.schema import AnnotationFile, Result

Figures = dict[str, Any]

_IOU = "0.6"
"""The paper's laxest threshold: early epochs find boxes roughly."""


def detect_in_image(
    model: KeypointRCNN, pixels: Any, image_id: int, device: torch.device, score: float
) -> list[Result]:
    """Detections above `score` in one (H, W, 3) image as results; only those go through the keypoint head."""
    (detections,) = detect(model, [pixels], device, min_score=score)
    return results(image_id, detections.boxes_xyxy, detections.scores, detections.keypoints)


@dataclass(frozen=True)
class ValidationResults:
    """What a model finds in the images of a split."""

    detected: list[Result]
    """The vehicles that it detects."""
    given: list[Result]
    """The keypoints that it finds inside the boxes of the ground truth, a result for each vehicle."""


def validate(model: KeypointRCNN, file: AnnotationFile, paths: Sequence[Path], device: torch.device) -> Figures:
    """Run the model on the images of `file`, whose pixels lie at `paths`, and measure as `figures` does."""
    return figures(file, run_model(model, file, paths, device))


def run_model(
    model: KeypointRCNN, file: AnnotationFile, paths: Sequence[Path], device: torch.device
) -> ValidationResults:
    """Run the model on the images of `file`, whose pixels lie at `paths`."""
    vehicles = file.by_image()
    detected: list[Result] = []
    given: list[Result] = []
    for image, path in zip(file.images, paths, strict=True):
        pixels = read_image(path, size=(image.width, image.height))
        detected += detect_in_image(model, pixels, image.id, device, Options().score)
        truth = sorted((a for a in vehicles[image.id] if not a.ignored), key=lambda a: a.id)
        corners = boxes.xywh_to_xyxy(np.array([a.bbox for a in truth]).reshape(-1, 4))
        points = detect_on_boxes(model, pixels, corners, device)
        rows = zip(truth, points, strict=True)
        given += [Result(image_id=image.id, bbox=a.bbox, score=1.0, keypoints=p) for a, p in rows]
    return ValidationResults(detected, given)


def figures(file: AnnotationFile, found: ValidationResults) -> Figures:
    """Figures of a split, pooled, at a score above 0.9 and an IoU of 0.6.

    `pck` is that of the vehicles found, `pck_given` that inside the ground-truth boxes, localisation apart from
    detection; None where there is nothing to divide by.
    """
    options = Options()
    split = score_split(file, found.detected, options)
    at = split["iou"][_IOU]
    return {
        "images": split["images"],
        "vehicles": split["ground_truth"],
        "pck": at["pck"],
        "pck_given": score_split(file, found.given, options)["iou"][_IOU]["pck"],
        **{name: at[name]["pooled"] for name in ("box_precision", "box_recall", "keypoint_recall")},
    }


def rank(figures: Figures) -> list[float]:
    """Sort key by which the best epoch is chosen: keypoint recall, then PCK inside the ground-truth boxes."""
    return [figures["keypoint_recall"] or 0.0, figures["pck_given"] or 0.0]
