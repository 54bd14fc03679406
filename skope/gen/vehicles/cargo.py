"""What a lorry carries its cargo in, as `TruckBody` asks for it: the space behind the cab, and what is built there."""

from dataclasses import dataclass, field

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.types import Array


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
