"""Calibrate keypoint scores to probabilities, with two parameters per keypoint for the heat map's maximum.

A keypoint's score is the probability that the point is visible and within alpha L of its true position, given that the
vehicle exists. The method is Platt's (1999): a logistic regression of "visible and close enough" on the raw maximum,
per keypoint, fitted to validation data. The parameters are stored in a file beside the weights. The file has the digest
of its weights.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints, records
from skope.errors import UserError
from skope.files.atomic import sha256_of
from skope.files.json_files import read_json, write_json
from skope.files.output_folders import work_differences
from skope.types import Array


@dataclass(frozen=True)
class CalibrationRules:
    """Rules for correct detections, and the fit of their probability."""

    version: int = 1
    """Version of the file."""
    alpha: float = 0.1
    """Maximum error of a correct keypoint, as a share of the longer edge of the box."""
    iou: float = 0.6
    """Minimum IoU of a correct box."""
    prior_weight: float = 1.0
    """Weight of the prior that pulls the two parameters of a keypoint towards those of all keypoints together, in
    observations. A rarely visible keypoint gets the common values; a keypoint that is visible hundreds of times
    gets its own."""
    fit_steps: int = 50
    """Number of steps of the fit."""


CALIBRATION_RULES: Final = CalibrationRules()


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoreCalibration:
    """Parameters of the calibration: score = 1 / (1 + exp(-(scale x raw maximum + offset)))."""

    scale: Array
    """(33,) factor of the raw maximum; never negative, so that a higher maximum never gives a lower score."""
    offset: Array
    """(33,) value added to the scaled maximum."""
    fitted_on: dict[str, Any]
    """Description of the data of the fit: names and counts."""

    def __call__(self, points: Array) -> Array:
        """Return a copy of (N, 33, 3) points of `skope.detector` with calibrated scores."""
        scores = sigmoid(self.scale * raw_maxima(points[..., 2]) + self.offset)
        return np.concatenate([points[..., :2], scores[..., None]], axis=-1)


def sigmoid(x: Array) -> Array:
    """Return 1 / (1 + exp(-x)) without overflow."""
    return np.asarray(0.5 * (1 + np.tanh(0.5 * np.asarray(x, dtype=np.float64))))


def raw_maxima(p: Array) -> Array:
    """Return the maxima of the heat maps from their sigmoid p in float64; 36 where p is 1."""
    p = np.clip(p, 2.0**-52, 1 - 2.0**-53)
    return np.asarray(np.log(p) - np.log1p(-p))


# -------------------------------------------------------------------------------------------------------------- fitting


def fit(raw: Array, right: NDArray[np.bool_], fitted_on: dict[str, Any]) -> ScoreCalibration:
    """Fit a calibration to right and wrong keypoints.

    Args:
        raw: (N, 33) raw maxima of the heat maps.
        right: (N, 33) whether each point was visible and close enough.
        fitted_on: Description of the data, for the file.
    """
    if not len(raw):
        raise UserError("nothing to calibrate on: no detection matched a vehicle")
    x, y = np.asarray(raw, dtype=np.float64), _targets(right)
    together = _logistic(x.reshape(-1, 1), _targets(right.reshape(-1, 1)), np.zeros((2, 1)), 1e-6)
    scale, offset = _logistic(x, y, np.repeat(together, x.shape[1], axis=1), CALIBRATION_RULES.prior_weight)
    # A negative scale would mean that higher maxima are less often correct. In that case only the base rate is used.
    useless = scale <= 0
    rate = y.mean(axis=0)
    scale = np.where(useless, 0.0, scale)
    offset = np.where(useless, np.log(rate / (1 - rate)), offset)
    return ScoreCalibration(scale=scale, offset=offset, fitted_on=fitted_on)


def fit_logistic(raw: Array, right: NDArray[np.bool_]) -> tuple[float, float]:
    """Return scale (never negative) and offset of a logistic regression of outcomes (N,) on raw scores (N,)."""
    ab = _logistic(raw.reshape(-1, 1), _targets(right.reshape(-1, 1)), np.zeros((2, 1)), 1e-6)
    return max(float(ab[0, 0]), 0.0), float(ab[1, 0])


def _targets(right: NDArray[np.bool_]) -> Array:
    """Return Platt's targets for (N, M) outcomes: not exactly 0 and 1, so that a clean separation has a finite fit."""
    n = right.sum(axis=0)
    high, low = (n + 1) / (n + 2), 1 / (len(right) - n + 2)
    return np.asarray(np.where(right, high, low))


