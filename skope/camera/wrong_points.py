"""Wrong ones among marked points: sets of them are weighed by how likely the evidence is if those are wrong.

A wrong point lies anywhere near its place, as when the next corner of a marking was clicked. How likely each set of
wrong points is follows from the evidence under the camera that suits it best (Laplace's approximation), which weighs
that a set explains more against how readily it would explain anything. Where several sets are likely, the camera is
that of the likeliest, and its covariance holds the others' cameras too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.camera.evidence import Evidence
from skope.camera.evidence_terms import EvidenceTerm, point_term
from skope.camera.other_cameras import spread_around
from skope.camera.pose_from_points import FEWEST, fit_camera_to_points
from skope.camera.uncertain_camera import PARAMETERS, values_of
from skope.camera.weighted_fit import SCALES, WeightedFit, best_fit, fit_terms
from skope.errors import UserError
from skope.types import Array

_WRONG: Final = 0.02
"""Share of wrong ones among the points that people mark: one in fifty."""
_ASIDE_M: Final = (3.5, 30.0)
"""Standard deviations of wrong points, metres along x and y: aside by a lane's width, or anywhere."""
_DOUBTED: Final = 8
"""So many points at most may be wrong, those that the others contradict most."""
_POINTS_PER_WRONG: Final = 4
"""One point in so many may be wrong at most."""
_TOLD: Final = 0.05
"""Probability from which it is told that a point may be wrong."""


@dataclass(frozen=True, eq=False)
class JudgedPoints:
    """Likeliest fit without wrong points, and which points these are."""

    fit: WeightedFit
    """The likeliest camera without the wrong points."""
    wrong: tuple[str, ...]
    """Names of the points that are likeliest to be wrong."""
    doubts: tuple[str, ...]
    """Sentences on points that may be wrong besides."""
    spread: Array
    """(P, P) what the cameras of other sets of wrong points add to the covariance."""


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    wrong: frozenset[int]
    """Places of the wrong points in the evidence."""
    fit: WeightedFit
    log_odds: float


def with_wrong_points(
    evidence: Evidence, terms: Sequence[EvidenceTerm], fit: WeightedFit, unknown: Sequence[str]
) -> JudgedPoints:
    """The points that are likely to be wrong, and the camera of the others.

    Args:
        evidence: With six points or more.
        terms: Its terms, those of the points first.
        fit: The likeliest camera if no point is wrong.
        unknown: Names of the parameters that are.
    """
    scales = SCALES[[PARAMETERS.index(name) for name in unknown]]

    def hypothesis(wrong: frozenset[int], starts: Sequence[Array]) -> _Hypothesis:
        """The likeliest of how far aside the wrong points are."""
        tried = []
        for aside in _ASIDE_M:
            moved = list(terms)
            for i in wrong:
                moved[i] = point_term(replace(evidence.points[i], sigma_m=aside))
            best = best_fit(moved, starts, unknown, evidence.size)
            odds = len(wrong) * math.log(_WRONG / (1 - _WRONG) / len(_ASIDE_M))
            tried.append(_Hypothesis(wrong, best, best.log_evidence(scales) + odds))
            if not any(np.linalg.norm(best.blocks[i]) > 2.5 for i in wrong):
                break
            starts = [best.at]
        return max(tried, key=lambda one: one.log_odds)

    none = _Hypothesis(frozenset(), fit, fit.log_evidence(scales))
    found, doubted = [none], _doubted(fit, len(evidence.points))
    best = none
    while len(best.wrong) < len(evidence.points) // _POINTS_PER_WRONG:
        further = [
            hypothesis(best.wrong | {i}, [best.fit.at, *_pose_without(evidence, best.wrong | {i})])
            for i in doubted
            if i not in best.wrong
        ]
        further = [one for one in further if math.isfinite(one.fit.cost)]
        found += further
        ahead = max(further, key=lambda one: one.log_odds, default=None)
        if ahead is None or ahead.log_odds <= best.log_odds:
            break
        best = ahead
    return _judged(evidence, terms, unknown, best, found)


def _judged(
    evidence: Evidence,
    terms: Sequence[EvidenceTerm],
    unknown: Sequence[str],
    best: _Hypothesis,
    found: Sequence[_Hypothesis],
) -> JudgedPoints:
    share = np.exp(np.array([one.log_odds - best.log_odds for one in found]))
    share /= share.sum()
    right = [term for i, term in enumerate(terms) if i not in best.wrong]
    fit = fit_terms(right, best.fit.at, unknown, evidence.size) if best.wrong else best.fit
    others = [(one.fit, weight) for one, weight in zip(found, share.tolist(), strict=True) if one is not best]
    spread = spread_around(fit, [one for one, _ in others], [weight for _, weight in others], unknown)
    names = [point.name for point in evidence.points]
    wrong = tuple(names[i] for i in sorted(best.wrong))
    return JudgedPoints(fit, wrong, _doubts(names, best, found, share), spread)


def _doubts(names: Sequence[str], best: _Hypothesis, found: Sequence[_Hypothesis], share: Array) -> tuple[str, ...]:
    """Sentences on points that may be wrong besides, or in place of, those of the likeliest set."""
    chance = [
        sum(weight for one, weight in zip(found, share, strict=True) if i in one.wrong) for i in range(len(names))
    ]
    others = [names[i] for i in range(len(names)) if chance[i] >= _TOLD and i not in best.wrong]
    unsure = [names[i] for i in sorted(best.wrong) if chance[i] < 1 - _TOLD]
    if unsure and others:
        return (
            f"point {' and '.join(unsure)} contradicts the others and is left out, but they agree nearly as well "
            f"without {' or '.join(others)}: mark these again",
        )
    if unsure:
        return (
            f"point {' and '.join(unsure)} contradicts the others and is left out, but may be right: mark it again",
        )
    if others:
        return (f"point {' or '.join(others)} may be wrong: the others agree better without; mark again",)
    return ()


def _doubted(fit: WeightedFit, count: int) -> list[int]:
    """The points without which the cost falls most, for a linear model: r (1 - H)^-1 r, H the projection onto it."""
    first = np.cumsum([0, *(len(block) for block in fit.blocks)])
    hat = fit.J @ np.linalg.pinv(fit.J)
    gains = []
    for i in range(count):
        rows = slice(first[i], first[i + 1])
        free = np.eye(len(fit.blocks[i])) - hat[rows, rows] + 1e-9 * np.eye(len(fit.blocks[i]))
        gains.append(float(fit.blocks[i] @ np.linalg.solve(free, fit.blocks[i])))
    return [int(i) for i in np.argsort(gains)[::-1][:_DOUBTED]]


def _pose_without(evidence: Evidence, wrong: frozenset[int]) -> list[Array]:
    """Values of `PARAMETERS` that the other points alone show."""
    kept = [point for i, point in enumerate(evidence.points) if i not in wrong]
    if len(kept) < FEWEST:
        return []
    try:
        pose = fit_camera_to_points([point.pixel for point in kept], [point.place for point in kept], evidence.size)
    except UserError:
        return []
    return [values_of(pose.camera)]
