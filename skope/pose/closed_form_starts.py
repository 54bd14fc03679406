"""Starts of the pose search: place each body type's mean shape on the keypoints in closed form.

On a known ground, a vehicle has a position (x, y) and a heading. For keypoints of known height, x_camera - u z_camera =
0 is linear in x, y, cos and sin. Least squares over the four also gives the ratio of the vehicle's size to the mean,
from cos^2 + sin^2. Without a ground, OpenCV's SQPnP (Terzakis and Lourakis, 2020) gives the start of each type.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.ground_plane import Ground
from skope.pose import observations
from skope.pose.observations import KEYPOINT_WEIGHTS, Observed
from skope.pose.shape_model import Shapes
from skope.types import Array, Mask


@dataclass(frozen=True)
class StartErrors:
    """Error model of closed-form poses."""

    impossible_cost: float = 1e9
    """Cost of an impossible pose."""
    misfit_m: float = 0.12
    """Standard deviation of a keypoint from the mean of its body type, metres."""
    log_size: float = 0.08
    """Standard deviation of the logarithm of a vehicle's size over the mean of its type."""


START_ERRORS: Final = StartErrors()


@dataclass(frozen=True, eq=False)
class Starts:
    """Initial poses of the optimisation: J for each of N vehicles."""

    p: Array
    """(N, J, 3) positions, metres."""
    R: Array
    """(N, J, 3, 3) from the vehicle's axes to the world's, or to the camera's if the ground is unknown."""
    cost: Array
    """(N, J) approximate twice the negative log likelihood."""

    def take(self, chosen: NDArray[np.intp]) -> "Starts":
        """Return the starts `chosen` (N, J') of each vehicle."""
        row = np.arange(len(chosen))[:, None]
        return Starts(self.p[row, chosen], self.R[row, chosen], self.cost[row, chosen])

    def gathered(self, times: int) -> "Starts":
        """Reshape (N * times, J) to (N, times * J): all starts of a vehicle in one row.

        `self` holds the N vehicles `times` times, in consecutive blocks.
        """
        n = len(self.p) // times

        def together(values: Array) -> Array:
            return np.asarray(np.moveaxis(values.reshape(times, n, *values.shape[1:]), 0, 1)).reshape(
                n, -1, *values.shape[2:]
            )

        return Starts(together(self.p), together(self.R), together(self.cost))


def on_ground(seen: Observed, shapes: Shapes, ground: Ground, chosen: Mask | None = None) -> Starts:
    """Estimate an initial pose on the road for each vehicle and body type, from the mean shape of the body type.

    Args:
        seen: Keypoints of N vehicles.
        shapes: T body types.
        ground: The level road.
        chosen: (N, 33) keypoints to use for placing; None: all that count.

    Returns:
        (N, T) starts. Their cost is over all keypoints that count, regardless of `chosen`.
    """
    # X and Y count from the camera's foot, because world coordinates may be millions, as in UTM.
    T_camera_world = seen.world_to_camera
    R, foot = T_camera_world[:, :3, :3], seen.eye * [1.0, 1.0, 0.0]
    t = T_camera_world[:, :3, 3] + (R @ foot[..., None])[..., 0]
    weight = (seen.counted if chosen is None else chosen) / seen.variance
    image_terms = _image_terms(seen, R, t) * weight[:, None]  # (N, 7, 33)
    body = np.concatenate([shapes.mean[:, :-1], np.ones((len(shapes.types), keypoints.K, 1))], axis=-1)
    body[..., 2] += ground.height
    body_terms = _body_terms(body)  # (T, 33, 9)
    # An equation's error is in metres at the keypoint's depth. The first round assumes equal depths, the second uses
    # the depths of the first. Arrays begin with (T, N).
    X, Y, c, s, _ = _placed(image_terms[None], body_terms)
    depth = _in_camera(R, t, X, Y, c, s, body)[:, :, 2]
    near = np.maximum(depth, KEYPOINT_WEIGHTS.nearest_m)
    X, Y, c, s, size = _placed(image_terms / near[:, :, None] ** 2, body_terms)
    # The mean is placed unscaled, with its middle at that of the scaled one.
    seen_from = np.moveaxis(_in_camera(R, t, X, Y, c, s, body), (0, 2), (1, 3))
    # Cost of the misfit, and of an unlikely size for the type.
    cost = _cost(seen, seen_from) + (np.log(size.T) / START_ERRORS.log_size) ** 2
    # The starts as positions and rotation matrices.
    R_wv = np.zeros((*cost.shape, 3, 3))
    R_wv[..., 0, 0] = R_wv[..., 1, 1] = c.T
    R_wv[..., 1, 0], R_wv[..., 0, 1], R_wv[..., 2, 2] = s.T, -s.T, 1.0
    p = np.stack([X.T + foot[:, :1], Y.T + foot[:, 1:2], np.full_like(cost, ground.height)], axis=-1)
    return Starts(p, R_wv, cost)


