"""Paints of vehicles: the colours of private cars and the liveries of taxis, vans, lorries and buses."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Final, NamedTuple

import cv2
import numpy as np

from skope.gen.vehicles.fleet import ParametricVehicle, fleet, parametric
from skope.gen.vehicles.model import Vehicle
from skope.gen.vehicles.user_models import AddedVehicle
from skope.schema import VEHICLE_COLORS
from skope.types import Array


class Paint(NamedTuple):
    """Colours of a vehicle."""

    share: float
    """Frequency of the paint, relative to the others of its palette."""
    rgb: tuple[int, int, int]
    """sRGB of the body."""
    livery: tuple[int, int, int]
    """sRGB of parts in a second colour, such as a stripe, a box or the lower half."""
    color: str
    """Name of the colour in annotations: one of `skope.schema.VEHICLE_COLORS`."""
    palette: str


def _private(share: float, name: str, rgb: tuple[int, int, int]) -> tuple[str, Paint]:
    return name, Paint(share, rgb, rgb, name, "private")


def _shades(share: float, color: str, *rgbs: tuple[int, int, int]) -> Iterator[tuple[str, Paint]]:
    for k, rgb in enumerate(rgbs, start=1):
        yield f"{color}_{k}", Paint(share / len(rgbs), rgb, rgb, color, "shades")


def _livery(
    name: str, share: float, color: str, rgb: tuple[int, int, int], livery: tuple[int, int, int]
) -> tuple[str, Paint]:
    return name, Paint(share, rgb, livery, color, name.split("_")[0])


@dataclass(frozen=True)
class PaintColors:
    """Colours of paints."""

    white: tuple[int, int, int] = (226, 227, 224)
    """White (sRGB)."""
    cream: tuple[int, int, int] = (222, 208, 168)
    """Cream (sRGB)."""
    named_distance: float = 30.0
    """Distance in `_lab` from all named colours above which a colour is "other"."""


PAINT_COLORS: Final = PaintColors()


ALL_PAINTS: Final[dict[str, Paint]] = dict(
    (
        _private(0.38, "white", PAINT_COLORS.white),
        _private(0.19, "black", (26, 26, 29)),
        _private(0.15, "grey", (95, 99, 104)),
        _private(0.09, "silver", (168, 172, 176)),
        _private(0.07, "blue", (31, 62, 122)),
        _private(0.05, "red", (140, 22, 24)),
        _private(0.03, "brown", (92, 66, 48)),
        _private(0.02, "yellow", (205, 160, 42)),
        _private(0.02, "green", (38, 74, 52)),
        *_shades(16.5, "grey", (95, 99, 104), (58, 60, 63), (74, 77, 80), (120, 122, 123), (88, 84, 80)),
        *_shades(17.0, "silver", (168, 172, 176), (190, 192, 193), (148, 152, 157), (176, 172, 164)),
        *_shades(23.0, "black", (26, 26, 29), (15, 15, 17), (32, 35, 42), (40, 36, 34)),
        *_shades(15.5, "white", PAINT_COLORS.white, (238, 238, 237), (212, 209, 200)),
        *_shades(13.5, "blue", (31, 62, 122), (22, 36, 68), (56, 92, 146), (96, 126, 154)),
        *_shades(8.0, "red", (140, 22, 24), (96, 18, 24), (172, 34, 28)),
        *_shades(3.0, "green", (38, 74, 52), (64, 84, 68), (98, 116, 84)),
        *_shades(1.5, "brown", (92, 66, 48), (128, 108, 84)),
        *_shades(1.0, "yellow", (205, 160, 42)),
        *_shades(1.0, "other", (198, 184, 156), (168, 152, 126)),
        _livery("taxi_yellow", 4, "yellow", (222, 168, 24), (30, 30, 32)),
        _livery("taxi_cream", 3, "other", PAINT_COLORS.cream, PAINT_COLORS.cream),
        _livery("taxi_black", 2, "black", (26, 26, 29), (66, 130, 62)),
        _livery("taxi_white", 2, "white", PAINT_COLORS.white, (196, 92, 30)),
        _livery("van_white", 9, "white", PAINT_COLORS.white, PAINT_COLORS.white),
        _livery("van_white_blue", 2, "white", PAINT_COLORS.white, (34, 80, 150)),
        _livery("van_white_red", 2, "white", PAINT_COLORS.white, (170, 30, 30)),
        _livery("van_white_green", 1, "white", PAINT_COLORS.white, (52, 120, 66)),
        _livery("van_silver", 3, "silver", (168, 172, 176), (168, 172, 176)),
        _livery("van_grey", 2, "grey", (86, 90, 96), (86, 90, 96)),
        _livery("van_yellow", 2, "yellow", (224, 172, 20), (180, 24, 24)),
        _livery("van_brown", 1, "brown", (74, 50, 34), (196, 150, 60)),
        _livery("van_blue", 2, "blue", (28, 58, 116), PAINT_COLORS.white),
        _livery("freight_white", 6, "white", PAINT_COLORS.white, (214, 215, 212)),
        _livery("freight_white_blue", 2, "white", PAINT_COLORS.white, (38, 84, 148)),
        _livery("freight_white_green", 2, "white", PAINT_COLORS.white, (46, 102, 70)),
        _livery("freight_red", 2, "red", (150, 24, 26), (214, 215, 212)),
        _livery("freight_red_red", 1, "red", (150, 24, 26), (146, 30, 30)),
        _livery("freight_blue", 3, "blue", (30, 66, 128), (206, 208, 208)),
        _livery("freight_green", 1, "green", (34, 80, 54), PAINT_COLORS.cream),
        _livery("freight_yellow", 2, "yellow", (214, 164, 28), (72, 76, 82)),
        _livery("freight_orange", 1, "orange", (206, 96, 24), (214, 215, 212)),
        _livery("haulage_white", 6, "white", PAINT_COLORS.white, (232, 233, 231)),
        _livery("haulage_white_grey", 3, "white", PAINT_COLORS.white, (122, 126, 130)),
        _livery("haulage_white_blue", 3, "white", PAINT_COLORS.white, (32, 78, 146)),
        _livery("haulage_white_red", 2, "white", PAINT_COLORS.white, (158, 26, 30)),
        _livery("haulage_white_green", 2, "white", PAINT_COLORS.white, (34, 104, 66)),
        _livery("haulage_white_yellow", 1, "white", PAINT_COLORS.white, (222, 178, 36)),
        _livery("haulage_red", 3, "red", (158, 22, 24), (226, 227, 224)),
        _livery("haulage_red_black", 1, "red", (158, 22, 24), (34, 35, 38)),
        _livery("haulage_blue", 3, "blue", (28, 62, 128), (222, 223, 222)),
        _livery("haulage_blue_blue", 1.5, "blue", (24, 52, 104), (28, 60, 118)),
        _livery("haulage_lightblue", 1, "blue", (70, 124, 176), (226, 227, 224)),
        _livery("haulage_green", 1.5, "green", (28, 84, 52), (214, 216, 208)),
        _livery("haulage_grey", 2, "grey", (88, 92, 97), (200, 202, 203)),
        _livery("haulage_black", 1.5, "black", (28, 28, 31), (58, 60, 64)),
        _livery("haulage_silver", 2, "silver", (168, 172, 176), (216, 217, 218)),
        _livery("haulage_yellow", 1.5, "yellow", (218, 166, 26), (220, 221, 218)),
        _livery("haulage_orange", 1.5, "orange", (210, 98, 24), (226, 227, 224)),
        _livery("haulage_purple", 0.6, "purple", (86, 44, 108), (226, 227, 224)),
        _livery("haulage_brown", 0.6, "brown", (84, 56, 38), (196, 176, 140)),
        _livery("tour_white", 4, "white", PAINT_COLORS.white, (32, 74, 140)),
        _livery("tour_white_red", 2, "white", PAINT_COLORS.white, (170, 30, 34)),
        _livery("tour_white_green", 1, "white", PAINT_COLORS.white, (44, 120, 84)),
        _livery("tour_silver", 3, "silver", (176, 179, 182), (60, 64, 70)),
        _livery("tour_grey", 2, "grey", (72, 76, 82), (168, 172, 176)),
        _livery("tour_black", 2, "black", (24, 24, 27), (150, 32, 36)),
        _livery("tour_blue", 2.5, "blue", (26, 58, 122), (206, 210, 214)),
        _livery("tour_red", 1.5, "red", (150, 20, 26), (236, 236, 232)),
        _livery("tour_green", 1.5, "green", (46, 118, 60), (236, 236, 232)),
        _livery("tour_gold", 0.8, "gold", (172, 144, 88), (60, 48, 34)),
        _livery("tour_purple", 0.8, "purple", (88, 42, 108), (214, 206, 220)),
        _livery("tour_orange", 1, "orange", (214, 104, 30), (236, 236, 232)),
        _livery("living_white", 9, "white", PAINT_COLORS.white, (120, 126, 132)),
        _livery("living_cream", 2, "other", PAINT_COLORS.cream, (126, 92, 60)),
        _livery("living_silver", 1.5, "silver", (172, 175, 178), (40, 44, 52)),
        _livery("emergency_white", 5, "white", PAINT_COLORS.white, (200, 40, 36)),
        _livery("emergency_yellow", 2, "yellow", (214, 200, 28), (40, 130, 60)),
        _livery("emergency_red", 2, "red", (176, 26, 26), PAINT_COLORS.white),
        _livery("fire_red", 4, "red", (172, 24, 24), (226, 227, 224)),
        _livery("fire_yellow", 1, "yellow", (210, 196, 30), (226, 227, 224)),
        _livery("school_yellow", 1, "yellow", (226, 160, 24), (226, 160, 24)),
        _livery("refuse_orange", 4, "orange", (214, 104, 22), (214, 104, 22)),
        _livery("refuse_white", 3, "white", PAINT_COLORS.white, (58, 128, 70)),
        _livery("refuse_green", 2, "green", (40, 110, 62), (222, 222, 218)),
        _livery("refuse_blue", 1, "blue", (32, 74, 140), (206, 208, 208)),
        _livery("refuse_yellow", 1, "yellow", (220, 168, 26), (220, 168, 26)),
        _livery("bus_red", 3, "red", (160, 24, 26), PAINT_COLORS.cream),
        _livery("bus_blue", 2, "blue", (32, 74, 140), PAINT_COLORS.white),
        _livery("bus_green", 2, "green", (42, 104, 66), PAINT_COLORS.cream),
        _livery("bus_yellow", 2, "yellow", (220, 168, 26), (70, 74, 80)),
        _livery("bus_white", 2, "white", PAINT_COLORS.white, (190, 36, 36)),
        _livery("bus_orange", 1, "orange", (206, 98, 26), PAINT_COLORS.white),
    )
)
"""Paints by the name that recordings store.

