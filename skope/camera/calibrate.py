"""A camera from everything that a user has: marked points, lengths, parallel lines, verticals, and what else is known.

One least-squares problem, each residual in units of its own standard deviation (Levenberg and Marquardt's method). Its
covariance says how well each place in the image is known. Residuals of lines on the road are taken on the road, since
the marks' errors are carried there; lens distortion and focal length are always unknown, under what lenses are like.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.stats import chi2

from skope.camera.evidence import Evidence
from skope.camera.evidence_terms import EvidenceTerm, terms_of
from skope.camera.model import Camera
from skope.camera.other_cameras import likely_cameras, spread_around
from skope.camera.pose_from_points import FEWEST
from skope.camera.uncertain_camera import PARAMETERS, UncertainCamera, camera_of_parameters
from skope.camera.weighted_fit import CHECKED_POINTS, SCALES, WeightedFit, best_fit, camera_starts
from skope.camera.wrong_points import with_wrong_points
from skope.errors import UserError

_FREE: Final = ("x", "y", "yaw")
"""Parameters of the world's origin and axes, which points alone can tell."""
_SURPRISE: Final = 0.01
"""Residuals that are less likely than this widen the covariance."""
_OTHER: Final = 0.05
"""Probability of other cameras from which they are told of."""


@dataclass(frozen=True)
class Residual:
    """Distance of one piece of evidence from the camera that was found."""

    kind: str
    """"point", "length", "parallel lines", "vertical" or "belief"."""
    name: str
    value: float
    """Pixels for points and verticals, metres for lengths, degrees for parallel lines."""
    sigmas: float
    """The same in standard deviations."""


@dataclass(frozen=True, eq=False)
class SiteCalibration(UncertainCamera):
    """A calibrated camera and how well it is known."""

    residuals: tuple[Residual, ...]
    outliers: tuple[str, ...]
    """Names of points that contradict the others and were left out."""
    warnings: tuple[str, ...]
    """Sentences on what the evidence leaves open."""


# ------------------------------------------------------------------------------------------------------------- solver


def calibrate(evidence: Evidence, *, start: Camera | None = None, check: bool = True) -> SiteCalibration:
    """The likeliest camera under all evidence, without a point that contradicts the others.

    Args:
        evidence: What is known. Places come out in metres only where points, lengths, a vertical's height or the
            camera's own are among it.
        start: A camera to begin with; None: one that the points show, or the best of many.
        check: Whether points that contradict the others are looked for.

    Raises:
        UserError: There is nothing to tell the scale by, or no camera agrees with the evidence.
    """
    scaled = evidence.points or evidence.lengths or any(v.metres for v in evidence.verticals)
    if not scaled and not any("z" in belief.of for belief in evidence.beliefs):
        raise UserError("calibration: nothing tells metres: mark points with places or a known length")
    if 0 < len(evidence.points) < FEWEST and not (evidence.lengths or evidence.parallels or evidence.beliefs):
        raise UserError(f"calibration: expected {FEWEST} points or more, got {len(evidence.points)}")
    unknown = tuple(name for name in PARAMETERS if len(evidence.points) >= 2 or name not in _FREE)
    terms = terms_of(evidence)
    fit = best_fit(terms, camera_starts(evidence, start, terms), unknown, evidence.size)
    if not math.isfinite(fit.cost):
        raise UserError("calibration: no camera agrees with what is marked; are two points swapped?")
    outliers, doubts, spread = tuple[str, ...](), tuple[str, ...](), np.zeros((len(unknown), len(unknown)))
    if check and len(evidence.points) >= CHECKED_POINTS:
        judged = with_wrong_points(evidence, terms, fit, unknown)
        fit, outliers, doubts, spread = judged.fit, judged.wrong, judged.doubts, judged.spread
        terms = [term for term in terms if term.kind != "point" or term.name not in outliers]
    elif start is None and len(evidence.points) >= FEWEST:
        likely, chances = likely_cameras(evidence, terms, fit, unknown)
        fit, spread = likely[0], spread_around(likely[0], likely[1:], chances[1:].tolist(), unknown)
        if chances[0] < 1 - _OTHER:
            doubts = ("the points suit another camera too: places are as uncertain as both leave them; mark more",)
    camera = camera_of_parameters(fit.at, evidence.size)
    excess = _excess(fit, len(evidence.parallels))
    covariance = excess**2 * fit.covariance(SCALES[[PARAMETERS.index(name) for name in unknown]]) + spread
    calibration = SiteCalibration(camera, unknown, covariance, _residuals(terms, camera), outliers, ())
    if excess > 1:
        doubts = (
            *doubts,
            f"the marks contradict each other {excess:.1f} times as much as their own errors explain: stated errors "
            "are so much wider; is the road no plane, or are marks swapped?",
        )
    return replace(calibration, warnings=(*doubts, *_warnings(evidence, calibration)))


def _excess(fit: WeightedFit, groups: int) -> float:
    """Factor by which the residuals are larger than they should be; 1 where that may be chance.

    Of each of the `groups` of parallel lines one direction is free.
    """
    spare = max(1, len(fit.J) - groups - fit.J.shape[1])
    return math.sqrt(fit.cost / spare) if chi2.sf(fit.cost, spare) < _SURPRISE else 1.0


def _residuals(terms: Sequence[EvidenceTerm], camera: Camera) -> tuple[Residual, ...]:
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
    if FEWEST <= len(places) < CHECKED_POINTS and not (evidence.lengths or evidence.beliefs):
        out.append(
            f"{len(places)} points: a wrong one among them cannot be found; {CHECKED_POINTS} or more check each other"
        )
    if len(places) >= FEWEST:
        spread = np.linalg.svd(places[:, :2] - places[:, :2].mean(axis=0), compute_uv=False)
        if spread[1] < 0.1 * spread[0]:
            out.append("the points lie nearly on one line: places beside it are not known")
        away = np.linalg.norm(places - calibration.camera.position, axis=1)
        out.append(f"the points lie {away.min():.0f} to {away.max():.0f} m away: places farther off are extrapolated")
    return tuple(out)
