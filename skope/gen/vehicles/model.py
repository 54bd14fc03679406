"""Interfaces and base class of all vehicle models, and the data that trilateration needs.

The keypoint separation follows the first stage of the SKoPe3D paper.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from skope import keypoints
from skope.gen.mesh import Mesh, merged, simplified
from skope.gen.vehicles.shape import Dimensions
from skope.records import check_array
from skope.types import Array


def wheel_plane(wheels: Array) -> tuple[Array, Array, Array]:
    """Fit a plane to the wheel centres.

    Args:
        wheels: (..., 4, 3) front right, front left, rear right, rear left.

    Returns:
        Centre (..., 3), in-plane axes (..., 2, 3) and upward normal (..., 3). The normal points along (front - rear) x
        (left - right).
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
    """Positions of a vehicle's keypoints relative to its wheel centres, the input of trilateration.

    The values are unrounded float64: near the wheel plane, 0.1 mm of rounding becomes millimetres.
    """

    distances: Array
    """(33, 4) distance from each keypoint to the wheel centres front right, front left, rear right, rear left,
    metres. For an articulated vehicle, the wheels are those of the part before the hinge."""
    side: Array
    """(33,) -1 below, 0 in, +1 above the plane of the wheel centres."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "distances", check_array("distances", self.distances, keypoints.K, 4))
        object.__setattr__(self, "side", check_array("side", self.side, keypoints.K))

    @classmethod
    def of(cls, points: ArrayLike, wheels: ArrayLike | None = None) -> Self:
        """Return the separation of keypoints (33, 3) of a vehicle at rest from its wheels (4, 3), in any frame.

        Default wheels: the keypoints of the wheels.
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


@dataclass(frozen=True)
class ModelParts:
    """Parts and simplified forms of a vehicle's mesh."""

    coarse_share: float = 0.25
    """Approximate share of the triangles in the simplified mesh of a distant body."""
    trailer_part: int = 5
    """Index of a trailer's body among the parts of an articulated vehicle; its own two wheels follow."""


MODEL_PARTS: Final = ModelParts()


ON_TRAILER: Final = np.array(["rear" in name or "taillight" in name for name in keypoints.NAMES])
"""(33,) mask of the keypoints on the trailer of an articulated vehicle: all keypoints of its rear, with its wheels."""


@dataclass(frozen=True, eq=False)
class Trailer:
    """Second part of an articulated vehicle, behind a hinge.

    The origin of its frame is on the road under the hinge, x forward, y left, z up.
    """

    surfaces: Callable[[], tuple[Mesh, Mesh | None]]
    """Function that builds `mesh` and `interior`, which takes time."""
    hinge: Array
    """(3,) position of the hinge in the vehicle's frame, metres."""
    size_lwh: tuple[float, float, float]
    """Length, width, height of its body, metres."""
    front: float
    """x of its front, metres."""
    axle: float
    """Distance from the hinge back to the middle of its axles, about which it turns, metres."""
    wheel_centers: Array
    """(2, 3) centres of the wheels of the rearmost axle, right and left, metres."""
    bend: float
    """Maximum angle between the trailer and the vehicle, radians."""

    @cached_property
    def _built(self) -> tuple[Mesh, Mesh | None]:
        return self.surfaces()

    @property
    def mesh(self) -> Mesh:
        """Body with all wheels except the outer wheels of the rearmost axle."""
        return self._built[0]

    @property
    def interior(self) -> Mesh | None:
        """Seats that are visible through its windows, or None."""
        return self._built[1]

    @property
    def corners(self) -> Array:
        """(2, 3) lowest and highest corner of the box of its dimensions, in its own frame."""
        length, width, height = self.size_lwh
        return np.array([[self.front - length, -width / 2, 0.0], [self.front, width / 2, height]])

    @cached_property
    def extent(self) -> Array:
        """(2, 3) opposite corners of a box around the trailer and its wheels."""
        points = np.concatenate([self.mesh.vertices, self.wheel_centers])
        return np.stack([points.min(axis=0) - 0.1, points.max(axis=0) + 0.1])

    @property
    def at_rest(self) -> Array:
        """(3, 4, 4) poses of the trailer and its two wheels in the frame of a vehicle straight in front of it."""
        T = np.tile(np.eye(4), (3, 1, 1))
        T[:, :2, 3] += self.hinge[:2]
        T[1:, :3, 3] += self.wheel_centers
        return T


