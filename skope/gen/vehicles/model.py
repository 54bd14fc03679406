"""Interfaces and base of all vehicle models, wherever their surfaces come from."""

from collections.abc import Sequence
from functools import cached_property
from typing import Final, Protocol

import numpy as np

from skope.gen.mesh import Mesh, simplified
from skope.gen.vehicles.keypoint_separation import Sidecar
from skope.gen.vehicles.shape import Dimensions
from skope.types import Array

COARSE: Final = 0.25
"""Share of its triangles, about, that a body far away is drawn with."""


class Body(Protocol):
    """The interface of what renderers draw: a body with four parts that move."""

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
        rear left."""

    @property
    def coarse(self) -> tuple[Mesh, ...]:
        """The parts with about the share `COARSE` of their triangles, for pictures from afar."""

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
    coarse = {part: simplified(part, COARSE) for part in dict.fromkeys(parts)}
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

    @cached_property
    def parts(self: Vehicle) -> tuple[Mesh, ...]:
        right = self.wheel.mirrored()
        return self.mesh, right, self.wheel, right, self.wheel

    @cached_property
    def coarse(self: Vehicle) -> tuple[Mesh, ...]:
        return simplified_parts(self.parts)

    @cached_property
    def sidecar(self: Vehicle) -> Sidecar:
        return Sidecar.of(self.points)

    @property
    def wheel_face_offsets(self: Vehicle) -> Array:
        half = self.shape.wheel_width / 2
        return np.array([[0.0, -half, 0.0], [0.0, half, 0.0]] * 2)
