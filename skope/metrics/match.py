"""Greedy matching of detections to ground-truth vehicles, once per IoU threshold.

Metrics are pure functions of the `Matches` made here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope import boxes as box_math
from skope import keypoints
from skope.errors import UserError, one_of
from skope.metrics.thresholds import PAPER_THRESHOLDS
from skope.schema import Annotation, AnnotationFile, Labelled, Result
from skope.types import Array, Integers, Mask

BOX_KINDS: Final = ("full", "visible")
"""Kinds of ground-truth boxes for matching: of the whole silhouette, or of its visible pixels."""


_PAIRS_AT_ONCE: Final = 1 << 20
"""Number of pairs of boxes that are compared at once. It bounds memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Matches:
    """Ground truth of a split (G vehicles), the counted detections (D), and the matches between them.

    Images are numbered by their order in the file. Ground truth is ordered by image and id. Detections are ordered by
    image, decreasing score and order in the results file.
    """

    images: int
    """Number of images."""
    ignored: int
    """Number of ignored vehicles."""
    vehicles: tuple[Annotation, ...]
    """The G ground-truth vehicles."""
    gt_image: Integers
    """(G,) number of the image of each vehicle."""
    gt_boxes_xyxy: Array
    """(G, 4) boxes of the requested kind, pixels."""
    gt_keypoints: Array
    """(G, 33, 3) x, y, v."""
    det_image: Integers
    """(D,) number of the image of each detection."""
    det_result: Integers
    """(D,) index in the results."""
    det_score: Array
    """(D,) scores, 0 to 1."""
    det_keypoints: Array
    """(D, 33, 3) x, y, score."""
    det_on_ignored: Mask
    """(D,) whether at least half of the detection's area is inside the box of one ignored vehicle."""
    taken: Mapping[float, Integers]
    """IoU threshold -> (D,) index of the ground-truth vehicle that each detection matched, -1 for none."""


def box_of(annotation: Labelled, kind: str) -> Array:
    """Return (4,) x, y, width, height of the box of `kind` "full" or "visible".

    Raises:
        UserError: The annotation has no such box.
    """
    box = annotation.bbox_visible if kind == "visible" else annotation.bbox
    if box is None:
        raise UserError(f"annotation {annotation.id}: field bbox_visible is missing; --boxes visible needs it")
    return box


def match(
    file: AnnotationFile,
    results: Sequence[Result],
    *,
    score: float = PAPER_THRESHOLDS.score,
    boxes: str = "full",
    thresholds: Sequence[float] = PAPER_THRESHOLDS.iou,
) -> Matches:
    """Match detections to ground-truth vehicles, image by image and greedily.

    In order of decreasing scores (ties: order in `results`), each detection is matched to the free ground-truth box of
    highest IoU (ties: lowest id), if that IoU reaches the threshold.

    Args:
        file: The ground truth of a split.
        results: Detections, each in an image of `file`.
        score: Score above which detections count.
        boxes: Kind of ground-truth boxes for matching, one of `BOX_KINDS`.
        thresholds: IoU thresholds. Matching is repeated for each of them.

    Returns:
        Ground truth, detections and, for each threshold, the matches.

    Raises:
        UserError: `boxes` is not one of `BOX_KINDS`, or a vehicle has no box of that kind.
    """
    one_of("--boxes", boxes, BOX_KINDS)
    number = {image.id: i for i, image in enumerate(file.images)}
    image_numbers = [number[a.image_id] for a in file.annotations]
    vehicles = [file.annotations[i] for i in np.lexsort(([a.id for a in file.annotations], image_numbers))]
    truth = [a for a in vehicles if not a.ignored]
    ignored = [a for a in vehicles if a.ignored]
    image = np.array([number[r.image_id] for r in results], dtype=np.int64)
    scores = np.array([r.score for r in results], dtype=np.float64)
    order = np.lexsort((-scores, image))
    order = order[scores[order] > score]
    counted = [results[i] for i in order]

    gt_image = np.array([number[a.image_id] for a in truth], dtype=np.int64)
    gt_boxes = _xyxy([box_of(a, boxes) for a in truth])
    det_image = image[order]
    det_boxes = _xyxy([r.bbox for r in counted])
    ignored_image = np.array([number[a.image_id] for a in ignored], dtype=np.int64)
    ignored_boxes = _xyxy([box_of(a, boxes) for a in ignored])

    on_ignored, _, _ = _pairs(det_image, det_boxes, ignored_image, ignored_boxes, box_math.share_inside_each, least=0.5)
    overlaps = _pairs(det_image, det_boxes, gt_image, gt_boxes, box_math.iou_each, least=min(thresholds))
    return Matches(
        images=len(file.images),
        ignored=len(ignored),
        vehicles=tuple(truth),
        gt_image=gt_image,
        gt_boxes_xyxy=gt_boxes,
        gt_keypoints=_keypoints([a.keypoints for a in truth]),
        det_image=det_image,
        det_result=order,
        det_score=scores[order],
        det_keypoints=_keypoints([r.keypoints for r in counted]),
        det_on_ignored=np.isin(np.arange(len(counted)), on_ignored),
        taken={t: _greedy(len(counted), len(truth), *overlaps, t) for t in thresholds},
    )


def _xyxy(boxes_xywh: list[Array]) -> Array:
    return box_math.xywh_to_xyxy(np.array(boxes_xywh, dtype=np.float64).reshape(-1, 4))


def _keypoints(points: list[Array]) -> Array:
    return np.array(points, dtype=np.float64).reshape(-1, keypoints.K, 3)


def _pairs(
    a_image: Integers,
    a_boxes: Array,
    b_image: Integers,
    b_boxes: Array,
    measure: Callable[[Array, Array], Array],
    *,
    least: float,
) -> tuple[Integers, Integers, Array]:
    """Return indices (P,), (P,) and values (P,) of the pairs in the same image with a measure of at least `least`.

    Image numbers are sorted, so the boxes of `b` in the image of a box of `a` are a contiguous range.
    """
    first = np.searchsorted(b_image, a_image, side="left")
    counts = np.searchsorted(b_image, a_image, side="right") - first
    ends = np.cumsum(counts)
    rows, columns, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    start = 0
    while start < len(a_image):  # in parts, to bound memory
        begun = ends[start] - counts[start]
        stop = max(start + 1, int(np.searchsorted(ends, begun + _PAIRS_AT_ONCE, side="right")))
        n = counts[start:stop]
        row = np.repeat(np.arange(start, stop), n)
        column = np.arange(n.sum()) + np.repeat(first[start:stop] - (ends[start:stop] - n - begun), n)
        value = measure(a_boxes[row], b_boxes[column])
        keep = value >= least
        rows.append(row[keep])
        columns.append(column[keep])
        values.append(value[keep])
        start = stop
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def _greedy(detections: int, truths: int, det: Integers, gt: Integers, iou: Array, threshold: float) -> Integers:
    """Return (D,) the ground truth matched by each detection, -1 for none, from the pairs that overlap."""
    taken, free = [-1] * detections, [True] * truths
    # Detections are in order of choice and ground truth in order of id. Sorting the pairs by detection, decreasing IoU
    # and ground truth lists the choices of each detection, best first, ties by lowest id.
    enough = np.flatnonzero(iou >= threshold)
    order = enough[np.lexsort((gt[enough], -iou[enough], det[enough]))]
    for d, g in zip(det[order].tolist(), gt[order].tolist(), strict=True):
        if free[g] and taken[d] < 0:
            taken[d] = g
            free[g] = False
    return np.array(taken, dtype=np.int64)