class Body(Protocol):
    """Interface of bodies for renderers: a body with four moving parts and an optional trailer."""

    def __hash__(self) -> int: ...

    @property
    def mesh(self) -> Mesh:
        """Closed body without its moving parts, with opaque glass."""

    @property
    def interior(self) -> Mesh | None:
        """Seats, dashboard and driver, visible through the windows, inside `mesh`; None if there are none."""

    @property
    def parts(self) -> tuple[Mesh, ...]:
        """Body, then four moving parts, each about its own origin.

        For vehicles, the moving parts are the wheels front right, front left, rear right, rear left. A trailer and its
        wheels rear right, rear left follow.
        """

    @property
    def trailer(self) -> Trailer | None:
        """Trailer on the hinge of an articulated vehicle.

        Dimensions and extent are those of the vehicle in front of it.
        """

    @property
    def coarse(self) -> tuple[Mesh, ...]:
        """Parts with approximately the share `MODEL_PARTS.coarse_share` of their triangles, for distant views."""

    @property
    def size_lwh(self) -> tuple[float, float, float]:
        """Length, width without mirrors, height, metres."""

    @property
    def extent(self) -> Array:
        """(2, 3) opposite corners of a box around all parts in all their positions."""


class Vehicle(Body, Protocol):
    """Vehicle model: dimensions, surfaces and keypoints in the vehicle frame."""

    def __hash__(self) -> int: ...

    @property
    def model(self) -> str: ...

    @property
    def vehicle_type(self) -> str: ...

    @property
    def size_class(self) -> str:
        """Class of vehicles with the ranges for its dimensions; usually that of its type."""

    @property
    def shape(self) -> Dimensions: ...

    @property
    def mass(self) -> float:
        """Mass with a driver, kilograms."""

    @property
    def substituted(self) -> tuple[str, ...]:
        """Keypoints that are placed at a substitute because this body lacks their part."""

    @property
    def wheel(self) -> Mesh:
        """Left wheel about its centre; a right wheel is its mirror image."""

    @property
    def points(self) -> Array:
        """(33, 3) keypoints at rest, metres."""

    @property
    def sidecar(self) -> Sidecar: ...

    @property
    def wheel_face_offsets(self) -> Array:
        """(4, 3) vector from each wheel's centre to the middle of its outer face, in the wheel's own frame."""


def simplified_parts(parts: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """Return simplified parts of a body for distant views; equal parts are simplified once."""
    coarse = {part: simplified(part, MODEL_PARTS.coarse_share) for part in dict.fromkeys(parts)}
    return tuple(coarse[part] for part in parts)


class Derived:
    """Base of vehicle models: properties that follow from dimensions, surfaces and keypoints."""

    @property
    def size_class(self: Vehicle) -> str:
        return self.vehicle_type

    @property
    def size_lwh(self: Vehicle) -> tuple[float, float, float]:
        return self.shape.length, self.shape.width, self.shape.height

    @cached_property
    def extent(self: Vehicle) -> Array:
        points = np.concatenate([self.mesh.vertices, self.shape.wheel_centers()])
        return np.stack([points.min(axis=0) - 0.1, points.max(axis=0) + 0.1])

    @property
    def trailer(self) -> Trailer | None:
        return None

    @cached_property
    def parts(self: Vehicle) -> tuple[Mesh, ...]:
        right, trailer = self.wheel.mirrored(), self.trailer
        hitched = (trailer.mesh, right, self.wheel) if trailer else ()
        return self.mesh, right, self.wheel, right, self.wheel, *hitched

    @cached_property
    def coarse(self: Vehicle) -> tuple[Mesh, ...]:
        return simplified_parts(self.parts)

    @cached_property
    def sidecar(self: Vehicle) -> Sidecar:
        return Sidecar.of(self.points, self.shape.wheel_centers() if self.trailer else None)

    @property
    def wheel_face_offsets(self: Vehicle) -> Array:
        half = self.shape.wheel_width / 2
        return np.array([[0.0, -half, 0.0], [0.0, half, 0.0]] * 2)


def straight_mesh(vehicle: Vehicle) -> Mesh:
    """Return a vehicle's body, with its trailer straight behind it."""
    trailer = vehicle.trailer
    return merged([vehicle.mesh, trailer.mesh.moved([*trailer.hinge[:2], 0.0])]) if trailer else vehicle.mesh


def straight_lwh(vehicle: Body) -> tuple[float, float, float]:
    """Return length, width without mirrors and height of a vehicle with its trailer straight behind it, metres."""
    length, width, height = vehicle.size_lwh
    if vehicle.trailer is None:
        return length, width, height
    rear = float(vehicle.trailer.hinge[0] + vehicle.trailer.corners[0, 0])
    return length / 2 - rear, max(width, vehicle.trailer.size_lwh[1]), max(height, vehicle.trailer.size_lwh[2])
