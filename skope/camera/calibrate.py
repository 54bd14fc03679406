"""Calibrate a camera from all evidence: marked points, lengths, parallel lines, verticals, known parameters.

The calibration is one least-squares problem. Each residual is in units of its own standard deviation (Levenberg and
Marquardt's method). The covariance gives the uncertainty of each position in the image. Residuals of lines on the road
are measured on the road, because the errors of the marks are projected there. Lens distortion and focal length are
always unknown, with a prior from real lenses.

Wrong points among the marks are searched for as sets. A wrong point lies anywhere near its true position, for example
at the next corner of a marking. The likelihood of each set follows from the evidence under the best camera without it
(Laplace's approximation). If several sets are likely, the result is the camera of the most likely set, and its
covariance includes the candidate cameras of the other sets.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.stats import chi2

from skope.camera.evidence import Evidence, MarkedPoint
from skope.camera.evidence_terms import ResidualTerm, point_term, terms_of
from skope.camera.model import Camera
from skope.camera.other_cameras import likely_cameras, spread_around
from skope.camera.pose_from_points import POINT_FIT, fit_camera_to_points
from skope.camera.uncertain_camera import (
    CAMERA_PARAMETERS,
    UNCERTAINTY_LIMITS,
    UncertainCamera,
    camera_of_parameters,
    radius_of,
    values_of,
)
from skope.camera.weighted_fit import FIT_STARTS, SEARCH_SCALES, WeightedFit, best_fit, camera_starts, fit_terms
from skope.errors import UserError
from skope.types import Array


@dataclass(frozen=True)
class WrongPointPrior:
    """Prior of wrong points among marked points, and thresholds for reports."""

    probability: float = 0.02
    """Prior probability that a marked point is wrong."""
    error_m: tuple[float, float] = (3.5, 30.0)
    """Candidate standard deviations of a wrong point, metres along x and y: a lane's width, or anywhere."""
    most_points: int = 8
    """Maximum number of points that are examined as possibly wrong, the most contradictory ones first."""
    points_per_wrong: int = 4
    """Number of points for each wrong point that a set may contain."""
    reported: float = 0.05
    """Minimum probability at which a point is reported as possibly wrong."""
    surprising: float = 0.01
    """Significance level: the covariance is widened if residuals this large have a lower probability."""
    other_camera: float = 0.05
    """Minimum probability at which a second candidate camera is reported."""


WRONG_POINTS: Final = WrongPointPrior()


@dataclass(frozen=True, eq=False)
class JudgedPoints:
    """Most likely fit without the wrong points, with their names and the added uncertainty."""

    fit: WeightedFit
    """Most likely camera without the wrong points."""
    wrong: tuple[str, ...]
    """Names of the points that are most likely wrong."""
    doubts: tuple[str, ...]
    """Sentences on further points that may be wrong."""
    spread: Array
    """(P, P) covariance added for the candidate cameras of other sets of wrong points."""


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    wrong: frozenset[int]
    """Indices of the wrong points in the evidence."""
    fit: WeightedFit
    log_odds: float


