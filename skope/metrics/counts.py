"""Counts of each image, of whose sums every figure is a quotient; and what became of each vehicle.

A figure is the sum of a numerator over images divided by that of a denominator, in both protocols (the paper's mean of
per-image ratios sums ratios over the images that have ground truth), so that leaving images out, as intervals do, takes
a subtraction.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.errors import UserError, one_of
from skope.keypoints import Scheme
from skope.metrics.match import BOX_KINDS, THRESHOLDS, Matches
from skope.types import Array, Integers, Mask

PROTOCOLS: Final = ("pooled", "paper")
LABELLED: Final = ("visible", "all")
"""Choices of the ground-truth keypoints that count: those with v = 2, or all with v > 0."""


Name = tuple[str, str | None]
"""A figure, and its protocol where there are two."""
FIGURES: Final[tuple[Name, ...]] = (
    ("pck", None),
    *(
        (name, protocol)
        for name in ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")
        for protocol in ("paper", "pooled")
    ),
)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Rules on what counts as a detection, a labelled keypoint, a predicted one and a correct one."""

    score: float = 0.9
    """A detection counts when it scores above this."""
    alpha: float = 0.1
    """A keypoint is correct within alpha times the longer edge of the ground-truth box."""
    labelled: str = "visible"
    """Keypoints of the ground truth that count, one of `LABELLED`."""
    boxes: str = "full"
    """Boxes of the ground truth that detections are matched to, one of `BOX_KINDS`."""
    iou: tuple[float, ...] = THRESHOLDS
    """Thresholds at which detections match, in the order in which they are reported."""
    keypoint_score: float = 0.0
    """A keypoint counts as predicted when it scores above this; 0 takes all, as the paper does."""
    points: tuple[int, ...] = tuple(range(keypoints.K))
    """The keypoints that are scored: all, or those that another scheme shares."""
    scheme: Scheme = keypoints.SKOPE33
    """Keypoint scheme of the ground truth."""

    def __post_init__(self) -> None:
        for flag, value in (("--score", self.score), ("--keypoint-score", self.keypoint_score)):
            if not 0 <= value <= 1:
                raise UserError(f"{flag}: expected a number from 0 to 1, got {value}")
        if not (math.isfinite(self.alpha) and self.alpha > 0):
            raise UserError(f"--alpha: expected a positive number, got {self.alpha}")
        for threshold in self.iou:
            if not 0 < threshold <= 1:
                raise UserError(f"--iou: expected numbers above 0 and up to 1, got {threshold}")
        if not self.iou or len(set(self.iou)) != len(self.iou):
            raise UserError(f"--iou: expected different numbers, got {', '.join(map(str, self.iou)) or 'none'}")
        one_of("--labelled", self.labelled, LABELLED)
        one_of("--boxes", self.boxes, BOX_KINDS)

    @property
    def loosest(self) -> float:
        """The threshold at which most vehicles match, for what is reported at one only."""
        return min(self.iou)


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """Outcomes of the G vehicles of a split at one IoU threshold: which detection took each, and its errors."""

    detection: Integers
    """(G,) index of the detection in `Matches`, -1 for none."""
    labelled: Mask
    """(G, 33) keypoints that are labelled, as `Options.labelled` says."""
    predicted: Mask
    """(G, 33) keypoints that the detection predicts."""
    offset: Array
    """(G, 33) pixels from the prediction to the ground truth, infinite where no detection took the vehicle."""
    length: Array
    """(G,) longer edge of the ground-truth box, pixels."""

    @property
    def found(self) -> Mask:
        """(G,) whether a detection took the vehicle."""
        return self.detection >= 0

    def correct(self, alpha: float) -> Mask:
        """(G, 33) labelled, predicted and within `alpha` times the length."""
        return self.labelled & self.predicted & (self.offset <= alpha * self.length[:, None])


def predicted(matches: Matches, options: Options) -> Mask:
    """(D, 33) which keypoints of each detection count as predicted."""
    mask = np.zeros((len(matches.det_image), keypoints.K), dtype=bool)
    mask[:, list(options.points)] = True
    return mask & (matches.det_keypoints[:, :, 2] > options.keypoint_score) if options.keypoint_score else mask


def lengths(vectors: Array) -> Array:
    """(...,) Euclidean lengths of (..., 2) vectors of pixels: several times faster than hypot, which takes care that
    no square overflows; here such a length is infinite, and as wrong as it was.
    """
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2))