def _logistic(x: Array, y: Array, start: Array, hold: float) -> Array:
    """Fit M logistic regressions of (N, M) y on x; return (2, M) slopes and intercepts.

    The values are pulled to `start` with weight `hold`. The solver is Newton's method; a step is halved if it does not
    lower the loss.
    """

    def loss(ab: Array) -> Array:
        z = ab[0] * x + ab[1]
        return np.asarray((np.logaddexp(0, z) - y * z).sum(axis=0) + hold / 2 * ((ab - start) ** 2).sum(axis=0))

    ab: Array = start.copy()
    value = loss(ab)
    for _ in range(CALIBRATION_RULES.fit_steps):
        p = sigmoid(ab[0] * x + ab[1])
        w, r = p * (1 - p), p - y
        gradient = np.stack([(r * x).sum(axis=0), r.sum(axis=0)]) + hold * (ab - start)
        aa, ab_, bb = (w * x * x).sum(axis=0) + hold, (w * x).sum(axis=0), w.sum(axis=0) + hold
        step = np.stack([bb * gradient[0] - ab_ * gradient[1], aa * gradient[1] - ab_ * gradient[0]]) / (
            aa * bb - ab_**2
        )
        size = np.ones(x.shape[1])
        for _ in range(CALIBRATION_RULES.fit_steps):
            trial = loss(ab - size * step)
            worse = trial > value
            if not worse.any():
                break
            size = np.where(worse, size / 2, size)
        done = np.asarray(np.where(trial <= value, size, 0.0) * step)
        ab, value = ab - done, np.minimum(trial, value)
        if np.abs(done).max() < 1e-10:
            break
    return ab


def log_loss(score: Array, right: NDArray[np.bool_]) -> float:
    """Return the mean negative log-likelihood of the outcomes; lower is better."""
    p = np.clip(score, 1e-12, 1 - 1e-12)
    return float(-np.mean(np.where(right, np.log(p), np.log(1 - p))))


# ---------------------------------------------------------------------------------------------------------------- files


def path_beside(weights: Path) -> Path:
    """Return the path of a checkpoint's calibration: its name with the suffix `.calibration.json`."""
    return weights.with_suffix(".calibration.json")


def check_calibration_free(weights: Path, work: Mapping[str, Any]) -> None:
    """Raise a UserError if the calibration beside a checkpoint is the output of a different run than `work`."""
    path = path_beside(weights)
    if not path.exists():
        return
    try:
        document = read_json(path)
        held = document.get("work") if isinstance(document, dict) else None
        different = work_differences(held, work) if held else "it does not name its run"
    except UserError as error:
        different = str(error)
    if different:
        raise UserError(
            f"{path}: is the output of another run ({different}); move it away, or calibrate a copy of the checkpoint"
        )


def write(
    weights: Path, calibration: ScoreCalibration, work: Mapping[str, Any], scheme: str = keypoints.SCHEME
) -> Path:
    """Write a calibration beside its checkpoint.

    Args:
        weights: The checkpoint.
        calibration: Its calibration.
        work: Identity of the calibration, as returned by `work_of`.
        scheme: Name of the keypoint scheme.

    Returns:
        The file's path.
    """
    path = path_beside(weights)
    fields = asdict(calibration)
    numbers = {name: fields[name].tolist() for name in ("scale", "offset")}
    head = {"version": CALIBRATION_RULES.version, "scheme": scheme, "weights_sha256": sha256_of(weights)}
    write_json(path, {**head, "work": dict(work), "fitted_on": calibration.fitted_on, **numbers})
    return path


def read(weights: Path, scheme: str = keypoints.SCHEME) -> ScoreCalibration | None:
    """Return the calibration beside a checkpoint, or None.

    Raises UserError if the calibration was fitted to different weights.
    """
    path = path_beside(weights)
    if not path.is_file():
        return None
    document = read_json(path)
    if not isinstance(document, dict):
        raise UserError(f"{path}: expected an object, got a {type(document).__name__}")
    for name, expected in (
        ("version", CALIBRATION_RULES.version),
        ("scheme", scheme),
        ("weights_sha256", sha256_of(weights)),
    ):
        if document.get(name) != expected:
            raise UserError(
                f"{path}: {name}: expected {expected!r}, got {document.get(name)!r}; it was fitted for other weights: "
                "move it away, and run `skope eval calibrate-scores`"
            )
    return _parsed(path, document)


def _parsed(path: Path, document: dict[str, Any]) -> ScoreCalibration:
    try:
        scale, offset = (records.check_array(name, document.get(name), keypoints.K) for name in ("scale", "offset"))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    if (scale < 0).any():
        raise UserError(f"{path}: scale: expected numbers from 0, got {scale.min():g}")
    return ScoreCalibration(scale=scale, offset=offset, fitted_on=document.get("fitted_on") or {})
