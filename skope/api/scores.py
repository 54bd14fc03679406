"""Scores of detections against a ground truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from skope.dataset import coco
from skope.detections import apart
from skope.metrics.thresholds import PAPER_THRESHOLDS
from skope.schema import AnnotationFile, AnyResult


def score(
    predictions: str | Path | Sequence[AnyResult],
    annotations: str | Path | AnnotationFile,
    *,
    min_score: float = PAPER_THRESHOLDS.score,
    alpha: float = PAPER_THRESHOLDS.alpha,
    iou: Sequence[float] = PAPER_THRESHOLDS.iou,
) -> Mapping[str, Any]:
    """Measure detections against a ground truth.

    Args:
        predictions: A COCO results file, or its results.
        annotations: A COCO annotation file, or its records (`dataset.read(split)`).
        min_score: A detection counts when it scores above this.
        alpha: A keypoint is correct within this share of the longer edge of its vehicle's box.
        iou: Overlaps at which a detection matches a vehicle.

    Returns:
        A split's entry as in `metrics.json`: counts, and for each IoU ("0.6") `pck`, `box_precision`, `box_recall`,
        `keypoint_precision` and `keypoint_recall`. Each of the last four is `pooled` over all images, and as the
        `paper` counts it. A ratio with a denominator of 0 is None. Where the predictions hold other road users than
        vehicles, `categories` has the figures of those that the ground truth labels, by category and size.

    Raises:
        UserError: A file cannot be read, or the predictions are of other images.
    """
    from skope.metrics import read_inputs
    from skope.metrics.pck_precision_recall import MetricOptions, score_split
    from skope.metrics.road_users import category_figures

    file = annotations if isinstance(annotations, AnnotationFile) else coco.read(Path(annotations))
    given = predictions
    found = read_inputs.read_all_results(Path(given), file) if isinstance(given, str | Path) else given
    vehicles, road_users = apart(found)
    entry = score_split(file, vehicles, MetricOptions(score=min_score, alpha=alpha, iou=tuple(iou)))
    figures = category_figures(file, road_users, score=min_score) if road_users else {}
    return entry | ({"categories": figures} if figures else {})