# A keypoint (x, y, z) of the body lies at (X + c x - s y, Y + s x + c y, z) in the world, where X, Y are the place and
# c, s are cosine and sine of the heading. Each keypoint gives two equations, m . world = -shift, that are linear in
# X, Y, c, s: those of its column and its row in the image. Their normal equations are sums over the keypoints of
# products of a term that depends on the image and a term that depends on the body. So they need one matrix product for
# all vehicles and body types.


def _image_terms(seen: Observed, R: Array, t: Array) -> Array:
    """Return (N, 7, 33) terms of the normal equations that depend on a keypoint's position in the image."""
    m = np.stack([R[:, None, i] - seen.xy[..., i : i + 1] * R[:, None, 2] for i in (0, 1)])  # (2, N, 33, 3)
    shift = np.stack([t[:, i, None] - seen.xy[..., i] * t[:, 2, None] for i in (0, 1)])  # (2, N, 33)
    m0, m1, m2 = np.moveaxis(m, -1, 0)
    terms = np.stack([m0 * m0, m0 * m1, m1 * m1, -m0 * shift, -m1 * shift, -m0 * m2, -m1 * m2], axis=2)
    return np.asarray(terms.sum(axis=0))


def _body_terms(body: Array) -> Array:
    """Return (T, 33, 9) terms of the normal equations that depend on the place of a keypoint on the body.

    `body` is (T, 33, 4): x, y, z, 1.
    """
    x, y, z, one = np.moveaxis(body, -1, 0)
    return np.stack([one, x, y, x * x, x * y, y * y, z, x * z, y * z], axis=-1)


