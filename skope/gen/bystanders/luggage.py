"""Luggage that people carry, push, pull or transport on a two-wheeler."""

from typing import Final

import numpy as np

from skope.gen.bystanders.people import Look, ball, trunk
from skope.gen.mesh import Mesh, box, lathe, tube
from skope.types import Array

LUGGAGE_KINDS: Final = (
    "nothing", "backpack", "shopping bag", "suitcase", "umbrella", "pushchair", "panniers", "basket", "delivery box",
    "trailer", "top case",
)  # fmt: skip
"""Kinds of luggage, indexed by `Look.load`."""
CLOTH_COLORS: Final = ("#222233", "#335544", "#772222", "#334466", "#555555", "#aa7733", "#ddaa33")
BOX_COLORS: Final = ("#22aa88", "#dd7711", "#cc2255", "#2255aa", "#222222")


def load_of(look: Look) -> str:
    """Return the name of a person's luggage."""
    return LUGGAGE_KINDS[int(look.load)]


def cloth(look: Look) -> str:
    """Return the colour of a bag, an umbrella or a hood."""
    return CLOTH_COLORS[look.digit(0, len(CLOTH_COLORS))]


def backpack(look: Look, shoulder: Array) -> list[Mesh]:
    """Build a backpack for an upright or slightly bent body with the base of the neck at a point (3,)."""
    h, color = look.height, cloth(look)
    middle = shoulder + np.array([-0.115, 0, -0.11]) * h
    return [
        ball(middle, (0.055 * h, 0.088 * h, 0.125 * h), color),
        ball(middle + np.array([-0.035, 0, -0.045]) * h, (0.04 * h, 0.065 * h, 0.06 * h), color),
    ]


def shopping_bag(look: Look) -> list[Mesh]:
    """Build a bag in the hand of an arm that hangs from the origin."""
    h, color = look.height, cloth(look)
    low, high = (-0.075 * h, -0.035 * h, -0.57 * h), (0.095 * h, 0.035 * h, -0.42 * h)
    handles = [
        tube([(0.01 * h, y, -0.43 * h), (0.015 * h, 0, -0.36 * h)], (0.004,) * 2, color, 4) for y in (-0.03, 0.03)
    ]
    return [box(low, high, color), *handles]


def suitcase(look: Look) -> list[Mesh]:
    """Build a wheeled suitcase pulled by the right hand."""
    h, color = look.height, cloth(look)
    y = -0.14 * h
    parts = [box((-0.62, y - 0.12, 0.06), (-0.36, y + 0.12, 0.62), color)]
    parts += [tube([(-0.40, y + at, 0.60), (-0.17 * h, y, 0.455 * h)], (0.008,) * 2, "trim", 4) for at in (-0.07, 0.07)]
    wheels = [lathe([(-0.015, 0.05), (0.015, 0.05)], ["tyre"], 8, "y") for _ in range(2)]
    return parts + [wheel.moved((-0.40, y + side * 0.10, 0.05)) for wheel, side in zip(wheels, (-1, 1), strict=True)]


def umbrella(look: Look) -> list[Mesh]:
    """Build an open umbrella over the head, held in front of the body."""
    h, color = look.height, cloth(look)
    profile = [(1.045, 0.002), (1.05, 0.33), (1.10, 0.28), (1.16, 0.15), (1.185, 0.002)]
    canopy = lathe([(z * h, r * h) for z, r in profile], [color] * 4, 10, "z")
    at = np.array([0.17 * h, -0.05 * h, 0.0])
    return [
        canopy.moved(at),
        tube([at + [0.05 * h, -0.04 * h, 0.60 * h], at + [0, 0, 1.1 * h]], (0.008,) * 2, "trim", 5),
    ]


def pushchair(look: Look) -> list[Mesh]:
    """Build a pushchair with a hood, in front of a person who holds its bar."""
    h, color = look.height, cloth(look)
    x = 0.30 * h
    parts = [
        trunk(
            [((x + 0.34, 0, 0.42), 0.20, 0.17), ((x + 0.34, 0, 0.60), 0.27, 0.19), ((x + 0.33, 0, 0.66), 0.28, 0.2)],
            color,
        ),
        ball((x + 0.22, 0, 0.68), (0.24, 0.20, 0.30), color, above=0.0),
    ]
    for side in (-0.24, 0.24):
        bar = [(x, side, 0.60 * h), (x + 0.30, side, 0.45), (x + 0.62, side, 0.10)]
        parts += [tube(bar, (0.012,) * 3, "trim", 5), tube([bar[1], (x + 0.05, side, 0.10)], (0.012,) * 2, "trim", 5)]
        for ahead in (0.05, 0.62):
            parts.append(lathe([(-0.02, 0.10), (0.02, 0.10)], ["tyre"], 10, "y").moved((x + ahead, side, 0.10)))
    return [*parts, tube([(x, -0.24, 0.60 * h), (x, 0.24, 0.60 * h)], (0.012,) * 2, "trim", 5)]


def panniers(look: Look, seat: Array, apart: float) -> list[Mesh]:
    """Build a bag on each side of a rear wheel; the rack begins at a point (3,) and is `apart` wide."""
    color = cloth(look)
    low, high = seat + [-0.42, 0, -0.36], seat + [-0.08, 0, -0.02]
    return [box(low + [0, y - 0.07, 0], high + [0, y + 0.07, 0], color) for y in (-apart / 2, apart / 2)]


def delivery_box(look: Look, low: Array, side: float) -> list[Mesh]:
    """Build a courier's box; the middle of its bottom front edge is at a point (3,)."""
    color = BOX_COLORS[look.digit(1, len(BOX_COLORS))]
    half = side / 2
    return [
        box(low + [-side, -half, 0.0], low + [0.0, half, 0.92 * side], color),
        box(low + [-side - 0.003, -0.8 * half, 0.3 * side], low + [-side, 0.8 * half, 0.7 * side], "#dddddd"),
    ]


def trailer(look: Look) -> list[Mesh]:
    """Build a child trailer behind a bicycle with its rear axle at the origin; the wheels are on the ground."""
    color = CLOTH_COLORS[2 + look.digit(1, 5)]
    x, r = -0.75, 0.24
    parts = [
        trunk([((x, 0, 0.20), 0.42, 0.32), ((x, 0, 0.50), 0.44, 0.33), ((x - 0.06, 0, 0.86), 0.30, 0.27)], color, 12),
        tube([(0, -0.08, 0.33), (-0.35, -0.12, 0.30)], (0.015,) * 2, "trim", 5),
        tube([(x - 0.40, 0.2, 0.40), (x - 0.42, 0.2, 1.35)], (0.006,) * 2, "rail", 4),
        box((x - 0.62, 0.195, 1.18), (x - 0.42, 0.205, 1.34), "#dd7711"),
    ]
    for side in (-0.38, 0.38):
        parts.append(lathe([(-0.025, r), (0.025, r)], ["tyre"], 14, "y").moved((x, side, r)))
        parts.append(lathe([(-0.027, 0.7 * r), (0.027, 0.7 * r)], ["rim"], 14, "y").moved((x, side, r)))
    return parts
