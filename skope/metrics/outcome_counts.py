"""Counts per image. Every figure is a quotient of sums of these counts.

In both protocols a figure is the sum of a numerator over images divided by the sum of a denominator. The paper's mean
of per-image ratios sums the ratios of images with ground truth. Leaving images out, as for intervals, is then a
subtraction.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.metrics.keypoint_outcomes import MetricOptions, outcomes_at, predicted_keypoints
from skope.metrics.match import Matches
from skope.types import Array, Integers

Name = tuple[str, str | None]
"""Name of a figure, and its protocol; None if it has only one."""
FIGURE_NAMES: Final[tuple[Name, ...]] = (
    ("pck", None),
    *(
        (name, protocol)
        for name in ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")
        for protocol in ("paper", "pooled")
    ),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageCounts:
    """Counts of N images at one IoU threshold; each field has shape (N,)."""

    ground_truth: Integers
    """Ground-truth vehicles."""
    detections: Integers
    """Detections that count."""
    matched: Integers
    """Detections that matched a vehicle."""
    detections_ignored: Integers
    """Unmatched detections on ignored vehicles."""
    labelled: Integers
    """Labelled keypoints of the matched vehicles."""
    labelled_all: Integers
    """Labelled keypoints of all vehicles."""
    detected: Integers
    """Keypoints of `labelled` that are predicted, at any position."""
    correct: Integers
    """Keypoints of `labelled` that are predicted within alpha times the longer edge of the box."""
    predicted: Integers
    """Predicted keypoints of all detections except unmatched detections on ignored vehicles."""
    predicted_matched: Integers
    """Predicted keypoints of the matched detections."""

    def to_dict(self) -> dict[str, list[int]]:
        """Return the counts by name, each a list of N numbers."""
        return {field.name: getattr(self, field.name).tolist() for field in fields(self)}


def tally(matches: Matches, threshold: float, options: MetricOptions) -> ImageCounts:
    """Count vehicles, detections and keypoints in each image.

    Args:
        matches: A split's ground truth and detections.
        threshold: IoU threshold, one of the keys of `matches.taken`.
        options: The rules for labelled, predicted and correct keypoints.

    Returns:
        Counts of the images, in the order of the file.
    """
    outcomes = outcomes_at(matches, threshold, options)
    matched = matches.taken[threshold] >= 0
    left_out = ~matched & matches.det_on_ignored
    points = predicted_keypoints(matches, options).sum(axis=1)
    labelled = outcomes.labelled.sum(axis=1)

    def by_image(image: Integers, weights: NDArray[Any]) -> Integers:
        return np.bincount(image, weights=weights, minlength=matches.images).astype(np.int64)

    def of_vehicles(weights: NDArray[Any]) -> Integers:
        return by_image(matches.gt_image, weights)

    def of_detections(weights: NDArray[Any]) -> Integers:
        return by_image(matches.det_image, weights)

    return ImageCounts(
        ground_truth=of_vehicles(np.ones_like(labelled)),
        detections=of_detections(np.ones_like(points)),
        matched=of_detections(matched),
        detections_ignored=of_detections(left_out),
        labelled=of_vehicles(labelled * outcomes.found),
        labelled_all=of_vehicles(labelled),
        detected=of_vehicles((outcomes.labelled & outcomes.predicted).sum(axis=1)),
        correct=of_vehicles(outcomes.correct(options.alpha).sum(axis=1)),
        predicted=of_detections(points * ~left_out),
        predicted_matched=of_detections(points * matched),
    )


Quotients = dict[Name, tuple[Array, Array]]
"""Figure -> (N,) numerator and (N,) denominator of each image."""


def quotients(counts: ImageCounts) -> Quotients:
    """Return numerators and denominators of each figure of `FIGURE_NAMES`, per image.

    The figures are those of the table in the SKoPe3D paper, in its own protocol (`paper`) and pooled (`pooled`).
    """
    c = counts
    has_truth = c.ground_truth > 0
    pooled = {
        "box_precision": (c.matched, c.detections - c.detections_ignored),
        "box_recall": (c.matched, c.ground_truth),
        "keypoint_precision": (c.correct, c.predicted),
        "keypoint_recall": (c.correct, c.labelled_all),
    }
    # The paper's figures are means of per-image ratios. A numerator is 0 if its denominator is 0.
    paper = {
        "box_precision": (c.matched, c.detections),
        "box_recall": (c.matched, c.ground_truth),
        "keypoint_precision": (c.correct, c.predicted_matched),
        # All keypoints of a detected vehicle count as detected, even if none of them is labelled.
        "keypoint_recall": (
            np.where(c.labelled > 0, c.detected, c.matched > 0),
            np.where(c.labelled > 0, c.labelled, c.matched > 0),
        ),
    }
    out: Quotients = {("pck", None): (c.correct.astype(np.float64), c.labelled.astype(np.float64))}
    for name in pooled:
        top, bottom = paper[name]
        out[name, "paper"] = (top / np.maximum(bottom, 1) * has_truth, has_truth.astype(np.float64))
        top, bottom = pooled[name]
        out[name, "pooled"] = (top.astype(np.float64), bottom.astype(np.float64))
    return out


def quality(counts: ImageCounts) -> Array:
    """Return (N,) quality of each image: share of correct keypoints, times vehicles / (vehicles + false detections).

    The share is that of correct among labelled keypoints. NaN if an image has no labelled keypoints.
    """
    false = counts.detections - counts.matched - counts.detections_ignored
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(counts.labelled_all > 0, counts.correct / counts.labelled_all, np.nan)
        return np.asarray(found * counts.ground_truth / (counts.ground_truth + false))


def ratio(numerator: float, denominator: float) -> float | None:
    """Return the quotient, or None if the denominator is 0."""
    return float(numerator / denominator) if denominator else None


def nested(values: Mapping[Name, Any]) -> dict[str, Any]:
    """Return figures in the layout of `metrics.json`: the protocols of a figure below its name."""
    out: dict[str, Any] = {}
    for (name, protocol), value in values.items():
        if protocol is None:
            out[name] = value
        else:
            out.setdefault(name, {})[protocol] = value
    return out
