"""PCK, box and keypoint precision and recall over IoU thresholds, in the two protocols; numpy alone.

`pooled` divides sums over the whole split. `paper` is the mean, over the images that have ground truth, of each image's
own figures, which is what the published table follows. Ratios without a denominator are None.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from skope import keypoints
from skope.metrics import counts
from skope.metrics.counts import Judged, Options, ratio
from skope.metrics.match import Matches, match
from skope.schema import AnnotationFile, Result

__all__ = ["Options", "document", "figures", "localisation", "match_split", "score_split", "summary"]

VERSION: Final = 1
"""Version of the layout of `metrics.json`."""

STRICT_ALPHA: Final = 0.05
"""PCK at this alpha is reported beside the one that was asked for."""
AREA_ALPHA: Final = 0.2
"""The area under PCK(alpha) runs from 0 to this, divided by it: 1 is perfect."""


def document(
    options: Options,
    splits: Mapping[str, Any],
    *,
    calibrated: bool | None = None,
    scheme: str = keypoints.SCHEME,
    work: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The whole of `metrics.json` around the figures of each split.

    `calibrated`: whether keypoint scores are calibrated probabilities, None where another program made them; `scheme`
    is the detector's. `work`: what `outputs.claim` says of the files that were read, the version and the date.
    """
    return {
        "version": VERSION,
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


def score_split(file: AnnotationFile, results: Sequence[Result], options: Options) -> dict[str, Any]:
    """One split's counts and, per IoU threshold, ratios: the beginning of its entry in `metrics.json`."""
    return summary(match_split(file, results, options), options)


def match_split(file: AnnotationFile, results: Sequence[Result], options: Options) -> Matches:
    """Match as `options` say."""
    return match(file, results, score=options.score, boxes=options.boxes, thresholds=options.iou)


def summary(matches: Matches, options: Options) -> dict[str, Any]:
    """Counts of a split and, per IoU threshold, ratios."""
    return {
        "images": matches.images,
        "ground_truth": len(matches.gt_image),
        "ignored": matches.ignored,
        "detections": len(matches.det_image),
        "iou": {f"{t:g}": figures(counts.tally(matches, t, options)) for t in options.iou},
    }


def figures(pooled: counts.Tally) -> dict[str, Any]:
    """Counts and ratios at one IoU threshold, laid out as in `metrics.json`."""
    names = ("matched", "labelled", "labelled_all", "correct", "predicted", "detections_ignored")
    sums = {name: int(getattr(pooled, name).sum()) for name in names}
    ratios = {name: ratio(top.sum(), bottom.sum()) for name, (top, bottom) in counts.quotients(pooled).items()}
    return {**sums, **counts.nested(ratios)}


def localisation(judged: Judged) -> dict[str, Any]:
    """How near the keypoints of matched vehicles are, beyond one alpha; all in units of the box's longer edge L."""
    counted = judged.labelled & judged.found[:, None]
    # A vehicle whose box has no extent can have no error in its units but 0.
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(judged.offset > 0, judged.offset / judged.length[:, None], 0.0)
    error = np.where(judged.predicted, error, np.inf)[counted]
    labelled = int(counted.sum())
    return {
        "labelled": labelled,
        "pck_0.05": ratio(judged.correct(STRICT_ALPHA).sum(), labelled),
        "pck_area": ratio(np.maximum(AREA_ALPHA - error, 0.0).sum() / AREA_ALPHA, labelled),
        "median_error": _finite(np.median(error)) if labelled else None,
    }


def _finite(value: Any) -> float | None:
    """None where most keypoints are not predicted at all."""
    return float(value) if np.isfinite(value) else None
