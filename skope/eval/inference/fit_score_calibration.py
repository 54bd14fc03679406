"""`skope eval calibrate`: run a checkpoint on what it has not learnt from, and fit its keypoint scores to the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from skope.console import Console
from skope.detector import find_checkpoint
from skope.errors import UserError
from skope.eval.inference import score_calibration
from skope.eval.inference.predictor import Predictor
from skope.eval.inference.score_calibration import ALPHA, IOU
from skope.eval.inference.settings import Settings
from skope.image_selection import held_back, ignoring, last_frames
from skope.metrics import read_inputs, score_reliability
from skope.metrics.counts import Options, outcomes_at
from skope.metrics.match import match
from skope.output_folders import work_of
from skope.schema import AnnotationFile
from skope.weights import shipped

TRAIN: Final = "train"


@dataclass(frozen=True, kw_only=True)
class CalibrationJob:
    """Which checkpoint to calibrate, on which data."""

    checkpoint: Path
    data: Path
    split: str
    last: float | None
    """Share at the end of each recording that is taken; None: all of a test split, or what training validated on."""
    score: float
    """Detections above this are learnt from: those whose keypoints will be used."""
    settings: Settings
    max_images: int | None = None


def calibrate(job: CalibrationJob, console: Console) -> Path:
    """Fit and write the calibration beside the weights; returns its path.

    Raises UserError where another calibration lies there: of other weights, data or options.
    """
    weights = find_checkpoint(job.checkpoint)
    if shipped(weights):
        raise UserError(f"--checkpoint {job.checkpoint}: comes with skope; copy {weights} and calibrate the copy")
    predictor = Predictor(weights, replace(job.settings, calibrated=False, min_score=job.score), console)
    truth = read_inputs.read_dataset(job.data, [job.split])
    predictor.check_scheme(truth.scheme, job.data)
    share = _share(job, predictor.metadata)
    work = _work(job, [weights, *truth.sources], share)
    score_calibration.check_free(weights, work)
    file = read_inputs.limit(_taken(job, truth.splits[0], share), job.max_images)
    if not file.images:
        raise UserError(f"{job.data}: split {job.split}: the last {share:g} of its recordings is less than one image")
    results = predictor.split(file, truth.root)

    matches = match(file, results, score=job.score, thresholds=(IOU,))
    outcomes = outcomes_at(matches, IOU, Options(alpha=ALPHA, iou=(IOU,)))
    points = matches.det_keypoints[outcomes.detection[outcomes.found]]
    right = outcomes.correct(ALPHA)[outcomes.found]
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
        "alpha": ALPHA,
        "iou": IOU,
        "score": job.score,
    }
    fitted = score_calibration.fit(score_calibration.raw_maxima(points[..., 2]), right, fitted_on)
    path = score_calibration.write(weights, fitted, work, predictor.scheme.name)
    after = fitted(points)
    for words, p in (("before", points[..., 2]), ("after", after[..., 2])):
        error = score_reliability.calibration_error(score_reliability.reliability(p.ravel(), right.ravel()))
        console.say(f"{words}: log loss {score_calibration.log_loss(p, right):.3f}, calibration error {error:.3f}")
    return path


def _work(job: CalibrationJob, files: Sequence[Path], share: float) -> dict[str, Any]:
    """What identifies the calibration in `work.json`: checkpoint, data and options."""
    options = {"split": job.split, "last": share, "score": job.score, "max_images": job.max_images}
    return work_of("skope eval calibrate", files, {**options, "precision": job.settings.precision})


def _share(job: CalibrationJob, metadata: dict[str, Any]) -> float:
    """How much of each recording to take: what training kept for validation, all of other splits."""
    if job.last is not None:
        if not 0 < job.last <= 1:
            raise UserError(f"--last: expected a share above 0 and up to 1, got {job.last}")
        return job.last
    if job.split != TRAIN:
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
    """What the scores are fitted to: nothing that was learnt from, unless `--last` asks for it."""
    if job.last is not None or job.split != TRAIN:
        return last_frames(file, share)
    return ignoring(*held_back(file, share))
