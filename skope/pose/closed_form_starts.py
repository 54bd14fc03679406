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
    # A keypoint (x, y, z) of the body lies at (X + c x - s y, Y + s x + c y, z) in the world, where X, Y are the place
    # and c, s are cosine and sine of the heading. Each keypoint gives two equations, rows . world = -shift, that are
    # linear in X, Y, c, s: those of its column and its row in the image.
    # X and Y count from the camera's foot, because world coordinates may be millions, as in UTM.
    R = seen.T_camera_world[:3, :3]
    foot = -R.T @ seen.T_camera_world[:3, 3] * [1.0, 1.0, 0.0]
    t = seen.T_camera_world[:3, 3] + R @ foot
    body = shapes.mean[None, :, :-1]  # (1, T, 33, 3)
    x, y, z = body[..., 0], body[..., 1], body[..., 2] + ground.height
    weight = (seen.counted if chosen is None else chosen) / seen.variance
    rows = np.stack([R[i] - seen.xy[..., i : i + 1] * R[2] for i in (0, 1)])[:, :, None]  # (2, N, 1, 33, 3)
    shift = np.stack([t[i] - seen.xy[..., i] * t[2] for i in (0, 1)])[:, :, None]  # (2, N, 1, 33)
    m0, m1, m2 = rows[..., 0], rows[..., 1], rows[..., 2]
    # The equations A (X, Y, c, s) = b.
    A = np.stack(np.broadcast_arrays(m0, m1, m0 * x + m1 * y, m1 * x - m0 * y), axis=-1)  # (2, N, T, 33, 4)
    b = -(m2 * z + shift)
    # All equations of columns before all of rows.
    A = np.concatenate([A[0], A[1]], axis=2)
    b = np.concatenate([b[0], b[1]], axis=2)
    w = np.broadcast_to(np.concatenate([weight, weight], axis=1)[:, None], b.shape)
    # An equation's error is in metres at the keypoint's depth. The first round assumes equal depths, the second uses
    # the depths of the first.
    for last in (False, True):
        AT = np.swapaxes(A, -1, -2)
        normal = (AT * w[:, :, None]) @ A + 1e-9 * np.eye(4)
        solution = np.linalg.solve(normal, AT @ (w * b)[..., None])[..., 0]
        # The length of (c, s) is the vehicle's size relative to the mean: 1 for a pure rotation.
        size = np.maximum(np.hypot(solution[..., 2], solution[..., 3]), 1e-9)
        turn = solution[..., 2:] / size[..., None]
        c, s = turn[..., :1], turn[..., 1:]
        # The mean is placed unscaled, with its middle at that of the scaled one.
        world = np.empty((*c.shape[:2], *body.shape[2:]))
        world[..., 0] = solution[..., :1] + c * x - s * y
        world[..., 1] = solution[..., 1:2] + s * x + c * y
        world[..., 2] = z
        seen_from = world @ R.T + t
        depth = np.maximum(seen_from[..., 2], KEYPOINT_WEIGHTS.nearest_m)
        if last:
            break
        w = np.concatenate([weight, weight], axis=1)[:, None] / np.concatenate([depth, depth], axis=-1) ** 2
    # Cost of the misfit, and of an unlikely size for the type.
    cost = _cost(seen, seen_from) + (np.log(size) / START_ERRORS.log_size) ** 2
    # The starts as positions and rotation matrices.
    zero = np.zeros_like(c[..., 0])
    R_wv = np.stack(
        [
            np.stack([c[..., 0], -s[..., 0], zero], -1),
            np.stack([s[..., 0], c[..., 0], zero], -1),
            np.stack([zero, zero, zero + 1], -1),
        ],
        axis=-2,
    )
    p = np.concatenate([solution[..., :2] + foot[:2], np.full((*solution.shape[:2], 1), ground.height)], axis=-1)
    return Starts(p, R_wv, cost)


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
    depth = points[..., 2]
    near = np.maximum(depth, KEYPOINT_WEIGHTS.nearest_m)
    away = (points[..., :2] / near[..., None] - seen.xy[:, None]) * seen.focal
    variance = seen.variance[:, None] + (seen.focal.mean() * START_ERRORS.misfit_m / near) ** 2
    squared = (away**2).sum(axis=-1) / variance
    behind = ((depth <= KEYPOINT_WEIGHTS.nearest_m) & seen.counted[:, None]).any(axis=-1)
    cost = (observations.cost(squared) * seen.counted[:, None]).sum(axis=-1)
    return np.asarray(np.where(behind, START_ERRORS.impossible_cost, cost))
