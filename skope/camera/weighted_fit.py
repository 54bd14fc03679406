"""The likeliest camera under terms of evidence: Levenberg and Marquardt's method, weights following the camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from skope.camera.evidence import Evidence
from skope.camera.evidence_terms import ResidualTerm, covariances_of, residuals_of
from skope.camera.model import Camera
from skope.camera.pose_from_points import POINT_FIT, fit_camera_to_points
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, camera_of_parameters, values_of
from skope.errors import UserError
from skope.types import Array


@dataclass(frozen=True)
class FitStarts:
    """First cameras and limits of the weighted fit to marks."""

    pitches_deg: tuple[float, ...] = (4.0, 10.0, 18.0, 28.0, 40.0, 55.0)
    """Downward pitch angles at which the search begins, degrees."""
    focal_widths: tuple[float, ...] = (0.45, 0.7, 1.1, 1.7, 2.6, 4.0)
    """Focal lengths at which the search begins, in widths of the image."""
    height_m: float = 6.0
    """Height over the road at which the search begins, metres."""
    rounds: int = 4
    """Rounds in which the weights follow the camera."""
    most_steps: int = 60
    """Maximum number of steps of a round."""
    finalists: int = 2
    """Number of starts that are followed to the end."""
    first_steps: int = 12
    """Number of steps after which these are chosen."""
    least_information: float = 1e-8
    """Information on a parameter that stands for none, in inverse squares of `SEARCH_SCALES`."""
    checked_points: int = 6
    """Number of points from which one that contradicts the others is found."""


FIT_STARTS: Final = FitStarts()

SEARCH_SCALES: Final = np.array([0.1, 0.05, 1.0, 1.0, 0.5, 0.05, 0.05, 0.05])
"""Scales of `CAMERA_PARAMETERS` in steps of the search."""


@dataclass(frozen=True, eq=False)
class WeightedFit:
    """The likeliest values of a camera's unknown parameters."""

    at: Array
    """(8,) values of `CAMERA_PARAMETERS`."""
    cost: float
    """Sum of the squares of the residuals, in standard deviations."""
    J: Array
    """(R, P) derivatives of these residuals by the unknown parameters."""
    blocks: tuple[Array, ...] = ()
    """The residuals of each piece of evidence."""
    log_weights: float = 0.0
    """Logarithm of the product of all weights: half that of the determinant of the evidence's inverse covariance."""

    def covariance(self, scales: Array) -> Array:
        """(P, P) of the unknown parameters, for a linear model; what nothing tells is known badly, not exactly.

        `scales` (P,) are what the parameters change by.
        """
        told, axes = np.linalg.eigh((self.J * scales).T @ (self.J * scales))
        axes = axes * scales[:, None]
        return np.asarray((axes / np.maximum(told, FIT_STARTS.least_information)) @ axes.T)

    def log_evidence(self, scales: Array) -> float:
        """Logarithm of how likely the evidence is whatever the camera, but for a constant (Laplace's approximation)."""
        told = np.linalg.eigvalsh((self.J * scales).T @ (self.J * scales))
        return float(
            -self.cost / 2 + self.log_weights - np.log(np.maximum(told, FIT_STARTS.least_information)).sum() / 2
        )


def best_fit(
    terms: Sequence[ResidualTerm], starts: Sequence[Array], unknown: Sequence[str], size: tuple[int, int]
) -> WeightedFit:
    """Find the likeliest camera; of many starts only those that are ahead after some steps go on.

    Args:
        terms: The evidence.
        starts: Values (8,) of `CAMERA_PARAMETERS` to begin with, one or more.
        unknown: Names of the P parameters to solve for; the others stay as they begin.
        size: Width and height of the image, pixels.

    Returns:
        The solution of least cost; its cost is infinite where none of the starts leads to one.
    """
    if len(starts) > FIT_STARTS.finalists:
        begun = [fit_terms(terms, at, unknown, size, rounds=1, steps=FIT_STARTS.first_steps) for at in starts]
        starts = [fit.at for fit in sorted(begun, key=lambda fit: fit.cost)[: FIT_STARTS.finalists]]
    return min((fit_terms(terms, at, unknown, size) for at in starts), key=lambda fit: fit.cost)


