"""Calibrated scores as part of the weights: the last layers of a detector, scaled and shifted.

A vehicle's score is the sigmoid of the difference of its two logits, a keypoint's that of its heat map's maximum, and
from the last layers to there everything is linear. So a checkpoint whose scores are probabilities is a checkpoint like
any other, for torchvision's own model too.

Where a detector has learnt other categories, each has a scale and an offset of its own, of the difference of its logit
and the background's. Its score is the calibrated one where the background is what it competes with: nearly everywhere.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.models.detection import KeypointRCNN

from skope.detector.score_calibration import ScoreCalibration, fit_one, raw_maxima, sigmoid
from skope.metrics.match import match
from skope.schema import CATEGORY_ID, AnnotationFile, Result
from skope.types import Array

LEAST_SCORE: Final = 0.02
"""Detections above this score are learnt from."""
FOUND_IOU: Final = 0.5
"""A vehicle is found by a detection whose box overlaps its own by so much."""
_LARGEST_LOGIT_GAP: Final = 16.0
"""Largest difference of logits that a score in float32 still tells."""
_FLATTEST: Final = 1e-3
"""Least scale: with 0 the place of a heat map's maximum would be lost, and the order of the vehicles."""


def vehicle_outcomes(file: AnnotationFile, results: Sequence[Result]) -> tuple[Array, NDArray[np.bool_]]:
    """Scores of detections above `LEAST_SCORE` and whether each found a vehicle, (D,) each.

    A second detection of a vehicle found none; those on ignored vehicles are left out.
    """
    matches = match(file, results, score=LEAST_SCORE, thresholds=(FOUND_IOU,))
    right = matches.taken[FOUND_IOU] >= 0
    counts = right | ~matches.det_on_ignored
    return matches.det_score[counts], right[counts]


def fit_boxes(scores: Array, right: NDArray[np.bool_]) -> tuple[float, float]:
    """Scale and offset of the logits of a category's scores, from scores and outcomes (D,)."""
    scale, offset = fit_one(_logits(scores), right)
    return max(scale, _FLATTEST), offset


def calibrated(scores: Array, scale: float, offset: float) -> Array:
    """Calibrate the scores of a category's boxes.

    Args:
        scores: (D,) raw scores, 0 to 1.
        scale: Factor of their logits.
        offset: What is added to it then.

    Returns:
        (D,) calibrated scores.
    """
    return sigmoid(scale * _logits(scores) + offset)


def _logits(scores: Array) -> Array:
    return np.clip(raw_maxima(scores), -_LARGEST_LOGIT_GAP, _LARGEST_LOGIT_GAP)


def fold(model: KeypointRCNN, boxes: Mapping[int, tuple[float, float]], points: ScoreCalibration) -> None:
    """Scale and shift the last layers of a model, in float32, so that its own scores are the calibrated ones.

    Args:
        model: Its box and keypoint predictors are changed in place.
        boxes: Category's id, from 1 -> scale and offset of its logit. The others get the vehicles' scale.
        points: Scale and offset of the keypoints' heat maps; a scale is taken to be `_FLATTEST` at least.
    """
    box, maps = model.roi_heads.box_predictor.cls_score, model.roi_heads.keypoint_predictor.kps_score_lowres
    steepness = torch.as_tensor(np.maximum(points.scale, _FLATTEST), dtype=torch.float32)
    rest = (boxes[CATEGORY_ID][0], 0.0)
    fitted = [(0.0, 0.0), *(boxes.get(number, rest) for number in range(1, len(box.bias)))]
    with torch.no_grad():
        for parameter in (box.weight, box.bias):
            scaled = torch.stack(
                [scale * (row - parameter[0]) for row, (scale, _) in zip(parameter, fitted, strict=True)]
            )
            if parameter is box.bias:
                scaled += torch.tensor([offset for _, offset in fitted])
            # Away from their mean, which changes no score.
            parameter.copy_(scaled - scaled.mean(dim=0))
        maps.weight *= steepness[:, None, None]
        maps.bias.copy_(maps.bias * steepness + torch.as_tensor(points.offset, dtype=torch.float32))
