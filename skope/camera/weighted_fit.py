"""Fit the most likely camera to terms of evidence: Levenberg and Marquardt's method with reweighting per round."""

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
    """Initial cameras and limits of the weighted fit to marks."""

    pitches_deg: tuple[float, ...] = (4.0, 10.0, 18.0, 28.0, 40.0, 55.0)
    """Downward pitch angles of the initial cameras, degrees."""
    focal_widths: tuple[float, ...] = (0.45, 0.7, 1.1, 1.7, 2.6, 4.0)
    """Focal lengths of the initial cameras, in widths of the image."""
    height_m: float = 6.0
    """Height over the road of the initial cameras, metres."""
    rounds: int = 4
    """Maximum number of rounds; the weights are updated before each round."""
    most_steps: int = 60
    """Maximum number of evaluations per round."""
    finalists: int = 2
    """Number of starts that are optimised to the end."""
    first_steps: int = 12
    """Number of evaluations after which the finalists are selected."""
    least_information: float = 1e-8
    """Lower limit of the information on a parameter, in inverse squares of `SEARCH_SCALES`."""
    checked_points: int = 6
    """Minimum number of points for the search for wrong points."""


FIT_STARTS: Final = FitStarts()

SEARCH_SCALES: Final = np.array([0.1, 0.05, 1.0, 1.0, 0.5, 0.05, 0.05, 0.05])
"""Scales of `CAMERA_PARAMETERS` in the search."""


@dataclass(frozen=True, eq=False)
class WeightedFit:
    """Most likely values of a camera's unknown parameters."""

    at: Array
    """(8,) values of `CAMERA_PARAMETERS`."""
    cost: float
    """Sum of the squared residuals, in standard deviations."""
    J: Array
    """(R, P) derivatives of these residuals with respect to the unknown parameters."""
    blocks: tuple[Array, ...] = ()
    """The residuals of each piece of evidence."""
    log_weights: float = 0.0
    """Logarithm of the product of all weights: half the log determinant of the evidence's inverse covariance."""

    def covariance(self, scales: Array) -> Array:
        """Return the covariance (P, P) of the unknown parameters, for a linear model.

        Directions without evidence get a large variance. `scales` (P,) are the scales of the parameters.
        """
        eigenvalues, axes = np.linalg.eigh((self.J * scales).T @ (self.J * scales))
        axes = axes * scales[:, None]
        return np.asarray((axes / np.maximum(eigenvalues, FIT_STARTS.least_information)) @ axes.T)

    def log_evidence(self, scales: Array) -> float:
        """Return the log marginal likelihood of the evidence, up to a constant (Laplace's approximation)."""
        eigenvalues = np.linalg.eigvalsh((self.J * scales).T @ (self.J * scales))
        return float(
            -self.cost / 2 + self.log_weights - np.log(np.maximum(eigenvalues, FIT_STARTS.least_information)).sum() / 2
        )


def best_fit(
    terms: Sequence[ResidualTerm], starts: Sequence[Array], unknown: Sequence[str], size: tuple[int, int]
) -> WeightedFit:
    """Find the most likely camera from several initial values.

    Args:
        terms: The evidence.
        starts: Initial values (8,) of `CAMERA_PARAMETERS`, one or more.
        unknown: Names of the P parameters to solve for; the others keep their initial values.
        size: Width and height of the image, pixels.

    Returns:
        The solution of lowest cost; its cost is infinite if no start leads to a solution.
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
    """Solve for the unknown parameters. The weights of a round come from the camera of the previous round.

    Args:
        terms: The evidence.
        begun: (8,) initial values of `CAMERA_PARAMETERS`.
        unknown: Names of the P parameters to solve for; the others keep their initial values.
        size: Width and height of the image, pixels.
        rounds: Maximum number of rounds; the fit ends earlier when it has converged.
        steps: Maximum number of evaluations per round.

    Returns:
        The solution; its cost is infinite if a mark cannot be projected with the camera of a round.
    """
    columns = [CAMERA_PARAMETERS.index(name) for name in unknown]
    at, fit = begun.copy(), None
    for _ in range(rounds):
        camera = camera_of_parameters(at, size)
        try:
            weights = [np.linalg.inv(np.linalg.cholesky(C + 1e-12)) for C in covariances_of(terms, camera)]
        except np.linalg.LinAlgError:  # a mark lies at the limit of the lens model
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
    """Return initial cameras for the search.

    Args:
        evidence: The marks.
        start: The initial camera; None: cameras that fit the points, or, with too few points, those of a grid of focal
            lengths and tilts.
        terms: The evidence as terms, which rank the cameras.

    Returns:
        Values (8,) of `CAMERA_PARAMETERS`, best first: 1 for a given start, at most 2 from points, 6 from the grid.

    Raises:
        UserError: No camera fits the points.
    """
    if start is not None:
        return [values_of(start)]
    if len(evidence.points) >= POINT_FIT.fewest_points:
        uv = np.array([point.pixel for point in evidence.points])
        places = np.array([point.place for point in evidence.points])
        # One wrong point may spoil all fits, so each point is left out once.
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
            raise UserError("calibration: no camera fits the points; check for swapped points and points on one line")
        return sorted(out, key=lambda at: _capped_cost(terms, camera_of_parameters(at, evidence.size)))[:2]
    grid = [
        np.array([math.log(share * evidence.size[0]), 0, 0, 0, FIT_STARTS.height_m, math.radians(tilt), 0, 0])
        for share in FIT_STARTS.focal_widths
        for tilt in FIT_STARTS.pitches_deg
    ]
    return sorted(grid, key=lambda at: _smooth_cost(terms, camera_of_parameters(at, evidence.size)))[:6]


def _capped_cost(terms: Sequence[ResidualTerm], camera: Camera) -> float:
    """Return the sum of squared residuals in standard deviations, each term capped at 16 because one may be wrong."""
    pairs = zip(residuals_of(terms, camera), covariances_of(terms, camera), strict=True)
    return sum(min(float(off @ np.linalg.solve(C + 1e-12, off)), 16.0) for off, C in pairs)


def _smooth_cost(terms: Sequence[ResidualTerm], camera: Camera) -> float:
    """Return a cost that ranks cameras which may be far from correct."""
    return sum(float(np.linalg.norm(np.arcsinh(off))) for off in residuals_of(terms, camera))
