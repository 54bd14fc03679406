"""`skope eval calibrate-scores`: fit a checkpoint's scores to the ground truth of a dataset that it was not trained on.

Calibrated scores become part of the weights. A vehicle's score is the sigmoid of the difference of its two logits; a
keypoint's score is the sigmoid of the maximum of its heat map. Both are linear in the last layer. Scaling and shifting
that layer gives an ordinary checkpoint, also for torchvision's own model.

Other categories have their own scale and offset of the difference between their logit and that of the background. The
calibrated score of a category is exact where only the background competes with it, which is nearly everywhere.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.models.detection import KeypointRCNN

from skope.dataset.image_selection import held_back, ignoring, last_frames
from skope.detections import apart
from skope.detector import score_calibration
from skope.detector.checkpoint import checkpoint_bytes, find_checkpoint, load_weights
from skope.detector.network_settings import Settings
from skope.detector.predictor import CALIBRATED_KEY, Predictor
from skope.detector.score_calibration import CALIBRATION_RULES, ScoreCalibration, fit_logistic, raw_maxima, sigmoid
from skope.detector.weights import shipped
from skope.errors import UserError
from skope.files.output_folders import check_file, work_of, write_new
from skope.metrics import read_inputs, score_reliability
from skope.metrics.keypoint_outcomes import MetricOptions, outcomes_at
from skope.metrics.match import match
from skope.metrics.road_users import box_outcomes
from skope.schema import CATEGORY_ID, AnnotationFile, Result, RoadUserResult
from skope.terminal.console import Console
from skope.types import Array


@dataclass(frozen=True)
class CalibrationFit:
    """Limits of the calibration fit."""

    least_score: float = 0.02
    """Score threshold of the detections that are used."""
    found_iou: float = 0.5
    """Minimum IoU for a detection to match a vehicle."""
    largest_logit_gap: float = 16.0
    """Maximum difference of logits that a float32 score resolves."""
    least_scale: float = 1e-3
    """Minimum scale. With 0, the position of a heat map's maximum and the order of vehicles would be lost."""
    least_outcomes: int = 20
    """Minimum number of correct and of wrong detections for a category's own calibration."""


CALIBRATION_FIT: Final = CalibrationFit()


def vehicle_outcomes(file: AnnotationFile, results: Sequence[Result]) -> tuple[Array, NDArray[np.bool_]]:
    """Return (D,) scores above `CALIBRATION_FIT.least_score`, and (D,) whether each detection matched a vehicle.

    A second detection of a vehicle is not a match. Detections on ignored vehicles are excluded.
    """
    matches = match(file, results, score=CALIBRATION_FIT.least_score, thresholds=(CALIBRATION_FIT.found_iou,))
    right = matches.taken[CALIBRATION_FIT.found_iou] >= 0
    counts = right | ~matches.det_on_ignored
    return matches.det_score[counts], right[counts]


def fit_boxes(scores: Array, right: NDArray[np.bool_]) -> tuple[float, float]:
    """Return scale and offset of the logits of a category's scores, from scores and outcomes (D,)."""
    scale, offset = fit_logistic(_logits(scores), right)
    return max(scale, CALIBRATION_FIT.least_scale), offset


def calibrated(scores: Array, scale: float, offset: float) -> Array:
    """Calibrate the scores of a category's boxes.

    Args:
        scores: (D,) raw scores, 0 to 1.
        scale: Factor of their logits.
        offset: Value added after scaling.

    Returns:
        (D,) calibrated scores.
    """
    return sigmoid(scale * _logits(scores) + offset)


def _logits(scores: Array) -> Array:
    return np.clip(raw_maxima(scores), -CALIBRATION_FIT.largest_logit_gap, CALIBRATION_FIT.largest_logit_gap)


