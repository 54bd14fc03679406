"""Outcome of each vehicle of a split: the detection that found it, and the correctness of its keypoints."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope import keypoints
from skope.errors import UserError, one_of
from skope.keypoints import Scheme
from skope.metrics.match import BOX_KINDS, Matches
from skope.metrics.thresholds import PAPER_THRESHOLDS
from skope.types import Array, Integers, Mask

PROTOCOL_NAMES: Final = ("pooled", "paper")
LABELLED_CHOICES: Final = ("visible", "all")
"""Choices of the ground-truth keypoints that count: those with v = 2, or all with v > 0."""


@dataclass(frozen=True, kw_only=True)
class MetricOptions:
    """Rules for counting detections and labelled, predicted and correct keypoints."""

    score: float = PAPER_THRESHOLDS.score
    """Score above which a detection counts, 0 to 1."""
    alpha: float = PAPER_THRESHOLDS.alpha
    """Maximum error of a correct keypoint, as a share of the longer edge of the ground-truth box."""
    labelled: str = "visible"
    """Ground-truth keypoints that count, one of `LABELLED_CHOICES`."""
    boxes: str = "full"
    """Boxes of the ground truth that detections are matched to, one of `BOX_KINDS`."""
    iou: tuple[float, ...] = PAPER_THRESHOLDS.iou
    """IoU thresholds for matching, in the order in which they are reported."""
    keypoint_score: float = 0.0
    """Score above which a keypoint counts as predicted. 0 counts all keypoints, as in the paper."""
    points: tuple[int, ...] = tuple(range(keypoints.K))
    """Indices of the evaluated keypoints: all, or those in common with another scheme."""
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
        one_of("--labelled", self.labelled, LABELLED_CHOICES)
        one_of("--boxes", self.boxes, BOX_KINDS)

    @property
    def loosest(self) -> float:
        """Lowest IoU threshold, for figures that are reported at one threshold only."""
        return min(self.iou)


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """Outcomes of the G vehicles of a split at one IoU threshold: matched detections and keypoint errors."""

    detection: Integers
    """(G,) index of the detection in `Matches`, -1 for none."""
    labelled: Mask
    """(G, 33) keypoints that are labelled, by the rule `MetricOptions.labelled`."""
    predicted: Mask
    """(G, 33) keypoints that the detection predicts."""
    offset: Array
    """(G, 33) distances from the prediction to the ground truth, pixels; infinite for vehicles that were not found."""
    length: Array
    """(G,) longer edge of the ground-truth box, pixels."""

    @property
    def found(self) -> Mask:
        """(G,) whether a detection matched the vehicle."""
        return self.detection >= 0

    def correct(self, alpha: float) -> Mask:
        """Return (G, 33) whether a keypoint is labelled, predicted and within `alpha` times the length."""
        return self.labelled & self.predicted & (self.offset <= alpha * self.length[:, None])


def predicted_keypoints(matches: Matches, options: MetricOptions) -> Mask:
    """Return (D, 33) whether each keypoint of each detection counts as predicted."""
    mask = np.zeros((len(matches.det_image), keypoints.K), dtype=bool)
    mask[:, list(options.points)] = True
    return mask & (matches.det_keypoints[:, :, 2] > options.keypoint_score) if options.keypoint_score else mask


def lengths(vectors: Array) -> Array:
    """Return (...,) Euclidean lengths of (..., 2) vectors of pixels.

    This is several times faster than hypot, which avoids overflow of squares. Here such a length becomes infinite, and
    the keypoint is wrong in either case.
    """
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2))


def outcomes_at(matches: Matches, threshold: float, options: MetricOptions) -> Outcomes:
    """Compare each vehicle with its matched detection.

    Args:
        matches: Matched vehicles and detections.
        threshold: The IoU threshold, one of `matches.taken`.
        options: The counting rules.
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
    shown[found] = predicted_keypoints(matches, options)[detection[found]]
    offset = np.full(labelled.shape, np.inf)
    offset[found] = lengths(matches.det_keypoints[detection[found], :, :2] - matches.gt_keypoints[found, :, :2])
    box = matches.gt_boxes_xyxy
    length = (box[:, 2:] - box[:, :2]).max(axis=1, initial=0.0)
    return Outcomes(detection=detection, labelled=labelled, predicted=shown, offset=offset, length=length)