def with_wrong_points(
    evidence: Evidence, terms: Sequence[ResidualTerm], fit: WeightedFit, unknown: Sequence[str]
) -> JudgedPoints:
    """Find the points that are probably wrong, and the camera that fits all remaining points.

    Args:
        evidence: Evidence with at least six points.
        terms: Terms of the evidence, those of the points first.
        fit: Fit of the most likely camera under the assumption that no point is wrong.
        unknown: Names of the unknown parameters.
    """
    scales = SEARCH_SCALES[[CAMERA_PARAMETERS.index(name) for name in unknown]]

    def hypothesis(wrong: frozenset[int], starts: Sequence[Array]) -> _Hypothesis:
        """Return the most likely of the standard deviations of wrong points."""
        tried = []
        for aside in WRONG_POINTS.error_m:
            moved = list(terms)
            for i in wrong:
                moved[i] = point_term(replace(evidence.points[i], sigma_m=aside))
            best = best_fit(moved, starts, unknown, evidence.size)
            odds = len(wrong) * math.log(
                WRONG_POINTS.probability / (1 - WRONG_POINTS.probability) / len(WRONG_POINTS.error_m)
            )
            tried.append(_Hypothesis(wrong, best, best.log_evidence(scales) + odds))
            if not any(np.linalg.norm(best.blocks[i]) > 2.5 for i in wrong):
                break
            starts = [best.at]
        return max(tried, key=lambda candidate: candidate.log_odds)

    none = _Hypothesis(frozenset(), fit, fit.log_evidence(scales))
    found, doubted = [none], _doubted(fit, len(evidence.points))
    best = none
    while len(best.wrong) < len(evidence.points) // WRONG_POINTS.points_per_wrong:
        further = [
            hypothesis(best.wrong | {i}, [best.fit.at, *_pose_without(evidence, best.wrong | {i})])
            for i in doubted
            if i not in best.wrong
        ]
        further = [candidate for candidate in further if math.isfinite(candidate.fit.cost)]
        found += further
        ahead = max(further, key=lambda candidate: candidate.log_odds, default=None)
        if ahead is None or ahead.log_odds <= best.log_odds:
            break
        best = ahead
    return _judged(evidence, terms, unknown, best, found)


def _judged(
    evidence: Evidence,
    terms: Sequence[ResidualTerm],
    unknown: Sequence[str],
    best: _Hypothesis,
    found: Sequence[_Hypothesis],
) -> JudgedPoints:
    share = np.exp(np.array([candidate.log_odds - best.log_odds for candidate in found]))
    share /= share.sum()
    right = [term for i, term in enumerate(terms) if i not in best.wrong]
    fit = fit_terms(right, best.fit.at, unknown, evidence.size) if best.wrong else best.fit
    rivals = [
        (candidate.fit, weight)
        for candidate, weight in zip(found, share.tolist(), strict=True)
        if candidate is not best
    ]
    spread = spread_around(fit, [rival_fit for rival_fit, _ in rivals], [weight for _, weight in rivals], unknown)
    names = [point.name for point in evidence.points]
    wrong = tuple(names[i] for i in sorted(best.wrong))
    return JudgedPoints(fit, wrong, _doubts(names, best, found, share), spread)


def _doubts(names: Sequence[str], best: _Hypothesis, found: Sequence[_Hypothesis], share: Array) -> tuple[str, ...]:
    """Return sentences on points that may be wrong but are not in the most likely set, and on unsure ones in it."""
    chance = [
        sum(weight for candidate, weight in zip(found, share, strict=True) if i in candidate.wrong)
        for i in range(len(names))
    ]
    suspects = [names[i] for i in range(len(names)) if chance[i] >= WRONG_POINTS.reported and i not in best.wrong]
    unsure = [names[i] for i in sorted(best.wrong) if chance[i] < 1 - WRONG_POINTS.reported]
    if unsure and suspects:
        return (
            f"point {' and '.join(unsure)} contradicts the others and is left out, but they agree nearly as well "
            f"without {' or '.join(suspects)}: mark these again",
        )
    if unsure:
        return (
            f"point {' and '.join(unsure)} contradicts the others and is left out, but may be right: mark it again",
        )
    if suspects:
        return (f"point {' or '.join(suspects)} may be wrong: the others agree better without it; mark it again",)
    return ()


def _doubted(fit: WeightedFit, count: int) -> list[int]:
    """Return the points that lower the cost most when removed, for a linear model: r (1 - H)^-1 r, H the projection."""
    first = np.cumsum([0, *(len(block) for block in fit.blocks)])
    hat = fit.J @ np.linalg.pinv(fit.J)
    gains = []
    for i in range(count):
        rows = slice(first[i], first[i + 1])
        free = np.eye(len(fit.blocks[i])) - hat[rows, rows] + 1e-9 * np.eye(len(fit.blocks[i]))
        gains.append(float(fit.blocks[i] @ np.linalg.solve(free, fit.blocks[i])))
    return [int(i) for i in np.argsort(gains)[::-1][: WRONG_POINTS.most_points]]


