"""PCK, box and keypoint precision and recall over IoU thresholds, in the two protocols.

`pooled` divides sums over the whole split. `paper` is the mean of per-image figures over the images with ground truth,
as in the published table. Ratios with a denominator of 0 are None. keypoint_outcomes.py has the counting rules, and
outcome_counts.py counts per image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.metrics import outcome_counts
from skope.metrics.keypoint_outcomes import MetricOptions, Outcomes
from skope.metrics.match import Matches, match
from skope.metrics.outcome_counts import ratio
from skope.schema import AnnotationFile, Result

__all__ = [
    "MetricOptions",
    "localisation",
    "match_split",
    "named_scores",
    "recall_at_precision",
    "score_split",
    "score_summary",
    "scores_document",
]


@dataclass(frozen=True)
class MetricRules:
    """Thresholds of reported figures."""

    version: int = 1
    """Version of the layout of `metrics.json`."""
    strict_alpha: float = 0.05
    """Second alpha at which PCK is reported."""
    at_precision: tuple[float, float] = (0.9, 0.95)
    """Precisions at which box recall is reported. This recall does not depend on the scale of a detector's scores."""
    area_alpha: float = 0.2
    """Upper limit of alpha for the area under PCK(alpha). The area is divided by this limit, so that 1 is perfect."""


METRIC_RULES: Final = MetricRules()


def scores_document(
    options: MetricOptions,
    splits: Mapping[str, Any],
    *,
    calibrated: bool | None = None,
    scheme: str = keypoints.SCHEME,
    work: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the content of `metrics.json`: the options and the entry of each split.

    Args:
        options: The counting rules.
        splits: Split name -> its entry.
        calibrated: Whether keypoint scores are calibrated probabilities; None for results of another program.
        scheme: Keypoint scheme of the detector.
        work: Input files, version and date, as from `skope.files.output_folders.claim_output`.
    """
    return {
        "version": METRIC_RULES.version,
        "score_threshold": options.score,
        "alpha": options.alpha,
        "labelled": options.labelled,
        "boxes": options.boxes,
        "keypoint_score_threshold": options.keypoint_score,
        "scheme": scheme,
        "points": list(options.points),
        "calibrated": calibrated,
        "of": {name: work[name] for name in ("inputs", "skope", "date")} if work else None,
        "splits": dict(splits),
    }


def score_split(file: AnnotationFile, results: Sequence[Result], options: MetricOptions) -> dict[str, Any]:
    """Match a split and return its counts and, for each IoU threshold, precision, recall and PCK.

    Args:
        file: The ground truth of the split.
        results: Results of a detector, each in an image of `file`.
        options: The counting rules and thresholds.

    Returns:
        The first part of the split's entry in `metrics.json`: "images", "ground_truth", "ignored", "detections", and
        "iou" with the figures by threshold. Ratios with a denominator of 0 are None.

    Raises:
        UserError: `options` need boxes that are not annotated.
    """
    return score_summary(match_split(file, results, options), options)


def match_split(file: AnnotationFile, results: Sequence[Result], options: MetricOptions) -> Matches:
    """Match results to the ground truth with `skope.metrics.match.match`.

    Args:
        file: The ground truth.
        results: Detected vehicles in its images.
        options: The counting rules and thresholds.
    """
    return match(file, results, score=options.score, boxes=options.boxes, thresholds=options.iou)


def score_summary(matches: Matches, options: MetricOptions) -> dict[str, Any]:
    """Return counts of a split and, per IoU threshold, ratios."""
    return {
        "images": matches.images,
        "ground_truth": len(matches.gt_image),
        "ignored": matches.ignored,
        "detections": len(matches.det_image),
        "iou": {f"{t:g}": named_scores(outcome_counts.tally(matches, t, options)) for t in options.iou},
    }


def named_scores(pooled: outcome_counts.ImageCounts) -> dict[str, Any]:
    """Return counts and ratios at one IoU threshold, in the layout of `metrics.json`."""
    names = ("matched", "labelled", "labelled_all", "correct", "predicted", "detections_ignored")
    sums = {name: int(getattr(pooled, name).sum()) for name in names}
    ratios = {name: ratio(top.sum(), bottom.sum()) for name, (top, bottom) in outcome_counts.quotients(pooled).items()}
    return {**sums, **outcome_counts.nested(ratios)}


def localisation(outcomes: Outcomes) -> dict[str, Any]:
    """Return error statistics of the keypoints of matched vehicles, in units of the box's longer edge L."""
    counted = outcomes.labelled & outcomes.found[:, None]
    # For a box of zero size, an error of 0 stays 0 and any other error becomes infinite.
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(outcomes.offset > 0, outcomes.offset / outcomes.length[:, None], 0.0)
    error = np.where(outcomes.predicted, error, np.inf)[counted]
    labelled = int(counted.sum())
    return {
        "labelled": labelled,
        "pck_0.05": ratio(outcomes.correct(METRIC_RULES.strict_alpha).sum(), labelled),
        "pck_area": ratio(np.maximum(METRIC_RULES.area_alpha - error, 0.0).sum() / METRIC_RULES.area_alpha, labelled),
        "median_error": _finite(np.median(error)) if labelled else None,
    }


def _finite(value: Any) -> float | None:
    """Return a value, or None if it is infinite because most keypoints are not predicted."""
    return float(value) if np.isfinite(value) else None


def ranked(matches: Matches, threshold: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return (D,) scores of the counted detections at an IoU threshold, and (D,) whether each matched a vehicle."""
    hit = matches.taken[threshold] >= 0
    counted = hit | ~matches.det_on_ignored
    return matches.det_score[counted], hit[counted]


def recalls(file: AnnotationFile, results: Sequence[Result], options: MetricOptions) -> dict[str, float | None]:
    """Return the box recall at each precision of `METRIC_RULES.at_precision`, at the lowest IoU and any score.

    Args:
        file: The ground truth.
        results: Detected vehicles in its images.
        options: The counting rules and thresholds.

    Returns:
        Recall by precision (as a JSON key); None without vehicles.
    """
    every = match_split(file, results, replace(options, score=0.0, iou=(options.loosest,)))
    scores, hits = ranked(every, options.loosest)
    truth = len(every.vehicles)
    return {f"{p:g}": recall_at_precision(scores, hits, truth, p)["recall"] for p in METRIC_RULES.at_precision}


def recall_at_precision(
    scores: NDArray[np.float64], hit: NDArray[np.bool_], truth: int, precision: float
) -> dict[str, float | None]:
    """Return the highest recall at a given precision, and its score threshold.

    Args:
        scores: (D,) scores of the counted detections.
        hit: (D,) whether each matched a vehicle.
        truth: Number of vehicles.
        precision: Minimum precision, 0 to 1.

    Returns:
        `recall` (0 if the precision is never reached, None without vehicles) and `score`, the highest threshold with
        that recall (None if the precision is never reached, or without vehicles).
    """
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(hit[order])
    # Detections of equal score are accepted together.
    last = np.flatnonzero(np.diff(scores[order], append=-1.0))
    reached = last[hits[last] / (last + 1) >= precision]
    if not truth or not len(reached):
        return {"recall": 0.0 if truth else None, "score": None}
    best = reached[np.argmax(hits[reached])]
    return {"recall": float(hits[best] / truth), "score": float(scores[order][best])}
