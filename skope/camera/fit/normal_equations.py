"""Normal equations of many views of many vehicles, and the elimination of poses and shapes.

The reduced system (Schur's complement, Triggs et al. 2000) is a sum with one part per vehicle.
"""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.types import Array, Mask

_POSE_STRIDE: Final = np.array([3.0, 3.0, 0.5])
"""Maximum change of a pose per step: x and y in heights of the camera, heading in radians."""
REGULARISING_SHARE: Final = 1e-10
"""Share of its trace that is added to the diagonal of a singular matrix."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """Costs, and normal equations of B views in pose (3), shape (M) and shared unknowns (U, or none)."""

    squared: Array
    vehicle_cost: Array
    normal: Array
    """(B, 3 + M + U, 3 + M + U) normal matrices."""
    gradient: Array
    """(B, 3 + M + U) gradients."""
    numbers: int
    """Number M of shape parameters."""

    @classmethod
    def of(
        cls,
        squared: Array,
        vehicle_cost: Array,
        weight: Array,
        away: Array,
        by_pose: Array,
        by_shape: Array,
        by_shared: Array,
    ) -> Self:
        """Make the normal equations from derivatives and weights.

        Args:
            squared: (B, 33) squared distances in the image, in variances.
            vehicle_cost: (N,) costs of the vehicles.
            weight: (B, 33) weights of the keypoints, in pixels^-2.
            away: (B, 33, 2) vectors from the detected keypoints to the model's, pixels.
            by_pose: (B, 33, 2, 3) derivatives of the image with respect to the pose.
            by_shape: (B, 33, 2, M) derivatives with respect to the shape.
            by_shared: (B, 33, 2, U) derivatives with respect to the shared unknowns.
        """
        views = len(away)
        J = np.concatenate([by_pose, by_shape, by_shared], axis=-1).reshape(views, 2 * keypoints.K, -1)
        weighted = np.swapaxes(J * np.repeat(weight, 2, axis=1)[..., None], -1, -2)
        gradient = (weighted @ away.reshape(views, -1, 1))[..., 0]
        return cls(squared, vehicle_cost, weighted @ J, gradient, by_shape.shape[-1])

    def where(self, better: Mask, other: Self, vehicle: NDArray[np.intp]) -> Self:
        """Return a copy in which the equations of the vehicles in `better` are replaced by those of `other`.

        Args:
            better: (N,) whether a vehicle's equations are replaced.
            other: Normal equations of the same views.
            vehicle: (B,) the vehicle of each view.
        """
        rows = better[vehicle]
        return replace(
            self,
            squared=np.where(rows[:, None], other.squared, self.squared),
            vehicle_cost=np.where(better, other.vehicle_cost, self.vehicle_cost),
            normal=np.where(rows[:, None, None], other.normal, self.normal),
            gradient=np.where(rows[:, None], other.gradient, self.gradient),
        )

    def without_poses(self, vehicle: NDArray[np.intp], shape: Array, damping: Array) -> "Parts":
        """Eliminate the poses, then the shapes, from the equations (Schur complements).

        Args:
            vehicle: (B,) the vehicle of each view.
            shape: (N, M) the vehicles' shapes.
            damping: (N,) damping of poses and shapes.
        """
        count, m = len(shape), self.numbers
        pose, rest = slice(0, 3), slice(3, None)
        pose_normal = self.normal[:, pose, pose]
        pose_normal = (
            pose_normal
            + np.einsum("b,bii->bi", damping[vehicle], pose_normal)[:, :, None] * np.eye(3)
            + 1e-9 * np.eye(3)
        )
        inverse = _inverses(pose_normal)
        pose_back = inverse @ self.normal[:, pose, rest]
        pose_alone = (inverse @ self.gradient[:, pose, None])[..., 0]
        across = np.swapaxes(self.normal[:, pose, rest], -1, -2)
        normal = summed(self.normal[:, rest, rest] - across @ pose_back, vehicle, count)
        gradient = summed(self.gradient[:, rest] - (across @ pose_alone[..., None])[..., 0], vehicle, count)
        # Shape parameters have unit prior variance.
        held = normal[:, :m, :m] + np.eye(m)
        spread = np.linalg.slogdet(held)[1]
        held = held + damping[:, None, None] * np.eye(m)
        of_shape = np.linalg.inv(held)
        shape_back = of_shape @ normal[:, :m, m:]
        shape_alone = (of_shape @ (gradient[:, :m] + shape)[..., None])[..., 0]
        across = np.swapaxes(normal[:, :m, m:], -1, -2)
        return Parts(
            information=normal[:, m:, m:] - across @ shape_back,
            pull=gradient[:, m:] - (across @ shape_alone[..., None])[..., 0],
            spread=spread,
            shape_back=shape_back,
            shape_alone=shape_alone,
            pose_back=pose_back,
            pose_alone=pose_alone,
        )


@dataclass(frozen=True, eq=False)
class Parts:
    """Normal equations of the shared unknowns, one part per vehicle, and the back substitution to shapes and poses."""

    information: Array
    pull: Array
    spread: Array
    """(N,) log determinants of the shapes' normal matrices."""
    shape_back: Array
    shape_alone: Array
    pose_back: Array
    pose_alone: Array

    def back(self, shared: Array, vehicle: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return the steps of shapes (N, M) and poses (B, 3) for a step (U,) of the shared unknowns."""
        shared_step = shared[: self.shape_back.shape[-1]]
        shape = -(self.shape_alone + self.shape_back @ shared_step)
        rest = np.concatenate([shape[vehicle], np.broadcast_to(shared_step, (len(vehicle), len(shared_step)))], axis=1)
        pose = -(self.pose_alone + np.einsum("bpi,bi->bp", self.pose_back, rest))
        return shape, np.clip(pose, -_POSE_STRIDE, _POSE_STRIDE)


def _inverses(matrices: Array) -> Array:
    """Return (B, 3, 3) inverses; if one matrix is singular, the diagonals of all are slightly enlarged first.

    A matrix is singular if all keypoints of a vehicle constrain its pose, under a trial camera, in one direction only.
    """
    try:
        return np.asarray(np.linalg.inv(matrices))
    except np.linalg.LinAlgError:
        size = np.trace(matrices, axis1=-2, axis2=-1)
        return np.asarray(
            np.linalg.inv(matrices + (REGULARISING_SHARE * size)[:, None, None] * np.eye(matrices.shape[-1]))
        )


def summed(values: Array, vehicle: NDArray[np.intp], count: int) -> Array:
    """Sum over the views of each vehicle.

    Args:
        values: (B, ...) one value per view.
        vehicle: (B,) the vehicle of each view.
        count: Number N of vehicles.

    Returns:
        (N, ...) sums.
    """
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, vehicle, values)
    return out
