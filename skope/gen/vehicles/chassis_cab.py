"""Lorries whose engine lies before the cab, and vans without their rear: a car's front on a frame with axles."""

from dataclasses import replace
from functools import cached_property
from typing import Final

from skope.gen.mesh import Mesh
from skope.gen.vehicles.car import CarBody
from skope.gen.vehicles.truck import TruckBody

_REAR_POINTS: Final = frozenset(
    ("taillight_outer", "taillight_inner", "bumper_rear", "trunk_rear", "roof_rear", "rear_window_base")
)
"""Keypoints that the cargo body and the frame have, and not the cab."""


class ChassisCabBody(TruckBody):
    """A truck with the front of a car or van, as long as `shape.cab_length`, narrower than the cargo body behind it."""

    @cached_property
    def interior(self) -> Mesh:
        return self._car.interior

    def _build_cab(self) -> None:
        s = self.shape
        own = replace(
            s, width=s.width * self.style.cab_width, height=self.cab_height, deck_length=s.length - s.cab_length
        )
        self._car = CarBody(own, replace(self.style, family="car", bed=True, palette="freight"))
        self._parts.append(self._car.front_half())
        self.points |= {name: place for name, place in self._car.points.items() if name not in _REAR_POINTS}
