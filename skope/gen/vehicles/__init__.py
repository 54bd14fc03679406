"""The fleet: vehicle models by name, each a point in the parametric body's shape space."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.errors import UserError, one_of
from skope.gen.mesh import Mesh
from skope.gen.vehicles.body import Body, Shape, wheel_mesh
from skope.gen.vehicles.sidecar import Sidecar

Array = NDArray[np.float64]

PAINTS: Final[dict[str, tuple[float, tuple[int, int, int]]]] = {
    "white": (0.29, (226, 227, 224)),
    "black": (0.20, (26, 26, 29)),
    "grey": (0.17, (95, 99, 104)),
    "silver": (0.11, (168, 172, 176)),
    "blue": (0.10, (31, 62, 122)),
    "red": (0.07, (140, 22, 24)),
    "brown": (0.03, (92, 66, 48)),
    "green": (0.03, (38, 74, 52)),
}
"""Share and sRGB of body colours; shares follow the order of the paint makers' yearly popularity reports."""


@dataclass(frozen=True)
class Vehicle:
    """A vehicle model: shape, surfaces and keypoints in the vehicle frame."""

    model: str
    vehicle_type: str
    shape: Shape
    mass: float
    """Kilograms, laden with a driver."""
    substituted: tuple[str, ...] = ()
    """Keypoints that stand for a part that this body lacks."""

    @cached_property
    def _body(self) -> Body:
        return Body(self.shape)

    @property
    def mesh(self) -> Mesh:
        """The body without wheels."""
        return self._body.mesh

    @cached_property
    def wheel(self) -> Mesh:
        """A left wheel about its centre; a right one is its mirror image."""
        return wheel_mesh(self.shape.wheel_radius, self.shape.wheel_width)

    @property
    def points(self) -> Array:
        """(33, 3) keypoints at rest, metres."""
        return self._body.points

    @property
    def size_lwh(self) -> tuple[float, float, float]:
        """Length, width without mirrors, height, metres."""
        return self.shape.length, self.shape.width, self.shape.height

    @cached_property
    def sidecar(self) -> Sidecar:
        return Sidecar.of(self.points)

    @property
    def wheel_face_offsets(self) -> Array:
        """(4, 3) from each wheel's centre to the middle of its outer face, in the wheel's own frame."""
        half = self.shape.wheel_width / 2
        return np.array([[0.0, -half, 0.0], [0.0, half, 0.0]] * 2)


@dataclass(frozen=True)
class FleetEntry:
    vehicle: Vehicle
    share: float
    """How often the model drives by, relative to the others."""


@cache
def fleet() -> Mapping[str, FleetEntry]:
    """All models of the package, by name."""
    text = resources.files("skope.gen.vehicles").joinpath("fleet.toml").read_text(encoding="utf-8")
    return {
        name: FleetEntry(
            Vehicle(name, row["vehicle_type"], Shape(**row["shape"]), row["mass"], tuple(row["substituted"])),
            row["share"],
        )
        for name, row in tomllib.loads(text).items()
    }


@cache
def _build(model: str, shape: tuple[tuple[str, float], ...]) -> Vehicle:
    base = fleet()[model].vehicle
    try:
        return Vehicle(model, base.vehicle_type, Shape(**dict(shape)), base.mass, base.substituted)
    except TypeError as error:
        raise UserError(f"shape of {model}: {error}") from None


def build(model: str, shape: Mapping[str, float]) -> Vehicle:
    """The vehicle of a model with the given shape parameters (see `Shape`); equal ones are built once."""
    one_of("model", model, tuple(fleet()))
    return _build(model, tuple(sorted(shape.items())))


assert all(set(entry.vehicle.substituted) <= set(keypoints.NAMES) for entry in fleet().values())
