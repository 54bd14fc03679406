"""The long nose of American lorries: a hood over the engine, its grille, fenders and a bumper before the cab."""

from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box, tube
from skope.gen.vehicles import front, parts
from skope.gen.vehicles.lofted_surfaces import BOTTOM, WRAP, Plan
from skope.gen.vehicles.panels import Points, grown, rectangle_outline
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.upright_shells import Tower, arch

_BEHIND_BUMPER: Final = 0.14
"""Distance of the grille behind the bumper's face, metres."""
_FENDER: Final = 0.6
"""Share of the hood's height at which the fenders end and the hood stands in."""


def long_hood(s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """The left half of a hood from the vehicle's front back to its cab; notes the front's keypoints."""
    nose = s.length / 2
    half, top = s.width / 2 - 0.04, s.hood_height
    plan = Plan(half, nose - _BEHIND_BUMPER, nose - s.hood_length - 0.06, 0.1, 0.0, 0.22, 0.04)
    lean = [
        (0.0, 0.03, 0.05, 0.0),
        (0.08, 0.0, 0.0, 0.0),
        (_FENDER, 0.02, 0.02, 0.0),
        (_FENDER + 0.07, 0.3, 0.05, 0.0),
        (1.0, 0.4, 0.16, 0.0),
    ]
    well = s.track / 2 - s.wheel_width / 2 - 0.06
    tower = Tower(plan, s.clearance, top, lean, edge=0.1, crown=0.05, well=well, stations=9, levels=4)
    hood, w, _ = tower.surface("paint")
    lining, rim = hood.carve_well(arch(s.front_axle_x, s), well)
    out = [lining, parts.arch_lip(rim, (s.front_axle_x, s.wheel_radius), "paint", hood.side)]
    out += front.draw_front(hood, w, s, style, points)
    grille = rectangle_outline(-0.44, 0.44, s.headlight_high + 0.04, top - 0.24)
    hood.paint(grown(grille, 0.04), WRAP, "chrome")
    hood.sink(grille, WRAP, 0.03, "grille_bars", wall="gap")
    points["hood_front"] = hood.place((0.56, top - 0.16), WRAP)[0]
    out.append(hood.half)
    bar = Plan(s.width / 2 - 0.01, nose, nose - 0.34, 0.07, 0.0, 0.12, 0.03)
    low, high = s.clearance + 0.02, s.headlight_low - 0.06
    bumper, _, _ = Tower(bar, low, high, edge=0.02, crown=0.0, stations=3).surface("chrome")
    out.append(bumper.half)
    points["bumper_front"] = bumper.corner(BOTTOM)
    return out


def exhaust_stack(x: float, y: float, low: float, high: float) -> list[Mesh]:
    """The upright chromed pipe behind the left side of a cab, with its muffler."""
    pipe = [np.array([x, y, z]) for z in (low, high)]
    muffler = [np.array([x, y, z]) for z in (low + 0.5, low + 1.4)]
    return [
        tube(pipe, [0.06, 0.06], "chrome", 10),
        tube(muffler, [0.11, 0.11], "chrome", 12),
        box((x - 0.11, y - 0.11, low - 0.05), (x + 0.11, y + 0.11, low + 0.5), "chrome"),
        box((x - 0.1, y - 0.1, low + 1.4), (x + 0.1, y + 0.1, low + 1.41), "chrome"),
        box((x - 0.05, y - 0.05, high - 0.02), (x + 0.05, y + 0.05, high - 0.01), "gap"),
    ]
