"""Estimate the most probable pose and shape of many vehicles at once by Levenberg and Marquardt's method.

The unknowns are a small shift and turn and the shape parameters, 6 + M per vehicle. The residuals are those of the
keypoints in the image (in standard deviations, with the weights of Cauchy's distribution), the shape parameters, and on
a known ground the height of the vehicle's origin and the lean of its upright axis.
"""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skope import keypoints
from skope.camera.ground_plane import Ground
from skope.pose import observations
from skope.pose.closed_form_starts import START_ERRORS, Starts
from skope.pose.observations import KEYPOINT_WEIGHTS, Observed
from skope.pose.shape_model import Shapes
from skope.types import Array


@dataclass(frozen=True)
class OptimiserLimits:
    """Limits of the optimiser."""

    most_iterations: int = 12
    """Maximum number of steps."""
    behind_cost: float = 1e6
    """Squared distance assigned to a keypoint behind the camera."""
    settled: float = 1e-5
    """Relative decrease of the cost in a step below which a fit has converged."""


OPTIMISER_LIMITS: Final = OptimiserLimits()


@dataclass(frozen=True, eq=False)
class Fits:
    """J fits for each of N vehicles, in the world frame (in the camera's if the ground is unknown)."""

    p: Array
    """(N, J, 3) positions, metres."""
    R: Array
    """(N, J, 3, 3) from the vehicle's axes to those of the frame."""
    a: Array
    """(N, J, M) shape parameters, with unit variance among vehicles of the body type."""
    kind: NDArray[np.intp]
    """(N, J) index of the body type."""
    cost: Array
    """(N, J) twice the negative log probability, up to a constant."""
    squared: Array
    """(N, J, 33) squared distances in the image between keypoints and the fit, in variances."""
    variance: Array
    """(N, J, 33) variances of the keypoints, pixels squared, including shape residuals outside the shape space."""
    normal: Array
    """(N, J, 6 + M, 6 + M) normal matrices in shift (metres), turn about the vehicle's own axes (radians) and shape."""

    def shaped(self, n: int, j: int) -> "Fits":
        """Return fits with arrays that begin with an axis (N * J,) as fits of shape (N, J)."""
        return Fits(*(value.reshape(n, j, *value.shape[1:]) for value in (getattr(self, f.name) for f in fields(self))))

    def take(self, rows: NDArray[np.intp]) -> "Fits":
        """Return a copy of the fits of the vehicles `rows`."""
        return Fits(*(getattr(self, f.name)[rows] for f in fields(self)))

    def ordered(self) -> "Fits":
        """Return the fits of each vehicle by rising cost."""
        order, row = np.argsort(self.cost, axis=1, kind="stable"), np.arange(len(self.cost))[:, None]
        return Fits(*(getattr(self, f.name)[row, order] for f in fields(self)))

    def replace_where(self, rows: NDArray[np.intp], other: "Fits", better: NDArray[np.bool_]) -> None:
        """Replace the fits of some vehicles, in place.

        Args:
            rows: (R,) vehicles of these fits.
            other: Fits of R vehicles, in the order of `rows`.
            better: (R,) whether to take the fit from `other`.
        """
        for f in fields(self):
            getattr(self, f.name)[rows[better]] = getattr(other, f.name)[better]

    def covariance(self, scale: Array) -> Array:
        """Return the (N, 4, 4) covariance of position (metres) and heading (radians) of each vehicle's best fit.

        It is the inverse of the normal matrix times `scale` (N,), plus the spread between the best and the worst fit.
        These have different body types, with probabilities from their costs. Fits with another heading do not count.
        """
        # Covariance of the best fit itself: rows and columns of x, y, z and the turn about the upright axis.
        eye = 1e-12 * np.eye(self.normal.shape[-1])
        within = np.linalg.inv(self.normal[:, 0] + eye)[:, [0, 1, 2, 5]][..., [0, 1, 2, 5]] * scale[:, None, None]
        # Difference of the last fit from the best one, in position and heading.
        turn = np.einsum("nij,njk->nik", np.swapaxes(self.R[:, 0], -1, -2), self.R[:, -1])
        angle = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
        apart = np.concatenate([self.p[:, -1] - self.p[:, 0], angle[:, None]], axis=1)
        # Variance of a mixture of the two: share (1 - share) times the squared distance.
        odds = np.exp(-np.clip(self.cost[:, -1] - self.cost[:, 0], 0, 700) / 2) * (np.abs(angle) < 0.5)
        share = odds / (1 + odds)
        return np.asarray(within + (share * (1 - share))[:, None, None] * apart[:, :, None] * apart[:, None, :])