def outcomes_at(matches: Matches, threshold: float, options: Options) -> Outcomes:
    """Compare each vehicle with the detection that took it.

    Args:
        matches: Vehicles and detections, matched.
        threshold: The IoU threshold, one of `matches.taken`.
        options: What counts, and when a keypoint is correct.
    """
    taken = matches.taken[threshold]
    matched = np.flatnonzero(taken >= 0)
    detection = np.full(len(matches.gt_image), -1, dtype=np.int64)
    detection[taken[matched]] = matched
    found = np.flatnonzero(detection >= 0)

    labelled = np.zeros(matches.gt_keypoints.shape[:2], dtype=bool)
    points = list(options.points)
    labelled[:, points] = matches.gt_keypoints[:, points, 2] >= (2 if options.labelled == "visible" else 1)
    shown = np.zeros_like(labelled)
    shown[found] = predicted(matches, options)[detection[found]]
    offset = np.full(labelled.shape, np.inf)
    offset[found] = lengths(matches.det_keypoints[detection[found], :, :2] - matches.gt_keypoints[found, :, :2])
    box = matches.gt_boxes_xyxy
    length = (box[:, 2:] - box[:, :2]).max(axis=1, initial=0.0)
    return Outcomes(detection=detection, labelled=labelled, predicted=shown, offset=offset, length=length)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tally:
    """Counts of each of N images at one IoU threshold, (N,) each."""

    ground_truth: Integers
    """Ground-truth vehicles."""
    detections: Integers
    """Detections that count."""
    matched: Integers
    """Detections that took a vehicle."""
    detections_ignored: Integers
    """Unmatched detections on ignored vehicles."""
    labelled: Integers
    """Labelled keypoints of the matched vehicles."""
    labelled_all: Integers
    """Labelled keypoints of all vehicles."""
    detected: Integers
    """Keypoints of `labelled` that are predicted, anywhere."""
    correct: Integers
    """Keypoints of `labelled` that are predicted within alpha times the longer edge of the box."""
    predicted: Integers
    """Predicted keypoints of all detections but those on ignored vehicles."""
    predicted_matched: Integers
    """Predicted keypoints of the matched detections."""

    def to_dict(self) -> dict[str, list[int]]:
        """Counts by name, each a list of N numbers."""
        return {field.name: getattr(self, field.name).tolist() for field in fields(self)}


def tally(matches: Matches, threshold: float, options: Options) -> Tally:
    """Count vehicles, detections and keypoints in each image.

    Args:
        matches: A split's ground truth and detections.
        threshold: An IoU threshold of `matches.taken`.
        options: What counts as labelled, predicted and correct.

    Returns:
        Counts of the images, in the order of the file.
    """
    outcomes = outcomes_at(matches, threshold, options)
    matched = matches.taken[threshold] >= 0
    left_out = ~matched & matches.det_on_ignored
    points = predicted(matches, options).sum(axis=1)
    labelled = outcomes.labelled.sum(axis=1)

    def by_image(image: Integers, weights: NDArray[Any]) -> Integers:
        return np.bincount(image, weights=weights, minlength=matches.images).astype(np.int64)

    def of_vehicles(weights: NDArray[Any]) -> Integers:
        return by_image(matches.gt_image, weights)

    def of_detections(weights: NDArray[Any]) -> Integers:
        return by_image(matches.det_image, weights)

    return Tally(
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


def quotients(counts: Tally) -> Quotients:
    """Numerators and denominators whose sums over images give each figure of `FIGURES`.

    The figures are those of the SKoPe3D paper's table in its own protocol (`paper`) and pooled (`pooled`).
    """
    c = counts
    has_truth = c.ground_truth > 0
    pooled = {
        "box_precision": (c.matched, c.detections - c.detections_ignored),
        "box_recall": (c.matched, c.ground_truth),
        "keypoint_precision": (c.correct, c.predicted),
        "keypoint_recall": (c.correct, c.labelled_all),
    }
    # The paper's figures are means of each image's own ratio; its numerator is 0 wherever its denominator is.
    paper = {
        "box_precision": (c.matched, c.detections),
        "box_recall": (c.matched, c.ground_truth),
        "keypoint_precision": (c.correct, c.predicted_matched),
        # All keypoints of a detected vehicle count as detected, also where it has none that is labelled.
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


def quality(counts: Tally) -> Array:
    """(N,) share of an image's labelled keypoints that are right, times vehicles / (vehicles + false ones).

    NaN where nothing is labelled.
    """
    false = counts.detections - counts.matched - counts.detections_ignored
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(counts.labelled_all > 0, counts.correct / counts.labelled_all, np.nan)
        return np.asarray(found * counts.ground_truth / (counts.ground_truth + false))


def ratio(numerator: float, denominator: float) -> float | None:
    """The quotient, or None where there is nothing to divide by."""
    return float(numerator / denominator) if denominator else None


def nested(values: Mapping[Name, Any]) -> dict[str, Any]:
    """Figures laid out as in `metrics.json`: the protocols of a figure below its name."""
    out: dict[str, Any] = {}
    for (name, protocol), value in values.items():
        if protocol is None:
            out[name] = value
        else:
            out.setdefault(name, {})[protocol] = value
    return out