def _pose_without(evidence: Evidence, wrong: frozenset[int]) -> list[Array]:
    """Return values of `CAMERA_PARAMETERS` fitted to the points that are not wrong."""
    kept = [point for i, point in enumerate(evidence.points) if i not in wrong]
    if len(kept) < POINT_FIT.fewest_points:
        return []
    try:
        pose = fit_camera_to_points([point.pixel for point in kept], [point.place for point in kept], evidence.size)
    except UserError:
        return []
    return [values_of(pose.camera)]


FREE_PARAMETERS: Final = ("x", "y", "yaw")
"""Parameters of the world's origin and axes. Only points determine them."""


@dataclass(frozen=True)
class Residual:
    """Residual of one piece of evidence under the fitted camera."""

    kind: str
    """"point", "length", "parallel lines", "vertical" or "belief"."""
    name: str
    value: float
    """Residual: pixels for points and verticals, metres for lengths, degrees for parallel lines."""
    sigmas: float
    """Residual in standard deviations."""


@dataclass(frozen=True, eq=False)
class SiteCalibration(UncertainCamera):
    """Calibrated camera with its uncertainty."""

    residuals: tuple[Residual, ...]
    outliers: tuple[str, ...]
    """Names of points that contradict the others and were left out."""
    warnings: tuple[str, ...]
    """Sentences on what remains uncertain."""


# ------------------------------------------------------------------------------------------------------------- solver


def calibrate(evidence: Evidence, *, start: Camera | None = None, check: bool = True) -> SiteCalibration:
    """Find the most likely camera under all evidence, after leaving out points that are probably wrong.

    Args:
        evidence: The evidence. Positions are metric only if it contains points, lengths, the height of a vertical or
            the camera's own height.
        start: Initial camera; None: candidates fitted to the points, or the best of a grid.
        check: Whether to search for points that contradict the others.

    Raises:
        UserError: The evidence does not determine the scale, or no camera agrees with it.
    """
    scaled = evidence.points or evidence.lengths or any(v.metres for v in evidence.verticals)
    if not scaled and not any("z" in prior.of for prior in evidence.priors):
        raise UserError("calibration: the scale is unknown: mark points with positions or a known length")
    if 0 < len(evidence.points) < POINT_FIT.fewest_points and not (
        evidence.lengths or evidence.parallels or evidence.priors
    ):
        raise UserError(f"calibration: expected {POINT_FIT.fewest_points} points or more, got {len(evidence.points)}")
    unknown = tuple(name for name in CAMERA_PARAMETERS if len(evidence.points) >= 2 or name not in FREE_PARAMETERS)
    terms = terms_of(evidence)
    fit = best_fit(terms, camera_starts(evidence, start, terms), unknown, evidence.size)
    if not math.isfinite(fit.cost):
        raise UserError("calibration: no camera agrees with the marks; are two points swapped?")
    outliers, doubts, spread = tuple[str, ...](), tuple[str, ...](), np.zeros((len(unknown), len(unknown)))
    if check and len(evidence.points) >= FIT_STARTS.checked_points:
        judged = with_wrong_points(evidence, terms, fit, unknown)
        fit, outliers, doubts, spread = judged.fit, judged.wrong, judged.doubts, judged.spread
        terms = [term for term in terms if term.kind != "point" or term.name not in outliers]
    elif start is None and len(evidence.points) >= POINT_FIT.fewest_points:
        likely, chances = likely_cameras(evidence, terms, fit, unknown)
        fit, spread = likely[0], spread_around(likely[0], likely[1:], chances[1:].tolist(), unknown)
        if chances[0] < 1 - WRONG_POINTS.other_camera:
            doubts = ("a second camera fits the points, too; the position errors include both: mark more points",)
    camera = camera_of_parameters(fit.at, evidence.size)
    excess = _excess(fit, len(evidence.parallels))
    covariance = excess**2 * fit.covariance(SEARCH_SCALES[[CAMERA_PARAMETERS.index(name) for name in unknown]]) + spread
    calibration = SiteCalibration(camera, unknown, covariance, _residuals(terms, camera), outliers, ())
    if excess > 1:
        doubts = (
            *doubts,
            f"the marks contradict each other {excess:.1f} times as much as their own errors explain: stated errors "
            "are widened by this factor; is the road not a plane, or are marks swapped?",
        )
    return replace(calibration, warnings=(*doubts, *_warnings(evidence, calibration)))


