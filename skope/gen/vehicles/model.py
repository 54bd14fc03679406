"""Interfaces and base of all vehicle models, wherever their surfaces come from; and what trilateration needs to know of
a vehicle (keypoint separation), after the SKoPe3D paper's first stage."""

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
        object.__setattr__(self, "distances", check_array("distances", self.distances, keypoints.K, 4))
        object.__setattr__(self, "side", check_array("side", self.side, keypoints.K))

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


@dataclass(frozen=True)
class ModelParts:
    """Parts and coarse forms of a vehicle's mesh."""

    coarse_share: float = 0.25
    """Share of its triangles, about, that a body far away is drawn with."""
    trailer_part: int = 5
    """Index of a trailer's body among the parts of an articulated vehicle; its own two wheels follow."""


MODEL_PARTS: Final = ModelParts()


ON_TRAILER: Final = np.array(["rear" in name or "taillight" in name for name in keypoints.NAMES])
"""(33,) which keypoints of an articulated vehicle ride on its trailer: all of its rear, wheels too."""


@dataclass(frozen=True, eq=False)
class Trailer:
    """The second part of an articulated vehicle, behind a hinge.

    Its frame has its origin on the road under the hinge, x forward, y left, z up.
    """

    surfaces: Callable[[], tuple[Mesh, Mesh | None]]
    """Builds `mesh` and `interior`, which takes time."""
    hinge: Array
    """(3,) the hinge in the vehicle's frame, metres."""
    size_lwh: tuple[float, float, float]
    """Length, width, height of its body, metres."""
    front: float
    """x of its front."""
    axle: float
    """From the hinge back to the middle of its axles, about which it turns, metres."""
    wheel_centers: Array
    """(2, 3) wheels of the rearmost axle, right and left, metres."""
    bend: float
    """Largest angle between it and the vehicle, radians."""

    @cached_property
    def _built(self) -> tuple[Mesh, Mesh | None]:
        return self.surfaces()

    @property
    def mesh(self) -> Mesh:
        """Its body, with all wheels but the outer ones of the rearmost axle."""
        return self._built[0]

    @property
    def interior(self) -> Mesh | None:
        """Seats that are seen through its windows."""
        return self._built[1]

    @property
    def corners(self) -> Array:
        """(2, 3) lowest and highest corner of the box of its dimensions, in its own frame."""
        length, width, height = self.size_lwh
        return np.array([[self.front - length, -width / 2, 0.0], [self.front, width / 2, height]])

    @cached_property
    def extent(self) -> Array:
        """(2, 3) opposite corners of a box around it with its wheels."""
        points = np.concatenate([self.mesh.vertices, self.wheel_centers])
        return np.stack([points.min(axis=0) - 0.1, points.max(axis=0) + 0.1])

    @property
    def at_rest(self) -> Array:
        """(3, 4, 4) poses of it and its two wheels in the frame of a vehicle that stands straight before it."""
        T = np.tile(np.eye(4), (3, 1, 1))
        T[:, :2, 3] += self.hinge[:2]
        T[1:, :3, 3] += self.wheel_centers
        return T


class Body(Protocol):
    """The interface of what renderers draw: a body with four parts that move, and perhaps a trailer."""

    def __hash__(self) -> int: ...

    @property
    def mesh(self) -> Mesh:
        """The body without its moving parts, closed, with its glass opaque."""

    @property
    def interior(self) -> Mesh | None:
        """Seats, dashboard and driver, which are seen through the windows, inside `mesh`."""

    @property
    def parts(self) -> tuple[Mesh, ...]:
        """Body, then four parts, each about its own origin: of vehicles the wheels front right, front left, rear right,
        rear left. Then a trailer and its wheels rear right, rear left."""

    @property
    def trailer(self) -> Trailer | None:
        """The trailer on an articulated vehicle's hinge; dimensions and extent are those of the vehicle before it."""

    @property
    def coarse(self) -> tuple[Mesh, ...]:
        """The parts with about the share `MODEL_PARTS.coarse_share` of their triangles, for pictures from afar."""

    @property
    def size_lwh(self) -> tuple[float, float, float]:
        """Length, width without mirrors, height, metres."""

    @property
    def extent(self) -> Array:
        """(2, 3) opposite corners of a box around all parts, however they move."""


class Vehicle(Body, Protocol):
    """A vehicle model: dimensions, surfaces and keypoints in the vehicle frame."""

    def __hash__(self) -> int: ...

    @property
    def model(self) -> str: ...

    @property
    def vehicle_type(self) -> str: ...

    @property
    def size_class(self) -> str:
        """The class of vehicles whose dimensions it should have; most have their type's."""

    @property
    def shape(self) -> Dimensions: ...

    @property
    def mass(self) -> float:
        """Kilograms, laden with a driver."""

    @property
    def substituted(self) -> tuple[str, ...]:
        """Keypoints that stand for a part that this body lacks."""

    @property
    def wheel(self) -> Mesh:
        """A left wheel about its centre; a right one is its mirror image."""

    @property
    def points(self) -> Array:
        """(33, 3) keypoints at rest, metres."""

    @property
    def sidecar(self) -> Sidecar: ...

    @property
    def wheel_face_offsets(self) -> Array:
        """(4, 3) from each wheel's centre to the middle of its outer face, in the wheel's own frame."""


def simplified_parts(parts: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """Parts of a body for pictures from afar; those that are the same are simplified once."""
    coarse = {part: simplified(part, MODEL_PARTS.coarse_share) for part in dict.fromkeys(parts)}
    return tuple(coarse[part] for part in parts)


class Derived:
    """Base of vehicle models: the properties that follow from dimensions, surfaces and keypoints."""

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
    """A vehicle's body, with its trailer straight behind it."""
    trailer = vehicle.trailer
    return merged([vehicle.mesh, trailer.mesh.moved([*trailer.hinge[:2], 0.0])]) if trailer else vehicle.mesh


def straight_lwh(vehicle: Body) -> tuple[float, float, float]:
    """Length, width without mirrors and height of a vehicle with its trailer straight behind it, metres."""
    length, width, height = vehicle.size_lwh
    if vehicle.trailer is None:
        return length, width, height
    rear = float(vehicle.trailer.hinge[0] + vehicle.trailer.corners[0, 0])
    return length / 2 - rear, max(width, vehicle.trailer.size_lwh[1]), max(height, vehicle.trailer.size_lwh[2])
