"""Motorhomes: a body with windows and a bed over the cab of a van."""

from dataclasses import replace
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box
from skope.gen.vehicles import parts
from skope.gen.vehicles.body_axes import LEFT_AXIS
from skope.gen.vehicles.box_bodies import peak
from skope.gen.vehicles.cargo import Cargo, CargoSpace
from skope.gen.vehicles.liveries import TONES
from skope.gen.vehicles.lofted_surfaces import BOTTOM, SIDE, WRAP, Plan, Surface
from skope.gen.vehicles.panels import rectangle_outline
from skope.gen.vehicles.upright_shells import Tower, arch

_BELT: Final = 0.95
"""Height of the windows' lower edge over the floor, metres."""


def living_body(space: CargoSpace) -> Cargo:
    """A motorhome: windows with dark frames, a bed over the cab, stripes, a hatch, vents on the roof, a rack behind."""
    rng, out = space.rng(), Cargo()
    s = space.shape
    well = s.track / 2 - s.wheel_width / 2 - 0.08
    tower = Tower(
        Plan(space.half, space.ahead + 0.02, space.end + 0.02, 0.0, 0.02, 0.05, 0.12), space.floor, s.height - 0.1,
        edge=0.09, crown=0.02, ridge=0.5, well=well, stations=9, levels=3,
    )  # fmt: skip
    shell, w, _ = tower.surface("paint")
    lining, rim = shell.carve_well(arch(s.rear_axle_x, s), well)
    out.parts += [lining, parts.arch_lip(rim, (s.rear_axle_x, s.wheel_radius), "trim", shell.side)]
    end, top = float(w[-1]), s.height - 0.1
    shell.draw(rectangle_outline(-1, 99, 0, space.floor + 0.1), WRAP, "rail")
    _draw_stripes(shell, space, rng)
    _draw_side(shell, space)
    belt = space.floor + _BELT
    window = end - 0.62
    shell.paint(rectangle_outline(window - 0.05, end + 0.1, belt - 0.05, belt + 0.5), WRAP, "trim")
    shell.paint(rectangle_outline(window, end + 0.1, belt, belt + 0.45), WRAP, "glass_tinted")
    corner = end - space.half
    shell.draw(rectangle_outline(corner + 0.1, corner + 0.2, top - 0.35, top - 0.22), WRAP, "brake_light", layer=2)
    out.parts += [shell.half, *_outside(space, top), peak(replace(space, shape=replace(s, height=top)), "paint")]
    out.mark(
        shell.place((corner, top - 0.115), WRAP)[0],
        shell.place((window, belt), WRAP)[0],
        shell.corner(BOTTOM, rear=True),
    )
    return out


def _draw_stripes(shell: Surface, space: CargoSpace, rng: np.random.Generator) -> None:
    tones = [TONES[k] for k in rng.choice(len(TONES), 2, replace=False)]
    low = space.floor + 0.45
    for tone, lift, wide in ((tones[0], 0.0, 0.16), (tones[1], 0.2, 0.05)):
        sweep = [
            (space.end + 0.1, low + lift + 0.3),
            (space.ahead, low + lift),
            (space.ahead, low + lift + wide),
            (space.end + 0.1, low + lift + 0.3 + wide),
        ]
        shell.draw(sweep, SIDE, tone, layer=2, facing=LEFT_AXIS)


def _draw_side(shell: Surface, space: CargoSpace) -> None:
    """The windows and the door."""
    belt, length = space.floor + _BELT, space.ahead - space.end
    for share, wide, high in ((0.16, 0.7, 0.5), (0.46, 0.9, 0.55), (0.84, 0.5, 0.45)):
        x = space.end + share * length
        shell.paint(
            rectangle_outline(x - wide / 2 - 0.04, x + wide / 2 + 0.04, belt - 0.04, belt + high + 0.04),
            SIDE,
            "trim",
            facing=LEFT_AXIS,
        )
        shell.paint(
            rectangle_outline(x - wide / 2, x + wide / 2, belt, belt + high), SIDE, "glass_tinted", facing=LEFT_AXIS
        )
    hatch = space.end + 0.66 * length
    shell.line(
        [
            (hatch - 0.3, space.floor + 0.15),
            (hatch - 0.3, belt + 0.85),
            (hatch + 0.3, belt + 0.85),
            (hatch + 0.3, space.floor + 0.15),
            (hatch - 0.3, space.floor + 0.15),
        ],
        SIDE,
        width=0.014,
        facing=LEFT_AXIS,
    )


def _outside(space: CargoSpace, top: float) -> list[Mesh]:
    """The window of the bed over the cab, vents on the roof at the height `top`, half of a rack for bicycles."""
    s, belt, length = space.shape, space.floor + _BELT, space.ahead - space.end
    out: list[Mesh] = []
    add = out.append
    front = space.ahead + 0.62 * s.cab_length
    add(
        box(
            (front - 1.0, space.half - 0.03, space.cab_height + 0.3),
            (front - 0.45, space.half + 0.004, space.cab_height + 0.55),
            "glass_tinted",
        )
    )
    for x in (space.end + 0.25 * length, space.end + 0.7 * length):
        add(parts.block((x - 0.35, -0.35, top - 0.05), (x + 0.35, 0.35, s.height), "#dcdcda", 0.06))
    add(box((space.end, 0.62, belt - 0.5), (space.end + 0.05, 0.66, belt + 0.6), "rail"))
    add(box((space.end, 0.0, belt - 0.5), (space.end + 0.05, 0.66, belt - 0.46), "rail"))
    return out
