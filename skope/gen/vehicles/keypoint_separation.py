"""Keypoint separation: what trilateration needs to know of a vehicle, after the SKoPe3D paper's first stage."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from skope import keypoints
from skope.field_checks import array
from skope.types import Array


def wheel_plane(wheels: Array) -> tuple[Array, Array, Array]:
    """Best-fitting plane of the wheel centres: centre (..., 3), in-plane axes (..., 2, 3), upward normal (..., 3).

    `wheels` is (..., 4, 3), front right, front left, rear right, rear left; the normal points along
    (front - rear) x (left - right).
    """
    center = wheels.mean(axis=-2)
    axes = np.linalg.svd(wheels - center[..., None, :])[2]
    forward = wheels[..., :2, :].sum(-2) - wheels[..., 2:, :].sum(-2)
    leftward = wheels[..., 1::2, :].sum(-2) - wheels[..., ::2, :].sum(-2)
    up = np.cross(forward, leftward)
    normal = axes[..., 2, :]
    normal = normal * np.sign((normal * up).sum(-1, keepdims=True))
    return center, axes[..., :2, :], normal


@dataclass(frozen=True, eq=False)
class Sidecar:
    """A vehicle's keypoints as seen from its wheels.

    Float64 and unrounded: near the wheel plane 0.1 mm of rounding becomes millimetres.
    """

    distances: Array
    """(33, 4) metres from each keypoint to the wheel centres front right, front left, rear right, rear left; of an
    articulated vehicle to those of the part before the hinge."""
    side: Array
    """(33,) -1 below, 0 in, +1 above the plane of the wheel centres."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "distances", array("distances", self.distances, keypoints.K, 4))
        object.__setattr__(self, "side", array("side", self.side, keypoints.K))

    @classmethod
    def of(cls, points: ArrayLike, wheels: ArrayLike | None = None) -> Self:
        """Separate keypoints (33, 3) of a vehicle at rest from its wheels (4, 3), in any frame.

        Default wheels: the keypoints that are wheels.
        """
        p = np.asarray(points, dtype=np.float64)
        wheels = p[list(keypoints.WHEELS)] if wheels is None else np.asarray(wheels, dtype=np.float64)
        center, _, normal = wheel_plane(wheels)
        height = (p - center) @ normal
        distances = np.linalg.norm(p[:, None] - wheels, axis=-1)
        return cls(distances, np.where(np.abs(height) < 1e-9, 0.0, np.sign(height)))

    def to_dict(self) -> dict[str, Any]:
        return {"distances": self.distances.tolist(), "side": self.side.astype(int).tolist()}

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Self:
        return cls(value["distances"], value["side"])