def fold(model: KeypointRCNN, boxes: Mapping[int, tuple[float, float]], points: ScoreCalibration) -> None:
    """Scale and shift the last layers of a model, in float32, so that its scores are calibrated.

    Args:
        model: Its box and keypoint predictors are changed in place.
        boxes: Category id, from 1, to scale and offset of its logit. Other categories get the scale of vehicles.
        points: Scale and offset of the keypoints' heat maps; the scale is at least `CALIBRATION_FIT.least_scale`.
    """
    box, maps = model.roi_heads.box_predictor.cls_score, model.roi_heads.keypoint_predictor.kps_score_lowres
    steepness = torch.as_tensor(np.maximum(points.scale, CALIBRATION_FIT.least_scale), dtype=torch.float32)
    rest = (boxes[CATEGORY_ID][0], 0.0)
    fitted = [(0.0, 0.0), *(boxes.get(number, rest) for number in range(1, len(box.bias)))]
    with torch.no_grad():
        for parameter in (box.weight, box.bias):
            scaled = torch.stack(
                [scale * (row - parameter[0]) for row, (scale, _) in zip(parameter, fitted, strict=True)]
            )
            if parameter is box.bias:
                scaled += torch.tensor([offset for _, offset in fitted])
            # Relative to their mean, which does not change a score.
            parameter.copy_(scaled - scaled.mean(dim=0))
        maps.weight *= steepness[:, None, None]
        maps.bias.copy_(maps.bias * steepness + torch.as_tensor(points.offset, dtype=torch.float32))


TRAIN_SPLIT: Final = "train"


@dataclass(frozen=True, kw_only=True)
class CalibrationJob:
    """Settings of a calibration: checkpoint and data."""

    checkpoint: Path
    data: Path
    split: str
    last: float | None
    """Share at the end of each recording to use. None: all of a test split, or the validation part of training."""
    score: float
    """Score threshold of the detections used for the fit."""
    settings: Settings
    max_images: int | None = None
    out: Path | None = None
    """Checkpoint to write with calibrated box and keypoint scores. None: keypoint scores only, in a file beside the
    weights."""


def fit_calibration(job: CalibrationJob, console: Console) -> Path:
    """Fit the calibration and write it beside the weights or as part of new weights; return the path.

    Raises:
        UserError: The output exists with the calibration of other weights, data or options, or is another file.
    """
    weights = find_checkpoint(job.checkpoint)
    if job.out:
        check_file(job.out, lambda head: head[8:9] == b"{")
    elif shipped(weights):
        raise UserError(f"--checkpoint {job.checkpoint}: comes with skope; copy {weights} and calibrate the copy")
    least = job.score if job.out is None else min(job.score, CALIBRATION_FIT.least_score)
    predictor = Predictor.load(weights, replace(job.settings, calibrated=False, min_score=least), console)
    truth = read_inputs.read_dataset(job.data, [job.split])
    predictor.check_scheme(truth.scheme, job.data)
    share = _share(job, predictor.metadata)
    work = _work(job, [weights, *truth.sources], share)
    if job.out is None:
        score_calibration.check_calibration_free(weights, work)
    file = read_inputs.limit(_taken(job, truth.splits[0], share), job.max_images)
    if not file.images:
        raise UserError(f"{job.data}: split {job.split}: the last {share:g} of its recordings is less than one image")
    results, road_users = apart([result for _, found in predictor.by_image(file, truth.root) for result in found])

    matches = match(file, results, score=job.score, thresholds=(CALIBRATION_RULES.iou,))
    outcomes = outcomes_at(
        matches, CALIBRATION_RULES.iou, MetricOptions(alpha=CALIBRATION_RULES.alpha, iou=(CALIBRATION_RULES.iou,))
    )
    points = matches.det_keypoints[outcomes.detection[outcomes.found]]
    right = outcomes.correct(CALIBRATION_RULES.alpha)[outcomes.found]
    if not len(matches.gt_image):
        raise UserError(f"{job.data}: split {job.split}: shows no vehicle to fit to; name another --split")
    if not len(points):
        raise UserError(
            f"{job.data}: split {job.split}: none of {len(matches.gt_image)} vehicles is found with a score above "
            f"{job.score:g}; train longer, or take --score lower"
        )
    fitted_on = {
        "data": str(job.data),
        "split": job.split,
        "last": share,
        "images": len(file.images),
        "vehicles": len(points),
        "alpha": CALIBRATION_RULES.alpha,
        "iou": CALIBRATION_RULES.iou,
        "score": job.score,
    }
    fitted = score_calibration.fit(score_calibration.raw_maxima(points[..., 2]), right, fitted_on)
    _tell("keypoints", points[..., 2], fitted(points)[..., 2], right, console)
    if job.out is None:
        return score_calibration.write(weights, fitted, work, predictor.scheme.name)
    boxes = _fitted_boxes(file, results, road_users, predictor.categories, console)
    model, config, metadata = load_weights(weights, "cpu")
    fold(model, boxes, fitted)
    known = [predictor.categories[number - CATEGORY_ID] for number in boxes]
    content = checkpoint_bytes(model, config, {**metadata, CALIBRATED_KEY: {**fitted_on, "categories": known}})
    write_new(job.out, content)
    return job.out