Shares of private cars' colours are from Axalta's Global Automotive Color Popularity Report of 2020, in whole per cent.
The report combines brown with beige and yellow with gold. Its last two per cent, other colours, are green here. Shares
of the palette "shades" are between two sources. The first is the vehicles licensed in Britain in 2017 (DVLA: silver 21
per cent, black 20, blue 18, grey 13, white 11). The second is Germany's new registrations of 2024 (KBA: grey and silver
33, black 26, white 20, blue 9, red 5, green 3). Liveries have no source; their shares only make plain white the most
frequent.
"""


UNPAINTED_COLORS: Final = {"orange": (206, 94, 24), "gold": (170, 140, 84), "purple": (84, 44, 104)}
"""sRGB of the named colours without a paint."""


def color_name(vehicle: Vehicle, paint: str) -> str:
    """Return the colour of a vehicle in annotations: that of its paint, or of an unpainted added model."""
    return _surface_color(vehicle) if isinstance(vehicle, AddedVehicle) else ALL_PAINTS[paint].color


@cache
def _surface_color(vehicle: AddedVehicle) -> str:
    """Return the named colour nearest to the colour of most of a model's surface."""
    mesh = vehicle.mesh
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    areas = np.bincount(
        mesh.material, np.linalg.norm(np.cross(b - a, c - a), axis=1), minlength=len(mesh.materials)
    ) * [name.startswith("#") for name in mesh.materials]
    code = mesh.materials[int(areas.argmax())]
    if not code.startswith("#"):
        return "other"
    named = {paint.color: paint.rgb for paint in reversed(ALL_PAINTS.values())} | UNPAINTED_COLORS
    color, *named_colors = _lab([tuple(bytes.fromhex(code[1:])), *named.values()])
    away = np.linalg.norm(named_colors - color, axis=1)
    return list(named)[int(away.argmin())] if away.min() < PAINT_COLORS.named_distance else "other"


