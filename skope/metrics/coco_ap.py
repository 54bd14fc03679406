"""COCO average precision of boxes and keypoints (object keypoint similarity), through pycocotools."""

import contextlib
import io
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints, schema
from skope.metrics.counts import Options
from skope.metrics.match import box_of
from skope.schema import Annotation, AnnotationFile, Result

MAX_DETECTIONS: Final = 300
"""Detections an image that count; pycocotools' own default for keypoints, 20, is fewer than a queue has vehicles."""
NO_PRECISION: Final = dict.fromkeys(("box_ap", "box_ap50", "keypoint_ap", "keypoint_ap50"))
"""What is reported where results leave out what scores low: AP of those would mean nothing."""


def average_precision(file: AnnotationFile, results: Sequence[Result], options: Options) -> dict[str, float | None]:
    """COCO's average precision of boxes (by IoU) and of keypoints (by object keypoint similarity).

    An ignored vehicle is a COCO crowd region: a detection on it is neither right nor wrong. To the keypoint figures a
    vehicle without a labelled keypoint is one too.

    Args:
        file: The ground truth of a split.
        results: All detections, whatever they score; `MAX_DETECTIONS` an image count.
        options: Only labelled, boxes, points and scheme play a part.

    Returns:
        "box_ap" and "keypoint_ap", means over thresholds from 0.50 to 0.95, and "box_ap50" and "keypoint_ap50", at
        0.50. None without ground truth.
    """
    left_out = ~np.isin(np.arange(keypoints.K), options.points)
    truth = [_truth_row(annotation, options, left_out) for annotation in file.annotations]
    found = [_result_row(i, result) for i, result in enumerate(results, start=1)]
    images = [{"id": image.id, "width": image.width, "height": image.height} for image in file.images]
    sigmas = options.scheme.sigmas
    box, box50 = _ap(images, truth, found, "bbox", sigmas)
    points, points50 = _ap(images, truth, found, "keypoints", sigmas)
    return {"box_ap": box, "box_ap50": box50, "keypoint_ap": points, "keypoint_ap50": points50}


def _truth_row(annotation: Annotation, options: Options, left_out: NDArray[np.bool_]) -> dict[str, Any]:
    points = annotation.keypoints.copy()
    hidden_too = options.labelled == "all"
    unlabelled = points[:, 2] < (1 if hidden_too else 2)
    # A crowd region has a box and no points of its own.
    points[unlabelled | left_out | annotation.ignored] = 0.0
    box = box_of(annotation, options.boxes)
    area = annotation.area_full if annotation.area_full is not None else annotation.area
    return {
        # pycocotools takes id 0 for "matched nothing".
        "id": annotation.id + 1,
        "image_id": annotation.image_id,
        "category_id": schema.CATEGORY_ID,
        "iscrowd": annotation.iscrowd,
        "bbox": box.tolist(),
        "area": float(area or box[2] * box[3]),
        "keypoints": points.ravel().tolist(),
        "num_keypoints": int((points[:, 2] > 0).sum()),
    }


def _result_row(number: int, result: Result) -> dict[str, Any]:
    x, y, width, height = result.bbox.tolist()
    width, height = max(width, 0.0), max(height, 0.0)
    return {
        "id": number,
        "image_id": result.image_id,
        "category_id": schema.CATEGORY_ID,
        "iscrowd": 0,
        "bbox": [x, y, width, height],
        "area": width * height,
        "keypoints": result.keypoints.ravel().tolist(),
        "score": float(result.score),
    }


def _ap(
    images: list[dict[str, Any]],
    truth: list[dict[str, Any]],
    found: list[dict[str, Any]],
    kind: str,
    sigmas: Sequence[float],
) -> tuple[float | None, float | None]:
    from pycocotools.cocoeval import COCOeval

    # pycocotools prints as it goes, and squares of far-off keypoints overflow in it.
    with contextlib.redirect_stdout(io.StringIO()), np.errstate(over="ignore"):
        evaluation = COCOeval(_index(images, truth), _index(images, found), iouType=kind)
        evaluation.params.maxDets = [MAX_DETECTIONS]
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [[0.0, 1e10]], ["all"]
        evaluation.params.kpt_oks_sigmas = np.array(sigmas)
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"]  # (IoU thresholds, recalls, categories, areas, maxDets), -1 for none
    return _mean(precision), _mean(precision[:1])


def _index(images: list[dict[str, Any]], annotations: list[dict[str, Any]]) -> Any:
    """A pycocotools COCO object made directly: its `loadRes` crashes on an empty list."""
    from pycocotools.coco import COCO

    coco = COCO()
    # Copies, because evaluation writes into the rows.
    coco.dataset = {
        "images": images,
        "annotations": [dict(row) for row in annotations],
        "categories": [{"id": schema.CATEGORY_ID, "name": "vehicle"}],
    }
    coco.createIndex()
    return coco


def _mean(precision: Any) -> float | None:
    """Mean of the precisions that pycocotools could tell; it writes -1 for the others."""
    told = precision[precision > -1]
    return float(told.mean()) if told.size else None
