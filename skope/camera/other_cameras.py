"""Search for further candidate cameras that fit the same points.

A few points may fit a near wide-angle camera and also a distant telephoto camera. The fit finds only one of these
candidates. The probability of a candidate follows from the evidence under it (Laplace's approximation). If several
candidates are likely, the covariance of the most likely one includes the others.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.camera.evidence import Evidence
from skope.camera.evidence_terms import ResidualTerm
from skope.camera.model import Distortion
from skope.camera.pose_from_points import centred, fit_camera_to_points
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, values_of
from skope.camera.weighted_fit import SEARCH_SCALES, WeightedFit, fit_terms
from skope.errors import UserError
from skope.types import Array


@dataclass(frozen=True)
class OtherCameraStarts:
    """Initial candidate cameras of the search."""

    focal_widths: tuple[float, float, float, float] = (0.45, 0.7, 1.1, 2.6)
    """Focal lengths, in widths of the image."""
    distortions: tuple[float, float] = (0.0, -0.2)
    """First coefficients of the distortion."""
    same_camera: float = 0.02
    """Difference below which two candidate cameras count as one, in units of `SEARCH_SCALES`."""


OTHER_CAMERAS: Final = OtherCameraStarts()


def likely_cameras(
    evidence: Evidence, terms: Sequence[ResidualTerm], fit: WeightedFit, unknown: Sequence[str]
) -> tuple[list[WeightedFit], Array]:
    """Return all candidate cameras that fit the evidence, most likely first, and (C,) their probabilities.

    Args:
        evidence: Evidence with at least four points.
        terms: Terms of the evidence.
        fit: A camera that fits.
        unknown: Names of the unknown parameters.
    """
    scales = SEARCH_SCALES[[CAMERA_PARAMETERS.index(name) for name in unknown]]
    fits = [fit, *(fit_terms(terms, at, unknown, evidence.size) for at in _starts(evidence))]
    fits = sorted(
        (candidate for candidate in fits if math.isfinite(candidate.cost)),
        key=lambda candidate: -candidate.log_evidence(scales),
    )
    apart: list[WeightedFit] = []
    for candidate in fits:
        if all(
            (np.abs(_between(candidate, kept, CAMERA_PARAMETERS)) > OTHER_CAMERAS.same_camera * SEARCH_SCALES).any()
            for kept in apart
        ):
            apart.append(candidate)
    odds = np.array([kept.log_evidence(scales) for kept in apart])
    chance = np.exp(odds - odds.max())
    return apart, chance / chance.sum()


def spread_around(
    base: WeightedFit, rivals: Sequence[WeightedFit], chances: Sequence[float], unknown: Sequence[str]
) -> Array:
    """Return the covariance to add to a camera for other likely candidate cameras.

    Args:
        base: The camera with the covariance to extend.
        rivals: The other candidate cameras that fit the evidence.
        chances: Probability of each rival.
        unknown: Names in `CAMERA_PARAMETERS` of the P fitted parameters.

    Returns:
        (P, P) additional covariance of `base`, in the parameters' units. It never reduces a variance.
    """
    columns = [CAMERA_PARAMETERS.index(name) for name in unknown]
    scales = SEARCH_SCALES[columns]
    spread = np.zeros((len(columns), len(columns)))
    for rival, chance in zip(rivals, chances, strict=True):
        away = _between(rival, base, unknown)
        spread += chance * (np.outer(away, away) + rival.covariance(scales) - base.covariance(scales))
    # If another camera has a smaller variance in some direction, nothing is subtracted.
    eigenvalues, axes = np.linalg.eigh(spread / np.outer(scales, scales))
    axes = axes * scales[:, None]
    return np.asarray((axes * np.maximum(eigenvalues, 0)) @ axes.T)


def _between(first: WeightedFit, second: WeightedFit, names: Sequence[str]) -> Array:
    """Return (P,) parameter differences of two cameras; differences of yaw are wrapped to half a turn."""
    away = (first.at - second.at)[[CAMERA_PARAMETERS.index(name) for name in names]]
    return np.where(np.array(names) == "yaw", (away + math.pi) % (2 * math.pi) - math.pi, away)


def _starts(evidence: Evidence) -> list[Array]:
    """Return values of `CAMERA_PARAMETERS` of cameras with several lenses that see the points where they are marked,
    or near."""
    uv, places = [point.pixel for point in evidence.points], [point.place for point in evidence.points]
    out = []
    for bend in OTHER_CAMERAS.distortions:
        lens = Distortion("brown", (bend, 0.0, 0.0, 0.0)) if bend else Distortion()
        for length in OTHER_CAMERAS.focal_widths:
            K = centred(evidence.size, length * evidence.size[0])
            try:
                out.append(values_of(fit_camera_to_points(uv, places, evidence.size, K=K, distortion=lens).camera))
            except UserError:
                continue
    return out