def _fitted_boxes(
    file: AnnotationFile,
    vehicles: Sequence[Result],
    road_users: Sequence[RoadUserResult],
    categories: Sequence[str],
    console: Console,
) -> dict[int, tuple[float, float]]:
    """Return scale and offset of the scores of each category with enough data, by category id."""
    fitted = {}
    for number, name in enumerate(categories, start=CATEGORY_ID):
        if number == CATEGORY_ID:
            scores, hits = vehicle_outcomes(file, vehicles)
        else:
            scores, hits = box_outcomes(
                file, [user for user in road_users if user.score > CALIBRATION_FIT.least_score], name
            )
            if min(hits.sum(), (~hits).sum()) < CALIBRATION_FIT.least_outcomes:
                console.say(
                    f"{name}: not calibrated, a threshold means another thing for it: of {len(hits)} detections "
                    f"{hits.sum()} are right; {CALIBRATION_FIT.least_outcomes} right and as many wrong ones are needed"
                )
                continue
        fitted[number] = fit_boxes(scores, hits)
        subject = "vehicles" if number == CATEGORY_ID else name
        _tell(subject, scores, calibrated(scores, *fitted[number]), hits, console)
    return fitted


def _tell(subject: str, before: Array, after: Array, right: NDArray[np.bool_], console: Console) -> None:
    """Print the quality of scores before and after calibration."""
    losses = []
    for words, p in (("before", before), ("after", after)):
        error = score_reliability.calibration_error(score_reliability.reliability(p.ravel(), right.ravel()))
        losses.append(score_calibration.log_loss(p, right))
        console.say(f"{subject}, {words}: log loss {losses[-1]:.3f}, calibration error {error:.3f}")
    if losses[1] > losses[0]:
        console.say(f"{subject}: the scores are worse now than before: fit them to more images (--split, --last)")


def _work(job: CalibrationJob, files: Sequence[Path], share: float) -> dict[str, Any]:
    """Return the identity of the calibration for `work.json`: checkpoint, data and options."""
    options = {"split": job.split, "last": share, "score": job.score, "max_images": job.max_images}
    settings = {name: getattr(job.settings, name) for name in ("backend", "precision", "min_size")}
    return work_of("skope eval calibrate-scores", files, {**options, **settings})


def _share(job: CalibrationJob, metadata: dict[str, Any]) -> float:
    """Return the share of each recording to use: the validation part of training data, all of other splits."""
    if job.last is not None:
        if not 0 < job.last <= 1:
            raise UserError(f"--last: expected a share above 0 and up to 1, got {job.last}")
        return job.last
    if job.split != TRAIN_SPLIT:
        return 1.0
    recipe = metadata.get("run", {}).get("recipe", {})
    kept = recipe.get("val_fraction")
    if not kept:
        raise UserError(
            "--split train: this checkpoint kept nothing of it for validation, and scores fitted to what was learnt "
            "promise too much; name another --split, or with --last the share of each recording to take all the same"
        )
    return float(kept)


def _taken(job: CalibrationJob, file: AnnotationFile, share: float) -> AnnotationFile:
    """Return the annotations for the fit; training data are excluded unless `--last` requests them."""
    if job.last is not None or job.split != TRAIN_SPLIT:
        return last_frames(file, share)
    return ignoring(*held_back(file, share))