def _excess(fit: WeightedFit, groups: int) -> float:
    """Return the factor by which the residuals exceed their expected size; 1 if the excess may be chance.

    Each of the `groups` of parallel lines has one free direction.
    """
    spare = max(1, len(fit.J) - groups - fit.J.shape[1])
    return math.sqrt(fit.cost / spare) if chi2.sf(fit.cost, spare) < WRONG_POINTS.surprising else 1.0


def _residuals(terms: Sequence[ResidualTerm], camera: Camera) -> tuple[Residual, ...]:
    out = []
    for term in terms:
        if term.kind == "lens":
            continue
        off, C = term.residual(camera), term.covariance(camera)
        sigmas = math.sqrt(float(off @ np.linalg.solve(C, off)))
        size = float(np.abs(np.degrees(off)).max()) if term.kind == "parallel lines" else float(np.linalg.norm(off))
        out.append(Residual(term.kind, term.name, size, sigmas))
    return tuple(out)


def _warnings(evidence: Evidence, calibration: SiteCalibration) -> tuple[str, ...]:
    out, places = [], np.array([point.place for point in evidence.points]).reshape(-1, 3)
    if POINT_FIT.fewest_points <= len(places) < FIT_STARTS.checked_points and not (evidence.lengths or evidence.priors):
        out.append(
            f"{len(places)} points: a wrong one among them cannot be found; {FIT_STARTS.checked_points} or more "
            f"check each other"
        )
    if len(places) >= POINT_FIT.fewest_points:
        spread = np.linalg.svd(places[:, :2] - places[:, :2].mean(axis=0), compute_uv=False)
        if spread[1] < 0.1 * spread[0]:
            out.append("the points lie nearly on one line: positions beside it are not known")
        away = np.linalg.norm(places - calibration.camera.position, axis=1)
        out.append(f"points are {away.min():.0f} to {away.max():.0f} m away: positions farther off are extrapolated")
    return tuple(out)


@dataclass(frozen=True)
class LeftOutError:
    """Leave-one-out error of a point: its position is predicted from all other evidence."""

    error_m: float
    """Distance between known and predicted position, metres; NaN if the point is predicted above the horizon."""
    stated_m: float
    """90% bound of `error_m`, metres, from the errors of all other evidence, the mark and the known position."""


def left_out_errors(evidence: Evidence, calibration: SiteCalibration) -> dict[str, LeftOutError]:
    """Return the leave-one-out error of each point by its name, without points that cannot be predicted.

    The position of a point that the calibration already leaves out is predicted from all points that it uses. The
    result is empty if too few points would remain.
    """
    good = tuple(point for point in evidence.points if point.name not in calibration.outliers)
    out = {}
    for point in evidence.points:
        rest = tuple(good_point for good_point in good if good_point is not point)
        if len(rest) < POINT_FIT.fewest_points:
            continue
        if len(rest) == len(good):
            out[point.name] = left_out_error(point, calibration)
            continue
        try:
            without = calibrate(replace(evidence, points=rest), start=calibration.camera, check=False)
        except UserError:
            continue
        out[point.name] = left_out_error(point, without)
    return out


def left_out_error(point: MarkedPoint, camera: UncertainCamera) -> LeftOutError:
    """Return the error of a point's position from its mark, with a camera that was fitted without the point."""
    height = float(point.place[2])
    position = camera.places(point.pixel, height)
    away = position - camera.camera.position
    rise = point.sigma_z_m * away[:2] / away[2] if away[2] else np.zeros(2)
    covariance = camera.place_covariance(point.pixel, height, point.sigma_px)
    covariance = covariance + point.sigma_m**2 * np.eye(2) + np.outer(rise, rise)
    return LeftOutError(
        float(np.linalg.norm((position - point.place)[:2])),
        float(radius_of(covariance, UNCERTAINTY_LIMITS.position_coverage)),
    )