def refine(seen: Observed, shapes: Shapes, ground: Ground | None, starts: Starts, kind: NDArray[np.intp]) -> Fits:
    """Optimise pose and shape of vehicles by Levenberg and Marquardt's method.

    Args:
        seen: Keypoints of N vehicles.
        shapes: The body types.
        ground: The road; None: unknown, and the poses are in the camera's frame.
        starts: (N, J) initial poses.
        kind: (N, J) index of the body type of each start.

    Returns:
        (N, J) fits, in the order of the starts.
    """
    n, j = kind.shape
    flat = seen.take(np.repeat(np.arange(n), j))
    problem = _Problem(flat, shapes, ground, kind.ravel())
    fits = problem.solve(starts.p.reshape(-1, 3), starts.R.reshape(-1, 3, 3))
    return fits.shaped(n, j)


class _Problem:
    """Optimisation problems of B vehicles, each with one body type and one start, solved together.

    Arrays have k keypoints per vehicle, the largest number of counted keypoints of any vehicle.
    """

    def __init__(self, seen: Observed, shapes: Shapes, ground: Ground | None, kind: NDArray[np.intp]) -> None:
        self._kind, self._ground = kind, ground
        # Without a ground, the camera's frame is the world.
        self._T = np.tile(np.eye(4), (len(kind), 1, 1)) if ground is None else seen.world_to_camera  # (B, 4, 4)
        most = max(1, int(seen.count.max(initial=1)))
        # The keypoints that count come first; the first k columns hold all of them.
        self._which = np.argsort(~seen.counted, axis=1, kind="stable")[:, :most]  # (B, k)
        row = np.arange(len(kind))[:, None]
        self._counted = seen.counted[row, self._which]
        self._xy = seen.xy[row, self._which]
        self._measured = seen.variance[row, self._which]  # pixels^2, of the measurement
        self._focal = seen.focal  # (B, 2)
        # Variance of residuals outside the shape space: at a depth of 1 m, pixels^2.
        self._rest = (seen.focal.mean(axis=1)[:, None] * shapes.rest[kind[:, None], self._which]) ** 2
        self._mean = shapes.mean[kind[:, None], self._which]  # (B, k, 3)
        self._directions = np.moveaxis(shapes.directions, 1, -1)[kind[:, None], self._which]  # (B, k, 3, M)

    def solve(self, p: Array, R: Array) -> Fits:
        """Optimise from B positions `p` (B, 3) and orientations `R` (B, 3, 3), which are changed in place.

        Returns one fit per start, in arrays without the axis J. A step that increases the cost is undone.
        """
        a = np.zeros((len(p), self._directions.shape[-1]))
        damping = np.full(len(p), 1e-3)
        cost, squared, variance, normal, gradient = self._linearised(p, R, a)
        live = np.arange(len(p))
        for _ in range(OPTIMISER_LIMITS.most_iterations):
            # Solve (H + damping diag H) step = -gradient for the vehicles that have not converged.
            part = self._part(live)
            H = normal[live].copy()
            diagonal = np.einsum("bii->bi", H)
            diagonal += damping[live, None] * diagonal + 1e-9
            step: Array = np.linalg.solve(H, -gradient[live][..., None])[..., 0].astype(np.float64)
            # Try the step: shift, turn about the vehicle's own axes, change of shape.
            moved = (
                p[live] + step[:, :3],
                R[live] @ Rotation.from_rotvec(step[:, 3:6]).as_matrix(),
                a[live] + step[:, 6:],
            )
            trial = part._linearised(*moved)
            better = trial[0] <= cost[live]
            gained = cost[live] - trial[0]
            # Keep improvements, and lower the damping there; raise it elsewhere.
            good = live[better]
            for kept, tried in zip((p, R, a), moved, strict=True):
                kept[good] = tried[better]
            for kept, tried in zip((cost, squared, variance, normal, gradient), trial, strict=True):
                kept[good] = tried[better]
            damping[live] *= np.where(better, 0.1, 10.0)
            # Drop vehicles with almost no gain in the last step, and those that no tiny step improves.
            live = live[~(better & (gained < OPTIMISER_LIMITS.settled * (1 + cost[live]))) & (damping[live] < 1e8)]
            if not live.size:
                break
        # Back from the k columns to all keypoints.
        row = np.arange(len(p))[:, None]
        all_squared = np.zeros((len(p), keypoints.K))
        all_variance = np.ones((len(p), keypoints.K))
        all_squared[row, self._which] = squared
        all_variance[row, self._which] = variance
        if self._ground is None:
            cost = np.where(_from_above(p, R), cost, START_ERRORS.impossible_cost)
        return Fits(p, R, a, self._kind, cost, all_squared, all_variance, normal)

    def _part(self, rows: NDArray[np.intp]) -> "_Problem":
        """Return the problems `rows`; without a copy if that is all of them."""
        if len(rows) == len(self._kind):
            return self
        out = object.__new__(_Problem)
        out._ground = self._ground
        for name in vars(self).keys() - {"_ground"}:
            setattr(out, name, getattr(self, name)[rows])
        return out

    def _linearised(self, p: Array, R: Array, a: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return the cost at positions (B, 3), orientations (B, 3, 3) and shapes (B, M), and its linearisation.

        Returns cost (B,), squared distances and variances (B, k), and the normal matrix (B, 6 + M, 6 + M) and gradient
        (B, 6 + M) of half the cost.
        """
        # Keypoints in the vehicle frame, in the world and in the camera frame.
        b, k, _, m = self._directions.shape
        body = self._mean + (self._directions.reshape(b, 3 * k, m) @ a[..., None]).reshape(b, k, 3)
        Rc = self._T[:, :3, :3]
        world = body @ np.swapaxes(R, -1, -2) + p[:, None]
        x, y, z = np.moveaxis(world @ np.swapaxes(Rc, -1, -2) + self._T[:, None, :3, 3], -1, 0)
        # Residuals in the image, pixels, and their weights (Cauchy's distribution).
        front = z > KEYPOINT_WEIGHTS.nearest_m
        near = np.where(front, z, KEYPOINT_WEIGHTS.nearest_m)
        fx, fy = self._focal[:, :1], self._focal[:, 1:]
        u, v = x / near, y / near
        away = np.stack([fx * (u - self._xy[..., 0]), fy * (v - self._xy[..., 1])], axis=-1)
        variance = self._measured + self._rest / near**2
        squared = np.where(front, (away**2).sum(axis=-1) / variance, OPTIMISER_LIMITS.behind_cost)
        weight = np.where(front & self._counted, observations.weight(squared) / variance, 0.0)
        # Derivatives of the two image coordinates by a shift along the axes of the camera, the world and the vehicle.
        # Products with one matrix per vehicle, in place of one per keypoint, take half the time.
        by_camera = np.zeros((b, k, 2, 3))
        by_x, by_y = fx / near, fy / near
        by_camera[..., 0, 0], by_camera[..., 0, 2] = by_x, -by_x * u
        by_camera[..., 1, 1], by_camera[..., 1, 2] = by_y, -by_y * v
        by_world = by_camera.reshape(b, 2 * k, 3) @ Rc
        by_body = (by_world @ R).reshape(b, k, 2, 3)
        # The whole Jacobian (B, k, 2, 6 + M): by shift, by turn about the vehicle's axes, by the shape's numbers.
        J = np.empty((b, k, 2, 6 + m))
        J[..., :3] = by_world.reshape(b, k, 2, 3)
        for axis, first, second in ((3, 1, 2), (4, 2, 0), (5, 0, 1)):  # of the cross product body x by_body
            J[..., axis] = body[..., None, first] * by_body[..., second]
            J[..., axis] -= body[..., None, second] * by_body[..., first]
        np.matmul(by_body, self._directions, out=J[..., 6:])
        # Normal equations of the keypoints, then of the shape parameters, which have unit variance.
        J = J.reshape(b, 2 * k, 6 + m)
        away = away.reshape(b, 2 * k, 1)
        weighted = np.swapaxes(J * np.repeat(weight, 2, axis=1)[..., None], -1, -2)
        normal, gradient = weighted @ J, (weighted @ away)[..., 0]
        normal[:, range(6, 6 + m), range(6, 6 + m)] += 1
        gradient[:, 6:] += a
        cost = (observations.cost(squared) * self._counted).sum(axis=1) + (a**2).sum(axis=1)
        if self._ground is not None:
            cost += self._on_road(p, R, normal, gradient)
        return cost, squared, variance, normal, gradient

    def _on_road(self, p: Array, R: Array, normal: Array, gradient: Array) -> Array:
        """Return the cost (B,) of not standing on the road; add its part to `normal` and `gradient`.

        The three residuals are the height of the vehicle's origin over the road and the x and y of its upright axis, in
        standard deviations.
        """
        assert self._ground is not None
        J = np.zeros((len(p), 3, 5))
        J[:, 0, 2] = 1 / self._ground.height_sigma
        # The upright axis moves by w x z: along the vehicle's x by w_y, along its y by -w_x.
        J[:, 1:, 3] = -R[:, :2, 1] / self._ground.tilt_sigma
        J[:, 1:, 4] = R[:, :2, 0] / self._ground.tilt_sigma
        height = (p[:, 2:] - self._ground.height) / self._ground.height_sigma
        residual = np.concatenate([height, R[:, :2, 2] / self._ground.tilt_sigma], axis=1)
        JT = np.swapaxes(J, -1, -2)
        normal[:, :5, :5] += JT @ J
        gradient[:, :5] += (JT @ residual[..., None])[..., 0]
        return np.asarray((residual**2).sum(axis=1))


def _from_above(p: Array, R: Array) -> NDArray[np.bool_]:
    """Return (B,) whether an upright camera sees upright vehicles from above their road."""
    return np.asarray((R[:, 1, 2] < 0) & (np.einsum("bi,bi->b", p, R[:, :, 2]) < 0))