def _placed(image_terms: Array, body_terms: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Solve the normal equations for image terms (T or 1, N, 7, 33), with their weights, and body terms (T, 33, 9).

    Returns:
        X, Y, the cosine and sine of the heading, and the size relative to the mean, (T, N) each.
    """
    sums = image_terms.reshape(len(image_terms), -1, keypoints.K) @ body_terms
    sums = sums.reshape(len(body_terms), -1, 7, 9)
    (a, ax, ay, axx, axy, ayy), (b, bx, by, bxx, bxy, byy), (d, dx, dy, dxx, dxy, dyy) = (
        np.moveaxis(sums[:, :, i, :6], -1, 0) for i in range(3)
    )
    u, ux, uy = np.moveaxis(sums[:, :, 3, :3] + sums[:, :, 5, 6:], -1, 0)
    v, vx, vy = np.moveaxis(sums[:, :, 4, :3] + sums[:, :, 6, 6:], -1, 0)
    xc, xs, yc, ys = ax + by, bx - ay, bx + dy, dx - by
    cc, cs, ss = axx + 2 * bxy + dyy, bxx - axy - byy + dxy, ayy - 2 * bxy + dxx
    normal = np.stack([a, b, xc, xs, b, d, yc, ys, xc, yc, cc, cs, xs, ys, cs, ss], axis=-1)
    normal = normal.reshape(*a.shape, 4, 4) + 1e-9 * np.eye(4)
    right = np.stack([u, v, ux + vy, vx - uy], axis=-1)
    X, Y, c, s = np.moveaxis(np.linalg.solve(normal, right[..., None])[..., 0], -1, 0)
    # The length of (c, s) is the vehicle's size relative to the mean: 1 for a pure rotation.
    size = np.maximum(np.hypot(c, s), 1e-9)
    return X, Y, c / size, s / size, size


def _in_camera(R: Array, t: Array, X: Array, Y: Array, c: Array, s: Array, body: Array) -> Array:
    """Return (T, N, 3, 33) keypoints of the placed means in the camera frame, metres. `body` is (T, 33, 4)."""
    x, y, z = np.moveaxis(R, -1, 0)  # (N, 3) each: the world's axes in the camera frame
    by_x, by_y = x * c[..., None] + y * s[..., None], y * c[..., None] - x * s[..., None]
    origin = x * X[..., None] + y * Y[..., None] + t
    moves = np.stack([by_x, by_y, np.broadcast_to(z, by_x.shape), origin], axis=-1)  # (T, N, 3, 4)
    rows = moves.reshape(len(moves), -1, 4) @ np.swapaxes(body, -1, -2)
    return np.asarray(rows.reshape(*X.shape, 3, keypoints.K))


def placed_anywhere(seen: Observed, shapes: Shapes, chosen: Mask | None = None) -> Starts:
    """Place each body type's mean on the keypoints of each vehicle, anywhere in front of the camera, by SQPnP.

    Args:
        seen: Keypoints of N vehicles.
        shapes: T body types.
        chosen: (N, 33) keypoints to use for placing; None: all that count.

    Returns:
        (N, T) starts in the camera's frame. With fewer than four keypoints, or without a solution, the cost is
        `START_ERRORS.impossible_cost`.
    """
    mask = seen.counted if chosen is None else chosen
    n, kinds = len(mask), len(shapes.types)
    p, R = np.zeros((n, kinds, 3)), np.tile(np.eye(3), (n, kinds, 1, 1))
    p[..., 2] = 10.0
    found = np.zeros((n, kinds), dtype=bool)
    for i in range(n):
        if mask[i].sum() < 4:
            continue
        for k in range(kinds):
            try:
                good, turn, shift = cv2.solvePnP(
                    shapes.mean[k, :-1][mask[i]], seen.xy[i, mask[i]], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
                )
            except cv2.error:
                continue
            if good and np.isfinite(shift).all() and np.isfinite(turn).all():
                p[i, k], R[i, k], found[i, k] = shift[:, 0], cv2.Rodrigues(turn)[0], True
    points = np.einsum("nkij,kmj->nkmi", R, shapes.mean[:, :-1]) + p[:, :, None]
    return Starts(p, R, np.where(found, _cost(seen, points), START_ERRORS.impossible_cost))


def _cost(seen: Observed, points: Array) -> Array:
    """Return the cost (N, T) of vehicles with keypoints at `points` (N, T, 33, 3) in the camera frame, metres."""
    depth, focal = points[..., 2], seen.focal[:, None, None]
    near = np.maximum(depth, KEYPOINT_WEIGHTS.nearest_m)
    away = (points[..., :2] / near[..., None] - seen.xy[:, None]) * focal
    variance = seen.variance[:, None] + (focal.mean(axis=-1) * START_ERRORS.misfit_m / near) ** 2
    squared = (away**2).sum(axis=-1) / variance
    behind = ((depth <= KEYPOINT_WEIGHTS.nearest_m) & seen.counted[:, None]).any(axis=-1)
    cost = (observations.cost(squared) * seen.counted[:, None]).sum(axis=-1)
    return np.asarray(np.where(behind, START_ERRORS.impossible_cost, cost))
