"""Few points may suit several cameras: one that is near with a wide lens, and one that is far with a long one.

The search goes to one of them; how likely each is follows from the evidence under it (Laplace's approximation), and
where several are likely, the covariance of the likeliest holds the others too.
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
    """First cameras of the search for other solutions."""

    focal_widths: tuple[float, float, float, float] = (0.45, 0.7, 1.1, 2.6)
    """Focal lengths, in widths of the image."""
    distortions: tuple[float, float] = (0.0, -0.2)
    """First coefficients of the distortion."""
    same_camera: float = 0.02
    """Cameras that differ by less are one, in units of `SEARCH_SCALES`."""


OTHER_CAMERAS: Final = OtherCameraStarts()


def likely_cameras(
    evidence: Evidence, terms: Sequence[ResidualTerm], fit: WeightedFit, unknown: Sequence[str]
) -> tuple[list[WeightedFit], Array]:
    """All cameras that suit the evidence, the likeliest first, and (C,) the probability of each.

    Args:
        evidence: With four points or more.
        terms: Its terms.
        fit: One such camera.
        unknown: Names of the parameters that are.
    """
    scales = SEARCH_SCALES[[CAMERA_PARAMETERS.index(name) for name in unknown]]
    fits = [fit, *(fit_terms(terms, at, unknown, evidence.size) for at in _starts(evidence))]
    fits = sorted((one for one in fits if math.isfinite(one.cost)), key=lambda one: -one.log_evidence(scales))
    apart: list[WeightedFit] = []
    for one in fits:
        if all(
            (np.abs(_between(one, other, CAMERA_PARAMETERS)) > OTHER_CAMERAS.same_camera * SEARCH_SCALES).any()
            for other in apart
        ):
            apart.append(one)
    odds = np.array([one.log_evidence(scales) for one in apart])
    chance = np.exp(odds - odds.max())
    return apart, chance / chance.sum()


def spread_around(
    own: WeightedFit, others: Sequence[WeightedFit], chances: Sequence[float], unknown: Sequence[str]
) -> Array:
    """Covariance that other likely cameras add to that of one camera.

    Args:
        own: The camera around which the covariance is taken.
        others: The other cameras that suit the evidence.
        chances: Probability of each of them.
        unknown: Names of the P parameters that were solved for, of `CAMERA_PARAMETERS`.

    Returns:
        (P, P) what is added to the covariance of `own`, in the parameters' units; no direction's variance is made
        smaller.
    """
    columns = [CAMERA_PARAMETERS.index(name) for name in unknown]
    scales = SEARCH_SCALES[columns]
    spread = np.zeros((len(columns), len(columns)))
    for one, chance in zip(others, chances, strict=True):
        away = _between(one, own, unknown)
        spread += chance * (np.outer(away, away) + one.covariance(scales) - own.covariance(scales))
    # Others may know the camera better in some way: that takes nothing off.
    told, axes = np.linalg.eigh(spread / np.outer(scales, scales))
    axes = axes * scales[:, None]
    return np.asarray((axes * np.maximum(told, 0)) @ axes.T)


def _between(one: WeightedFit, other: WeightedFit, names: Sequence[str]) -> Array:
    """(P,) by what parameters of two cameras differ; yaw is an angle: a turn more or less is none."""
    away = (one.at - other.at)[[CAMERA_PARAMETERS.index(name) for name in names]]
    return np.where(np.array(names) == "yaw", (away + math.pi) % (2 * math.pi) - math.pi, away)


def _starts(evidence: Evidence) -> list[Array]:
    """Values of `CAMERA_PARAMETERS` of cameras with several lenses that see the points where they are marked, or
    near."""
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