def _lab(rgbs: list[tuple[int, ...]]) -> Array:
    """Return CIELAB (N, 3) of sRGB values, with half the lightness, so that a dark and a light green share a name."""
    pixels = np.array([rgbs], dtype=np.float32) / 255
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB)[0], dtype=np.float64) * (0.5, 1, 1)


def palette(vehicle: Vehicle, *, shades: bool = False) -> list[str]:
    """Return names of the paints for a vehicle; with `shades`, private cars have several paints per colour."""
    kind = vehicle.style.palette if isinstance(vehicle, ParametricVehicle) else "private"
    kind = "shades" if shades and kind == "private" else kind
    return [name for name, paint in ALL_PAINTS.items() if paint.palette == kind]


def draw_paint(vehicle: Vehicle, rng: np.random.Generator, *, shades: bool = False) -> str:
    """Return the name of a random paint for a vehicle, by the shares of its palette."""
    names = palette(vehicle, shades=shades)
    shares = np.array([ALL_PAINTS[name].share for name in names])
    return names[rng.choice(len(names), p=shares / shares.sum())]


assert {paint.color for paint in ALL_PAINTS.values()} <= set(VEHICLE_COLORS)
assert {parametric(model).style.palette for model in fleet()} == {paint.palette for paint in ALL_PAINTS.values()} - {
    "shades"
}
