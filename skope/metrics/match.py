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
"""Boxes of a vehicle that a detection may have to meet: the whole silhouette's, or that of its visible pixels."""


_PAIRS_AT_ONCE: Final = 1 << 20
"""Pairs of boxes that are compared at once, so that memory stays small."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Matches:
    """A split's ground truth (G vehicles), the detections that count (D), and which detection took which vehicle.

    Images are numbered by their place in the file. Ground truth lies in order of image and id, detections in order of
    image, falling score and place in the results file.
    """

    images: int
    """Number of images."""
    ignored: int
    """Number of ignored vehicles."""
    vehicles: tuple[Annotation, ...]
    """The G ground-truth vehicles."""
    gt_image: Integers
    """(G,) number of the image that shows the vehicle."""
    gt_boxes_xyxy: Array
    """(G, 4) boxes of the asked kind, pixels."""
    gt_keypoints: Array
    """(G, 33, 3) x, y, v."""
    det_image: Integers
    """(D,) number of the image that the detection is in."""
    det_result: Integers
    """(D,) index in the results."""
    det_score: Array
    """(D,) scores, 0 to 1."""
    det_keypoints: Array
    """(D, 33, 3) x, y, score."""
    det_on_ignored: Mask
    """(D,) whether the detection lies to half of its area or more inside the box of one ignored vehicle."""
    taken: Mapping[float, Integers]
    """IoU threshold -> (D,) the ground-truth vehicle that each detection took, -1 for none."""


def box_of(annotation: Labelled, kind: str) -> Array:
    """(4,) x, y, width, height of the box of `kind` "full" or "visible"; a UserError where it is not annotated."""
    box = annotation.bbox_visible if kind == "visible" else annotation.bbox
    if box is None:
        raise UserError(f"annotation {annotation.id}: field bbox_visible is missing, which --boxes visible needs")
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

    In order of falling scores (ties: file order) each detection takes the free ground-truth box of highest IoU (ties:
    lowest id), if that IoU reaches the threshold.

    Args:
        file: The ground truth of a split.
        results: Detections, each in an image of `file`.
        score: Detections count that score above this.
        boxes: Which boxes of the ground truth are matched to, one of `BOX_KINDS`.
        thresholds: IoU thresholds; the matching is made anew for each.

    Returns:
        Ground truth, detections and, for each threshold, which detection took which vehicle.

    Raises:
        UserError: `boxes` is no such kind, or a vehicle lacks its box of that kind.
    """
    one_of("--boxes", boxes, BOX_KINDS)
    number = {image.id: i for i, image in enumerate(file.images)}
    place = [number[a.image_id] for a in file.annotations]
    vehicles = [file.annotations[i] for i in np.lexsort(([a.id for a in file.annotations], place))]
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
    """Indices (P,), (P,) and values (P,) of the pairs of one image whose measure is at least `least`.

    The columns of image numbers are sorted, so that the boxes of `b` that share an image with one of `a` are a range.
    """
    first = np.searchsorted(b_image, a_image, side="left")
    counts = np.searchsorted(b_image, a_image, side="right") - first
    ends = np.cumsum(counts)
    rows, columns, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    start = 0
    while start < len(a_image):  # in parts, so that memory stays small
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
    """(D,) ground truth taken by each detection, -1 for none, from the pairs that overlap."""
    taken, free = [-1] * detections, [True] * truths
    # Detections stand in the order in which they choose, ground truth by id: sorting the pairs by detection, falling
    # IoU and ground truth lists each one's choices from its best, ties to the lowest id.
    enough = np.flatnonzero(iou >= threshold)
    order = enough[np.lexsort((gt[enough], -iou[enough], det[enough]))]
    for d, g in zip(det[order].tolist(), gt[order].tolist(), strict=True):
        if free[g] and taken[d] < 0:
            taken[d] = g
            free[g] = False
    return np.array(taken, dtype=np.int64)
