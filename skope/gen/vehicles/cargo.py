"""Cargo bodies of lorries, as `TruckBody` asks for them: the space behind the cab, and what is built there."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.solids import mudguard
from skope.types import Array

BEACON: Final = "#e8861a"
"""Colour of beacons, and of what moves."""


@dataclass(frozen=True)
class CargoSpace:
    """The space behind a cab, from `end` to `ahead` (x), over the floor at `shape.box_height`."""

    shape: Shape
    style: VehicleStyle
    ahead: float
    end: float
    cab_height: float

    @property
    def half(self) -> float:
        return self.shape.width / 2

    @property
    def floor(self) -> float:
        return self.shape.box_height

    @property
    def rear_axle(self) -> float:
        return self.shape.rear_axle_x

    def rng(self) -> np.random.Generator:
        """Draws liveries and loads; it follows from the length, so that few are alike."""
        return np.random.default_rng(int(self.shape.length * 1e4))


@dataclass
class Cargo:
    """The left half of a cargo body, with its keypoints `roof_rear`, `rear_window_base` and `trunk_rear`."""

    parts: list[Mesh] = field(default_factory=list)
    points: dict[str, Array] = field(default_factory=dict)

    def mark(self, roof_rear: Array, rear_window_base: Array, trunk_rear: Array) -> None:
        """Note the keypoints (3,)."""
        self.points = {"roof_rear": roof_rear, "rear_window_base": rear_window_base, "trunk_rear": trunk_rear}


def mudguards(space: CargoSpace) -> list[Mesh]:
    """Curved mudguards over the rear axles of a body that leaves them bare."""
    s = space.shape
    y = (s.track / 2 - 1.6 * s.wheel_width, s.track / 2 + 0.6 * s.wheel_width)
    spread = 78.0 if not space.style.axles else 58.0
    axles = [space.rear_axle, *(space.rear_axle + ahead for ahead in space.style.axles)]
    return [mudguard((x, s.wheel_radius), s.wheel_radius + 0.09, y, "trim", reach_deg=spread) for x in axles]
