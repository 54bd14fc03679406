"""The paints that vehicles have: private cars' colours and the liveries of taxis, vans, lorries and buses."""

from typing import Final, NamedTuple

import numpy as np

from skope.gen.vehicles.fleet import ParametricVehicle, fleet, parametric
from skope.gen.vehicles.model import Vehicle
from skope.schema import COLORS


class Paint(NamedTuple):
    """A vehicle's colours."""

    share: float
    """Frequency of the paint, relative to the others of its palette."""
    rgb: tuple[int, int, int]
    """sRGB of the body."""
    livery: tuple[int, int, int]
    """sRGB of parts in a second colour: a stripe, a box, the lower half."""
    color: str
    """Name of the colour in annotations: one of `skope.schema.COLORS`."""
    palette: str


def _private(share: float, name: str, rgb: tuple[int, int, int]) -> tuple[str, Paint]:
    return name, Paint(share, rgb, rgb, name, "private")


def _livery(
    name: str, share: float, color: str, rgb: tuple[int, int, int], livery: tuple[int, int, int]
) -> tuple[str, Paint]:
    return name, Paint(share, rgb, livery, color, name.split("_")[0])


_WHITE: Final = (226, 227, 224)
_CREAM: Final = (222, 208, 168)

PAINTS: Final[dict[str, Paint]] = dict(
    (
        _private(0.38, "white", _WHITE),
        _private(0.19, "black", (26, 26, 29)),
        _private(0.15, "grey", (95, 99, 104)),
        _private(0.09, "silver", (168, 172, 176)),
        _private(0.07, "blue", (31, 62, 122)),
        _private(0.05, "red", (140, 22, 24)),
        _private(0.03, "brown", (92, 66, 48)),
        _private(0.02, "yellow", (205, 160, 42)),
        _private(0.02, "green", (38, 74, 52)),
        _livery("taxi_yellow", 4, "yellow", (222, 168, 24), (30, 30, 32)),
        _livery("taxi_cream", 3, "other", _CREAM, _CREAM),
        _livery("taxi_black", 2, "black", (26, 26, 29), (66, 130, 62)),
        _livery("taxi_white", 2, "white", _WHITE, (196, 92, 30)),
        _livery("van_white", 9, "white", _WHITE, _WHITE),
        _livery("van_white_blue", 2, "white", _WHITE, (34, 80, 150)),
        _livery("van_white_red", 2, "white", _WHITE, (170, 30, 30)),
        _livery("van_white_green", 1, "white", _WHITE, (52, 120, 66)),
        _livery("van_silver", 3, "silver", (168, 172, 176), (168, 172, 176)),
        _livery("van_grey", 2, "grey", (86, 90, 96), (86, 90, 96)),
        _livery("van_yellow", 2, "yellow", (224, 172, 20), (180, 24, 24)),
        _livery("van_brown", 1, "brown", (74, 50, 34), (196, 150, 60)),
        _livery("van_blue", 2, "blue", (28, 58, 116), _WHITE),
        _livery("freight_white", 6, "white", _WHITE, (214, 215, 212)),
        _livery("freight_white_blue", 2, "white", _WHITE, (38, 84, 148)),
        _livery("freight_white_green", 2, "white", _WHITE, (46, 102, 70)),
        _livery("freight_red", 2, "red", (150, 24, 26), (214, 215, 212)),
        _livery("freight_red_red", 1, "red", (150, 24, 26), (146, 30, 30)),
        _livery("freight_blue", 3, "blue", (30, 66, 128), (206, 208, 208)),
        _livery("freight_green", 1, "green", (34, 80, 54), _CREAM),
        _livery("freight_yellow", 2, "yellow", (214, 164, 28), (72, 76, 82)),
        _livery("freight_orange", 1, "orange", (206, 96, 24), (214, 215, 212)),
        _livery("bus_red", 3, "red", (160, 24, 26), _CREAM),
        _livery("bus_blue", 2, "blue", (32, 74, 140), _WHITE),
        _livery("bus_green", 2, "green", (42, 104, 66), _CREAM),
        _livery("bus_yellow", 2, "yellow", (220, 168, 26), (70, 74, 80)),
        _livery("bus_white", 2, "white", _WHITE, (190, 36, 36)),
        _livery("bus_orange", 1, "orange", (206, 98, 26), _WHITE),
    )
)
"""Paints by the name that recordings keep.

Shares of private cars' colours are Axalta's Global Automotive Color Popularity Report of 2020 in whole per cent; it has
brown with beige and yellow with gold, and its last two per cent, other colours, are green here. Liveries have no such
source: their shares say only that plain white leads.
"""


def palette(vehicle: Vehicle) -> list[str]:
    """Names of the paints that a vehicle may have."""
    kind = vehicle.style.palette if isinstance(vehicle, ParametricVehicle) else "private"
    return [name for name, paint in PAINTS.items() if paint.palette == kind]


def draw_paint(vehicle: Vehicle, rng: np.random.Generator) -> str:
    """The name of a paint for a vehicle, by the shares of its palette."""
    names = palette(vehicle)
    shares = np.array([PAINTS[name].share for name in names])
    return names[rng.choice(len(names), p=shares / shares.sum())]


assert {paint.color for paint in PAINTS.values()} <= set(COLORS)
assert {parametric(model).style.palette for model in fleet()} == {paint.palette for paint in PAINTS.values()}
