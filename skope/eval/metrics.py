"""PCK, box and keypoint precision and recall over IoU thresholds, in the two protocols; numpy alone.

`pooled` divides sums over the whole split. `paper` is the mean, over the images that have ground truth, of each image's
own figures, which is what the published table follows. Ratios without a denominator are None.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.errors import UserError, one_of
from skope.eval.match import BOX_KINDS, THRESHOLDS, Matches, match
from skope.schema import AnnotationFile, Result

VERSION: Final = 1
"""Version of the layout of `metrics.json`."""

PROTOCOLS: Final = ("pooled", "paper")
LABELLED: Final = ("visible", "all")
"""Which ground-truth keypoints count: those with v = 2, or all with v > 0."""

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Options:
    """What counts as a detection, a labelled keypoint and a correct one."""

    score: float = 0.9
    """A detection counts when it scores above this."""
    alpha: float = 0.1
    """A keypoint is correct within alpha times the longer edge of the ground-truth box."""
    labelled: str = "visible"
    boxes: str = "full"

    def __post_init__(self) -> None:
        if not 0 <= self.score <= 1:
            raise UserError(f"--score: expected a number from 0 to 1, got {self.score}")
        if not (math.isfinite(self.alpha) and self.alpha > 0):
            raise UserError(f"--alpha: expected a positive number, got {self.alpha}")
        one_of("--labelled", self.labelled, LABELLED)
        one_of("--boxes", self.boxes, BOX_KINDS)


def document(options: Options, splits: Mapping[str, Any]) -> dict[str, Any]:
    """The whole of `metrics.json` around the figures of each split."""
    return {
        "version": VERSION,
        "score_threshold": options.score,
        "alpha": options.alpha,
        "labelled": options.labelled,
        "splits": dict(splits),
    }


def score_split(file: AnnotationFile, results: Sequence[Result], options: Options) -> dict[str, Any]:
    """One split's counts and, per IoU threshold, ratios; all of its entry in `metrics.json` but `coco` and `by`."""
    matches = match(file, results, score=options.score, boxes=options.boxes)
    return {
        "images": matches.images,
        "ground_truth": len(matches.gt_image),
        "ignored": matches.ignored,
        "detections": len(matches.det_image),
        "iou": {f"{t:g}": figures(matches, t, alpha=options.alpha, labelled=options.labelled) for t in THRESHOLDS},
    }


def figures(matches: Matches, threshold: float, *, alpha: float, labelled: str) -> dict[str, Any]:
    """Counts and ratios at one IoU threshold, laid out as in `metrics.json`."""
    taken = matches.taken[threshold]
    matched = taken >= 0
    mask = labelled_mask(matches, labelled)
    correct = correct_points(matches, taken, mask, alpha)
    counts = {
        "matched": int(matched.sum()),
        "labelled": int(mask[taken[matched]].sum()),
        "labelled_all": int(mask.sum()),
        "correct": int(correct.sum()),
        "detections_ignored": int((~matched & matches.det_on_ignored).sum()),
    }
    pooled = _pooled(counts, len(matches.gt_image), len(matches.det_image))
    paper = _paper(matches, matched, correct)
    ratios = {name: {"paper": paper[name], "pooled": pooled[name]} for name in pooled}
    return {**counts, "pck": ratio(counts["correct"], counts["labelled"]), **ratios}


def labelled_mask(matches: Matches, labelled: str) -> Mask:
    """(G, 33) which ground-truth keypoints count as labelled."""
    least = 2 if one_of("--labelled", labelled, LABELLED) == "visible" else 1
    return np.asarray(matches.gt_keypoints[:, :, 2] >= least)


def correct_points(matches: Matches, taken: Integers, labelled: Mask, alpha: float) -> Integers:
    """(D,) number of each detection's keypoints that are correct; 0 for an unmatched one."""
    detection = np.flatnonzero(taken >= 0)
    truth = taken[detection]
    offset = matches.det_keypoints[detection, :, :2] - matches.gt_keypoints[truth, :, :2]
    box = matches.gt_boxes_xyxy[truth]
    reach = alpha * (box[:, 2:] - box[:, :2]).max(axis=1, initial=0.0)
    near = np.hypot(offset[..., 0], offset[..., 1]) <= reach[:, None]
    correct = np.zeros(len(taken), dtype=np.int64)
    correct[detection] = (near & labelled[truth]).sum(axis=1)
    return correct


def ratio(numerator: float, denominator: float) -> float | None:
    """The quotient, or None where there is nothing to divide by."""
    return numerator / denominator if denominator else None


def _pooled(counts: Mapping[str, int], ground_truth: int, detections: int) -> dict[str, float | None]:
    judged = detections - counts["detections_ignored"]
    return {
        "box_precision": ratio(counts["matched"], judged),
        "box_recall": ratio(counts["matched"], ground_truth),
        "keypoint_precision": ratio(counts["correct"], keypoints.K * judged),
        "keypoint_recall": ratio(counts["correct"], counts["labelled_all"]),
    }


def _paper(matches: Matches, matched: Mask, correct: Integers) -> dict[str, float | None]:
    truths = np.bincount(matches.gt_image, minlength=matches.images)
    judged = truths > 0
    detections = np.bincount(matches.det_image, minlength=matches.images)
    hits = np.bincount(matches.det_image[matched], minlength=matches.images)
    points = np.bincount(matches.det_image, weights=correct, minlength=matches.images)

    def mean(numerator: NDArray[Any], denominator: NDArray[Any]) -> float | None:
        if not judged.any():
            return None
        # Every numerator is 0 where its denominator is: such an image counts as 0.
        return float(np.mean(numerator[judged] / np.maximum(denominator[judged], 1)))

    return {
        "box_precision": mean(hits, detections),
        "box_recall": mean(hits, truths),
        "keypoint_precision": mean(points, keypoints.K * hits),
        # A detected vehicle counts as having all of its keypoints detected.
        "keypoint_recall": mean(hits, hits),
    }
