"""Reliability of keypoint scores: calibration, separation of visible and hidden keypoints, precision over recall.

A keypoint's score is taken as the probability that the keypoint is visible and within alpha L. It is compared with the
observed share among matched detections. The score of the vehicle, not of its keypoints, covers its existence.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skope.metrics.keypoint_outcomes import MetricOptions, Outcomes, predicted_keypoints
from skope.metrics.match import Matches
from skope.metrics.outcome_counts import ratio
from skope.types import Array, Integers, Mask


@dataclass(frozen=True)
class ReliabilityBins:
    """Resolution of the reliability diagram and the precision curve."""

    score_bins: int = 10
    """Number of bins of the reliability diagram."""
    curve_points: int = 101
    """Number of recalls at which precision is reported."""


RELIABILITY_BINS: Final = ReliabilityBins()


def confidence(matches: Matches, outcomes: Outcomes, options: MetricOptions) -> dict[str, Any]:
    """Return the entry `confidence` of a split in `metrics.json`.

    Scores of other programs may be logits or visibilities. If any is outside 0 to 1, they are used only as an order.

    Args:
        matches: Matched vehicles and detections.
        outcomes: Outcomes of the vehicles at one IoU threshold.
        options: The counting rules.
    """
    found = outcomes.found
    points = np.array(options.points, dtype=np.intp)
    score = matches.det_keypoints[outcomes.detection[found]][:, points, 2]
    v = matches.gt_keypoints[found][:, points, 2]
    offset, reach = outcomes.offset[found][:, points], options.alpha * outcomes.length[found, None]
    right = (v == 2) & (offset <= reach)
    probabilities = bool(((score >= 0) & (score <= 1)).all())
    table = reliability(score.ravel(), right.ravel()) if probabilities else []
    return {
        "points": int(score.size),
        "right": int(right.sum()),
        "reliability": table,
        "calibration_error": calibration_error(table),
        "auc_visible": auc(score[v == 2], score[v == 1]),
        "visible": int((v == 2).sum()),
        "hidden": int((v == 1).sum()),
        **_average_precision(matches, outcomes, options),
    }


def reliability(score: Array, right: Mask) -> list[dict[str, Any]]:
    """Return the reliability diagram: the share of right keypoints in each bin of scores.

    Args:
        score: (N,) scores from 0 to 1.
        right: (N,) whether the keypoint is visible and within alpha L.

    Returns:
        A row for each non-empty bin: "from" and "to", "count", mean "score", and the share that is "right".
    """
    bin_index = np.minimum((score * RELIABILITY_BINS.score_bins).astype(np.int64), RELIABILITY_BINS.score_bins - 1)
    rows = []
    for i in np.unique(bin_index):
        inside = bin_index == i
        rows.append(
            {
                "from": i / RELIABILITY_BINS.score_bins,
                "to": (i + 1) / RELIABILITY_BINS.score_bins,
                "count": int(inside.sum()),
                "score": float(score[inside].mean()),
                "right": float(right[inside].mean()),
            }
        )
    return rows


def calibration_error(table: list[dict[str, Any]]) -> float | None:
    """Return the expected calibration error (Naeini et al., 2015) of a table of `reliability`; None if it is empty.

    It is the mean difference between the mean score of a bin and its share of right keypoints, weighted by count.
    """
    total = sum(row["count"] for row in table)
    return ratio(sum(row["count"] * abs(row["score"] - row["right"]) for row in table), total)


def auc(positive: Array, negative: Array) -> float | None:
    """Return the probability that a positive outscores a negative, with ties as half (Mann and Whitney).

    None if there are no positives or no negatives.
    """
    if not positive.size or not negative.size:
        return None
    ordered = np.sort(negative)
    below = np.searchsorted(ordered, positive, side="left") + np.searchsorted(ordered, positive, side="right")
    return float(below.mean() / 2 / negative.size)


def _average_precision(matches: Matches, outcomes: Outcomes, options: MetricOptions) -> dict[str, Any]:
    """Return precision over recall of keypoints by decreasing score. Keypoints of false positives are wrong.

    Recall is relative to all labelled keypoints, including those of missed vehicles. Keypoints that are not labelled
    are wrong, as in pooled keypoint precision.
    """
    right = np.zeros((len(matches.det_image), matches.gt_keypoints.shape[1]), dtype=bool)
    right[outcomes.detection[outcomes.found]] = outcomes.correct(options.alpha)[outcomes.found]
    taken = np.zeros(len(right), dtype=bool)
    taken[outcomes.detection[outcomes.found]] = True
    counted = predicted_keypoints(matches, options) & (taken | ~matches.det_on_ignored)[:, None]
    recall, precision = curve(matches.det_keypoints[..., 2][counted], right[counted], int(outcomes.labelled.sum()))
    return {
        "average_precision": float(precision.mean()) if recall.size else None,
        "precision_at_recall": precision.tolist(),
    }


def curve(score: Array, right: Mask, total: int) -> tuple[Array, Array]:
    """Return precision over recall as in COCO: the best precision at each recall or at any higher recall.

    Args:
        score: (N,) scores of the predictions. Equal scores are accepted together.
        right: (N,) whether each is right.
        total: Number of ground-truth items.

    Returns:
        (101,) recalls 0, 0.01, ... 1 and (101,) precisions; both empty if `total` is 0.
    """
    if not total:
        return np.zeros(0), np.zeros(0)
    recalls = np.linspace(0, 1, RELIABILITY_BINS.curve_points)
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(right[order])
    last: Integers = (
        np.flatnonzero(np.append(np.diff(score[order]) != 0, True)) if len(order) else np.zeros(0, np.int64)
    )
    precision = np.maximum.accumulate((hits[last] / (last + 1))[::-1])[::-1]
    index = np.searchsorted(hits[last] / total, recalls, side="left")
    return recalls, np.append(precision, 0.0)[np.minimum(index, len(precision))]
