"""COCO average precision of boxes and keypoints (object keypoint similarity), computed by pycocotools."""

import contextlib
import io
from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from skope import keypoints, schema
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.match import box_of
from skope.schema import Annotation, AnnotationFile, Found, Labelled, Result

AP_DETECTIONS: Final = 300
"""Maximum number of counted detections per image. The default of pycocotools for keypoints, 20, is too low for a
queue."""
NO_PRECISION: Final = dict.fromkeys(("box_ap", "box_ap50", "keypoint_ap", "keypoint_ap50"))
"""Figures of results without low scores, for which AP is not meaningful."""
_WHATEVER_SIZE: Final = {"all": (0.0, 1e10)}

CocoRow: TypeAlias = dict[str, Any]


def average_precision(
    file: AnnotationFile, results: Sequence[Result], options: MetricOptions
) -> dict[str, float | None]:
    """Return COCO's average precision of boxes (by IoU) and of keypoints (by object keypoint similarity).

    An ignored vehicle is a COCO crowd region: a detection on it is neither right nor wrong. For the keypoint figures
    the same applies to a vehicle without a labelled keypoint.

    Args:
        file: The ground truth of a split.
        results: All detections, of any score. At most `AP_DETECTIONS` per image count.
        options: Only labelled, boxes, points and scheme are used.

    Returns:
        "box_ap" and "keypoint_ap", means over thresholds from 0.50 to 0.95, and "box_ap50" and "keypoint_ap50", at
        0.50. None without ground truth.
    """
    left_out = ~np.isin(np.arange(keypoints.K), options.points)
    truth = [_truth_row(annotation, options, left_out) for annotation in file.annotations]
    found = [_result_row(i, result) for i, result in enumerate(results, start=1)]
    images = [{"id": image.id, "width": image.width, "height": image.height} for image in file.images]
    sigmas = options.scheme.sigmas
    box, box50 = _ap(evaluated(images, truth, found, "bbox", _WHATEVER_SIZE, sigmas))
    points, points50 = _ap(evaluated(images, truth, found, "keypoints", _WHATEVER_SIZE, sigmas))
    return {"box_ap": box, "box_ap50": box50, "keypoint_ap": points, "keypoint_ap50": points50}


def _truth_row(annotation: Annotation, options: MetricOptions, left_out: NDArray[np.bool_]) -> dict[str, Any]:
    points = annotation.keypoints.copy()
    hidden_too = options.labelled == "all"
    unlabelled = points[:, 2] < (1 if hidden_too else 2)
    # A crowd region has a box and no points of its own.
    points[unlabelled | left_out | annotation.ignored] = 0.0
    return {
        **truth_box(annotation, options.boxes),
        "keypoints": points.ravel().tolist(),
        "num_keypoints": int((points[:, 2] > 0).sum()),
    }


def _result_row(number: int, result: Result) -> dict[str, Any]:
    return {**found_box(number, result), "keypoints": result.keypoints.ravel().tolist()}


def truth_box(label: Labelled, kind: str) -> CocoRow:
    """Return a label's box of `kind` (see `match.BOX_KINDS`) in the format of pycocotools, in a common category."""
    box = box_of(label, kind)
    area = label.area_full if label.area_full is not None else label.area
    return {
        # pycocotools takes id 0 for "matched nothing".
        "id": label.id + 1,
        "image_id": label.image_id,
        "category_id": schema.CATEGORY_ID,
        "iscrowd": label.iscrowd,
        "bbox": box.tolist(),
        "area": float(area or box[2] * box[3]),
    }


def found_box(number: int, result: Found) -> CocoRow:
    """Return the box of a result with a `number` from 1 in the format of pycocotools, in a common category."""
    x, y, width, height = result.bbox.tolist()
    width, height = max(width, 0.0), max(height, 0.0)
    return {
        "id": number,
        "image_id": result.image_id,
        "category_id": schema.CATEGORY_ID,
        "iscrowd": 0,
        "bbox": [x, y, width, height],
        "area": width * height,
        "score": float(result.score),
    }


def evaluated(
    images: list[CocoRow],
    truth: list[CocoRow],
    found: list[CocoRow],
    kind: str,
    areas: Mapping[str, Sequence[float]],
    sigmas: Sequence[float] = (),
) -> Any:
    """Return pycocotools' COCOeval of one category, evaluated and accumulated.

    Args:
        images: Rows with "id", "width" and "height".
        truth: Rows of the ground truth, as from `truth_box`.
        found: Rows of results, as from `found_box`.
        kind: "bbox" or "keypoints".
        areas: Smallest and largest area of each range of sizes by name, square pixels.
        sigmas: Standard deviations of the keypoints, for object keypoint similarity.
    """
    from pycocotools.cocoeval import COCOeval

    # pycocotools prints as it goes, and squares of far-off keypoints overflow in it.
    with contextlib.redirect_stdout(io.StringIO()), np.errstate(over="ignore"):
        evaluation = COCOeval(_index(images, truth), _index(images, found), iouType=kind)
        evaluation.params.maxDets = [AP_DETECTIONS]
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [list(a) for a in areas.values()], list(areas)
        evaluation.params.kpt_oks_sigmas = np.array(sigmas)
        evaluation.evaluate()
        evaluation.accumulate()
    return evaluation


def _ap(evaluation: Any) -> tuple[float | None, float | None]:
    """Return AP and AP50 over all sizes."""
    precision = evaluation.eval["precision"]  # (IoU thresholds, recalls, categories, areas, maxDets), -1 for none
    return mean_precision(precision), mean_precision(precision[:1])


def _index(images: list[CocoRow], annotations: list[CocoRow]) -> Any:
    """Return a COCO object of pycocotools that is built directly, because `loadRes` crashes on an empty list."""
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


def mean_precision(precision: Any) -> float | None:
    """Return the mean of the available precisions; pycocotools writes -1 for the others."""
    known = precision[precision > -1]
    return float(known.mean()) if known.size else None