def fit_terms(
    terms: Sequence[ResidualTerm],
    begun: Array,
    unknown: Sequence[str],
    size: tuple[int, int],
    *,
    rounds: int = FIT_STARTS.rounds,
    steps: int = FIT_STARTS.most_steps,
) -> WeightedFit:
    """Solve for the unknown parameters; weights are those of the camera of the round before.

    Args:
        terms: The evidence.
        begun: (8,) values of `CAMERA_PARAMETERS` to begin with.
        unknown: Names of the P parameters to solve for; the others stay as they begin.
        size: Width and height of the image, pixels.
        rounds: Rounds at most; it ends earlier when nothing moves.
        steps: Evaluations of a round at most.

    Returns:
        The solution; its cost is infinite where a mark has no place under the camera that is reached.
    """
    columns = [CAMERA_PARAMETERS.index(name) for name in unknown]
    at, fit = begun.copy(), None
    for _ in range(rounds):
        camera = camera_of_parameters(at, size)
        try:
            weights = [np.linalg.inv(np.linalg.cholesky(C + 1e-12)) for C in covariances_of(terms, camera)]
        except np.linalg.LinAlgError:  # a camera that sees a mark where its lens ends
            return WeightedFit(at, math.inf, np.zeros((1, len(columns))))

        def residuals(values: Array, at: Array = at, weights: list[Array] = weights) -> Array:
            moved = at.copy()
            moved[columns] = values
            camera = camera_of_parameters(moved, size)
            return np.concatenate([W @ off for W, off in zip(weights, residuals_of(terms, camera), strict=True)])

        try:
            fit = least_squares(residuals, at[columns], x_scale=SEARCH_SCALES[columns], method="trf", max_nfev=steps)
        except (ValueError, np.linalg.LinAlgError):
            return WeightedFit(at, math.inf, np.zeros((1, len(columns))))
        step, at = fit.x - at[columns], at.copy()
        at[columns] = fit.x
        if (np.abs(step) < 1e-6 * SEARCH_SCALES[columns]).all():
            break
    assert fit is not None
    ends = np.cumsum([len(W) for W in weights])[:-1]
    log_weights = float(sum(np.log(np.diag(W)).sum() for W in weights))
    return WeightedFit(at, float(2 * fit.cost), np.asarray(fit.jac), tuple(np.split(fit.fun, ends)), log_weights)


def camera_starts(evidence: Evidence, start: Camera | None, terms: Sequence[ResidualTerm]) -> list[Array]:
    """Cameras that the search for the likeliest one begins with.

    Args:
        evidence: What was marked.
        start: The camera to begin with; None: cameras that suit the points, or those of a grid of focal lengths and
            tilts where points are too few.
        terms: The evidence as terms, which rank the cameras.

    Returns:
        Values (8,) of `CAMERA_PARAMETERS`, the best first: 1 of a given start, at most 2 from points, 6 of the grid.

    Raises:
        UserError: No camera sees the points as they were marked.
    """
    if start is not None:
        return [values_of(start)]
    if len(evidence.points) >= POINT_FIT.fewest_points:
        uv = np.array([point.pixel for point in evidence.points])
        places = np.array([point.place for point in evidence.points])
        # With one wrong point all may be led astray: each is left out once.
        keep = [np.arange(len(uv))]
        if len(uv) >= FIT_STARTS.checked_points:
            keep += [np.delete(np.arange(len(uv)), i) for i in range(len(uv))]
        out = []
        for rows in keep:
            try:
                out.append(values_of(fit_camera_to_points(uv[rows], places[rows], evidence.size).camera))
            except UserError:
                continue
        if not out:
            raise UserError("calibration: no camera sees the points so; do they lie on one line, or are two swapped?")
        return sorted(out, key=lambda at: _capped_cost(terms, camera_of_parameters(at, evidence.size)))[:2]
    grid = [
        np.array([math.log(share * evidence.size[0]), 0, 0, 0, FIT_STARTS.height_m, math.radians(tilt), 0, 0])
        for share in FIT_STARTS.focal_widths
        for tilt in FIT_STARTS.pitches_deg
    ]
    return sorted(grid, key=lambda at: _smooth_cost(terms, camera_of_parameters(at, evidence.size)))[:6]


def _capped_cost(terms: Sequence[ResidualTerm], camera: Camera) -> float:
    """Sum of the squares of the residuals in standard deviations, each piece of evidence up to 16: one may be wrong."""
    pairs = zip(residuals_of(terms, camera), covariances_of(terms, camera), strict=True)
    return sum(min(float(off @ np.linalg.solve(C + 1e-12, off)), 16.0) for off, C in pairs)


def _smooth_cost(terms: Sequence[ResidualTerm], camera: Camera) -> float:
    """Cost that ranks cameras which may be far from right."""
    return sum(float(np.linalg.norm(np.arcsinh(off))) for off in residuals_of(terms, camera))
