"""Figures of pedestrians and two-wheelers by category and size, from boxes only, computed by pycocotools.

They are separate from those of vehicles: a detection of one category never counts for or against another category.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from skope.metrics.coco_ap import CocoRow, evaluated, found_box, mean_precision, truth_box
from skope.metrics.outcome_counts import ratio
from skope.schema import CATEGORY_NAMES, AnnotationFile, RoadUserResult
from skope.types import Array, Mask

AP50_IOU: Final = 0.5
"""IoU threshold for matching, as in AP50."""


def category_figures(
    file: AnnotationFile,
    results: Sequence[RoadUserResult],
    *,
    score: float,
    boxes: str = "full",
    all_scores: bool = True,
    known: Sequence[str] = CATEGORY_NAMES,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return AP, precision and recall of each labelled category except vehicles, by COCO's sizes.

    An ignored road user is a COCO crowd region of its category. An unmatched detection with half of its area on it is
    neither right nor wrong. At most the 300 best results of a category count per image.

    Args:
        file: The ground truth of a split.
        results: Results of a detector, in images of `file`.
        score: Score above which detections count for precision and recall.
        boxes: Kind of ground-truth boxes for matching, one of `match.BOX_KINDS`.
        all_scores: Whether `results` include the lowest scores of the detector. Otherwise AP is None.
        known: Categories that the detector has learnt; others are omitted.

    Returns:
        Category -> size ("all", "small", "medium" or "large", by area: under 32 x 32, under 96 x 96 pixels) -> the
        counts "ground_truth", "ignored", "detections" and "matched", and "precision", "recall", "ap" and "ap50", which
        are None if the denominator is 0.
    """
    names = [name for name in file.categories[1:] if name in known]
    return {name: _by_size(*_rows(file, results, name, boxes), score, all_scores=all_scores) for name in names}


def _rows(
    file: AnnotationFile, results: Sequence[RoadUserResult], name: str, boxes: str
) -> tuple[list[CocoRow], list[CocoRow], list[CocoRow]]:
    """Return images, ground truth and results of one category in the format of pycocotools."""
    images = [{"id": image.id, "width": image.width, "height": image.height} for image in file.images]
    truth = [truth_box(user, boxes) for user in file.road_users if user.category == name]
    category_results = [result for result in results if result.category == name]
    return images, truth, [found_box(i, result) for i, result in enumerate(category_results, start=1)]


def _at_ap50(evaluation: Any) -> int:
    """Return the index of the IoU threshold of AP50 in an evaluation."""
    return int(np.flatnonzero(np.isclose(evaluation.params.iouThrs, AP50_IOU))[0])


def box_outcomes(
    file: AnnotationFile, results: Sequence[RoadUserResult], name: str, *, boxes: str = "full"
) -> tuple[Array, Mask]:
    """Return scores of the results of one category other than vehicles, and whether each matched at IoU 0.5.

    Unmatched results on ignored road users are omitted, and so are results of an image beyond the best 300.

    Args:
        file: The ground truth of a split.
        results: Results of a detector in images of `file`, of any categories.
        name: The category.
        boxes: Kind of ground-truth boxes for matching, one of `match.BOX_KINDS`.

    Returns:
        (D,) scores and (D,) whether each result matched a road user.
    """
    evaluation = evaluated(*_rows(file, results, name, boxes), "bbox", {"all": (0.0, 1e10)})
    at = _at_ap50(evaluation)
    rows = [row for row in evaluation.evalImgs if row is not None]
    scores = np.concatenate([np.zeros(0), *(row["dtScores"] for row in rows)])
    right = np.concatenate([np.zeros(0, dtype=bool), *(np.asarray(row["dtMatches"][at]) > 0 for row in rows)])
    left_out = np.concatenate([np.zeros(0, dtype=bool), *(np.asarray(row["dtIgnore"][at], dtype=bool) for row in rows)])
    return scores[~left_out], right[~left_out]


def _by_size(
    images: list[CocoRow],
    truth: list[CocoRow],
    found: list[CocoRow],
    score: float,
    *,
    all_scores: bool,
) -> dict[str, dict[str, Any]]:
    """Return the figures of one category by size."""
    from pycocotools.cocoeval import Params

    params = Params(iouType="bbox")
    areas = dict(zip(params.areaRngLbl, params.areaRng, strict=True))
    evaluation = evaluated(images, truth, found, "bbox", areas)
    at = _at_ap50(evaluation)
    precision = evaluation.eval["precision"]  # (IoU thresholds, recalls, categories, areas, maxDets), -1 for none
    out = {}
    for i, (size, area) in enumerate(areas.items()):
        of_images = [row for row in evaluation.evalImgs if row is not None and row["aRng"] == list(area)]
        counts = _counts(of_images, at, score)
        out[size] = {
            "ignored": sum(row["iscrowd"] and area[0] <= row["area"] <= area[1] for row in truth),
            **counts,
            "precision": ratio(counts["matched"], counts["detections"]),
            "recall": ratio(counts["matched"], counts["ground_truth"]),
            "ap": mean_precision(precision[:, :, :, i]) if all_scores else None,
            "ap50": mean_precision(precision[at, :, :, i]) if all_scores else None,
        }
    return out


def _counts(of_images: Sequence[dict[str, Any]], at: int, score: float) -> dict[str, int]:
    """Return counts over pycocotools' rows of all images at the IoU threshold with index `at`."""
    counts = dict.fromkeys(("ground_truth", "detections", "matched"), 0)
    for row in of_images:
        counts["ground_truth"] += int((np.asarray(row["gtIgnore"]) == 0).sum())
        counted = (np.asarray(row["dtScores"]) > score) & ~np.asarray(row["dtIgnore"][at], dtype=bool)
        counts["detections"] += int(counted.sum())
        counts["matched"] += int((counted & (np.asarray(row["dtMatches"][at]) > 0)).sum())
    return counts
