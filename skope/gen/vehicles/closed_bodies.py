"""Closed cargo bodies, all with liveries.

They are boxes with doors or a roller shutter, refrigerated boxes, curtain sides, tanks for liquids, concrete mixers,
and motorhomes with windows and a bed over the cab of a van.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box
from skope.gen.vehicles import parts
from skope.gen.vehicles.lofted_surfaces import BOTTOM, ROW_AXES, SIDE_AXES, WRAP_AXES, Plan, Surface
from skope.gen.vehicles.lorry_parts import Cargo, CargoSpace, mudguards
from skope.gen.vehicles.panels import (
    GRAPHIC_COLORS,
    MARKER_MATERIAL,
    PANEL_LIMITS,
    draw_graphics,
    draw_on_left,
    draw_upper_markers,
    rectangle_outline,
)
from skope.gen.vehicles.solids import Tower, arch, barrel, beam, ladder, pipe, prism, ring


@dataclass(frozen=True)
class ClosedBodySizes:
    """Sizes of closed cargo bodies."""

    door_frame_m: float = 0.11
    """Width of the frame around the doors, metres."""
    shutter_share: float = 0.4
    """Share of boxes with a roller shutter at the rear."""
    belt_height_m: float = 0.95
    """Height of the windows' lower edge above the floor, metres."""


CLOSED_BODIES: Final = ClosedBodySizes()


def box_body(space: CargoSpace) -> Cargo:
    """Return a box of smooth panels, with a cooling unit if the style has one."""
    rng, out = space.rng(), Cargo()
    shell, end = _box_shell(space, "livery")
    high = space.shape.height
    sill, top = space.floor + 0.12, high - 0.16
    draw_graphics(shell, (space.end + 0.2, space.ahead - 0.2), (sill + 0.05, top), rng)
    for x in np.linspace(space.ahead - 0.04, space.end + 0.04, 2):
        draw_on_left(shell, (x - 0.035, x + 0.035, sill, top + 0.04), "rail", layer=3)
    _draw_box_rear(shell, space, end, shutter=rng.uniform() < CLOSED_BODIES.shutter_share)
    out.parts.append(shell.half)
    if space.style.cooled:
        low = high - 1.25
        out.parts.append(
            parts.block((space.ahead - 0.02, -0.75, low), (space.ahead + 0.42, 0.75, high - 0.12), "#e4e4e2", 0.07)
        )
        corners = (space.ahead + 0.405, 0.0, low + 0.15), (space.ahead + 0.43, 0.55, low + 0.7)
        out.parts.append(box(*corners, "grille"))
    _mark_box_points(out, shell, space, end)
    return out


def curtain_body(space: CargoSpace) -> Cargo:
    """Return a frame with tarpaulin curtains along the sides: straps with buckles, and folds between the posts."""
    rng, out = space.rng(), Cargo()
    shell, end = _box_shell(space, "livery")
    sill, top = space.floor + 0.12, space.shape.height - 0.16
    folds = np.arange(space.end + 0.35, space.ahead - 0.25, 0.46).tolist()
    for x in folds:
        # A fold is a lighter and a darker line beside each other, as from light along the side.
        wide = float(rng.uniform(0.03, 0.07))
        shell.draw(
            rectangle_outline(x, x + wide, sill, top), SIDE_AXES, "tarpaulin" if wide > 0.06 else "rail", layer=1
        )
    draw_graphics(shell, (space.end + 0.2, space.ahead - 0.2), (sill + 0.22, top - 0.05), rng)
    for x in folds:
        draw_on_left(shell, (x - 0.02, x + 0.02, sill, sill + 0.34), "trim", layer=8)
        draw_on_left(shell, (x - 0.035, x + 0.035, sill + 0.1, sill + 0.17), "chrome", layer=10)
    for x in (space.ahead - 0.05, space.end + 0.05):
        draw_on_left(shell, (x - 0.05, x + 0.05, sill, top + 0.04), "rail", layer=3)
    _draw_box_rear(shell, space, end, shutter=False)
    out.parts.append(shell.half)
    _mark_box_points(out, shell, space, end)
    return out


def _box_shell(space: CargoSpace, material: str) -> tuple[Surface, float]:
    """Return the box, and the distance along its outline to the middle of its rear, metres.

    The box has rails along its upper and lower edges, and marker lamps on these.
    """
    tower = Tower(
        Plan(space.half, space.ahead, space.end, 0.0, 0.0, 0.05, 0.035),
        space.floor,
        space.shape.height,
        [(0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.012)],
        edge=0.05,
        crown=0.015,
        ridge=0.5,
        stations=3,
        levels=2,
    )
    shell, w, _ = tower.surface(material)
    shell.draw(rectangle_outline(-1, 99, 0, space.floor + 0.09), WRAP_AXES, "rail")
    shell.draw(rectangle_outline(-1, 99, space.shape.height - 0.12, space.shape.height - 0.06), WRAP_AXES, "rail")
    z = space.floor + 0.035
    for x in np.arange(space.end + 0.5, space.ahead - 0.4, 1.1).tolist():
        shell.draw(rectangle_outline(x - 0.03, x + 0.03, z, z + 0.03), SIDE_AXES, MARKER_MATERIAL, layer=4)
    return shell, float(w[-1])


def _draw_box_rear(shell: Surface, space: CargoSpace, end: float, *, shutter: bool) -> None:
    """Draw two doors with bolts and hinges, or the slats of a shutter."""
    edge, sill, top = end - space.half + CLOSED_BODIES.door_frame_m, space.floor + 0.12, space.shape.height - 0.16
    shell.line([(end + 0.1, sill), (edge, sill), (edge, top), (end + 0.1, top)], WRAP_AXES, width=0.02)
    if shutter:
        for z in np.arange(sill + 0.12, top - 0.05, 0.16).tolist():
            shell.line([(edge, z), (end + 0.1, z)], WRAP_AXES, width=0.012)
        shell.draw(rectangle_outline(end - 0.3, end + 0.1, sill + 0.06, sill + 0.1), WRAP_AXES, "trim", layer=2)
    else:
        shell.line([(end, sill), (end, top)], WRAP_AXES, width=0.016)
        for share in (0.28, 0.6):
            bolt = rectangle_outline(end - share - 0.012, end - share + 0.012, sill + 0.05, top - 0.05)
            shell.draw(bolt, WRAP_AXES, "chrome", layer=5)
            shell.draw(
                rectangle_outline(end - share - 0.03, end - share + 0.2, sill + 0.55, sill + 0.6),
                WRAP_AXES,
                "rail",
                layer=7,
            )
        for z in np.linspace(sill + 0.3, top - 0.3, 4):
            shell.draw(rectangle_outline(edge, edge + 0.1, z, z + 0.05), WRAP_AXES, "rail", layer=2)
    # Marker lamps, and the red and yellow plates of long and heavy lorries.
    draw_upper_markers(shell, space.half, top + 0.05, end)
    shell.draw(
        rectangle_outline(edge + 0.05, edge + 0.6, sill + 0.1, sill + 0.22), WRAP_AXES, GRAPHIC_COLORS[6], layer=4
    )
    shell.draw(
        rectangle_outline(edge + 0.07, edge + 0.58, sill + 0.12, sill + 0.2), WRAP_AXES, GRAPHIC_COLORS[0], layer=6
    )


def _mark_box_points(out: Cargo, shell: Surface, space: CargoSpace, end: float) -> None:
    corner, high = end - space.half, space.shape.height
    out.mark(
        shell.place((corner, high - 0.065), WRAP_AXES)[0],
        shell.place((corner + CLOSED_BODIES.door_frame_m, high - 0.16), WRAP_AXES)[0],
        shell.place((corner, BOTTOM), ROW_AXES)[0],
    )


def luton_body(space: CargoSpace) -> Cargo:
    """Return a box with an upper part that extends forwards over the cab, with a shutter or doors."""
    rng, out = space.rng(), Cargo()
    shell, end = _box_shell(space, "livery")
    sill, top = space.floor + 0.12, space.shape.height - 0.16
    draw_graphics(shell, (space.end + 0.2, space.ahead - 0.15), (sill + 0.05, top), rng)
    for x in (space.ahead - 0.04, space.end + 0.04):
        draw_on_left(shell, (x - 0.035, x + 0.035, sill, top + 0.04), "rail", layer=3)
    _draw_box_rear(shell, space, end, shutter=rng.uniform() < 0.6)
    out.parts += [shell.half, peak(space, "livery")]
    _mark_box_points(out, shell, space, end)
    return out


def peak(space: CargoSpace, material: str) -> Mesh:
    """Return the part of the box that extends over the cab, up to the windscreen."""
    low, high = space.cab_height + 0.07, space.shape.height - 0.065
    start, front = space.ahead - 0.02, space.ahead + 0.62 * space.shape.cab_length
    outline = [
        (front, low + 0.28),
        (front - 0.12, low),
        (start, low),
        (start, high),
        (front - 0.4, high),
        (front - 0.1, high - 0.3),
    ]
    return prism(outline, space.half - 0.006, material)


def tank_body(space: CargoSpace) -> Cargo:
    """Return an elliptical tank on saddles, with bands, a walkway with lids, hose trays, a cabinet and a ladder."""
    rng, out = space.rng(), Cargo()
    half, high = space.half - 0.04, (space.shape.height - space.floor - 0.32) / 2
    z = space.floor + 0.14 + high
    front, rear = space.ahead - 0.2, space.end + 0.28
    skin = ("livery", "livery", "#d9dad8", "#b9bdc1")[int(rng.integers(4))]
    dish = ((0.13, 0.3), (0.12, 0.6), (0.06, 0.86), (0.0, 1.0))
    sections = [(rear - 0.13, z, 0.0, 0.0)]
    sections += [(rear - reach, z, half * share, high * share) for reach, share in dish]
    sections += [(front + reach, z, half * share, high * share) for reach, share in reversed(dish)]
    sections.append((front + 0.13, z, 0.0, 0.0))
    square = 2.5
    out.parts.append(barrel(sections, skin, square=square))
    for x in np.linspace(rear + 0.03, front - 0.03, 5).tolist():
        out.parts.append(_tank_band(x, z, half + 0.012, high + 0.012, square))
    tone = GRAPHIC_COLORS[int(rng.integers(len(GRAPHIC_COLORS)))]
    if rng.uniform() < 0.6:
        # A stripe at half height, where the side is upright.
        out.parts.append(box((rear + 0.1, half - 0.05, z - 0.12), (front - 0.1, half + 0.008, z + 0.12), tone))
    _tank_fittings(out, space, (rear, front), z, (half, high))
    end = ring(rear, z, half, high, square=square)
    inner = ring(rear - 0.06, z, 0.86 * half, 0.86 * high, square=square)
    out.mark(end[9], inner[9], end[3])
    return out


def _tank_band(x: float, z: float, half: float, high: float, square: float) -> Mesh:
    wide = 0.03
    return barrel(
        [(x - wide, z, half - 0.02, high - 0.02), (x - wide, z, half, high), (x + wide, z, half, high),
         (x + wide, z, half - 0.02, high - 0.02)],
        "rail", square=square, sharp=True,
    )  # fmt: skip


def _tank_fittings(
    out: Cargo, space: CargoSpace, along: tuple[float, float], z: float, size: tuple[float, float]
) -> None:
    """Add the fittings around a tank."""
    (rear, front), (half, high), s = along, size, space.shape
    add, top = out.parts.append, space.shape.height
    for x in np.linspace(rear + 0.4, front - 0.4, 3).tolist():
        add(
            prism(
                [
                    (x - 0.09, space.floor),
                    (x + 0.09, space.floor),
                    (x + 0.09, z - 0.5 * high),
                    (x - 0.09, z - 0.5 * high),
                ],
                0.62,
                "trim",
            )
        )
    # The walkway, its lids, and its rail.
    add(box((rear + 0.25, 0.0, z + high - 0.05), (front - 0.25, 0.34, z + high + 0.03), "rail"))
    for x in np.linspace(rear + 0.7, front - 0.7, 4).tolist():
        lid = parts.block((x - 0.26, -0.26, z + high - 0.05), (x + 0.26, 0.26, top - 0.06), "chrome", 0.08)
        add(lid)
    add(box((rear + 0.25, 0.42, top - 0.035), (front - 0.25, 0.46, top), "chrome"))
    for x in np.linspace(rear + 0.3, front - 0.3, 6).tolist():
        add(box((x - 0.015, 0.42, z + high - 0.2), (x + 0.015, 0.46, top - 0.02), "chrome"))
    # Hose trays along the lower sides, the cabinet of valves, the ladder and orange plates.
    add(
        pipe(
            (space.rear_axle - 0.2 - s.wheel_radius, half - 0.2, space.floor + 0.1),
            (front - 0.3, half - 0.2, space.floor + 0.1),
            0.1,
            "rail",
        )
    )
    add(box((space.end + 0.1, 0.0, space.floor - 0.02), (rear + 0.3, half - 0.1, space.floor + 0.12), "trim"))
    add(parts.block((space.end + 0.04, 0.3, space.floor + 0.05), (rear - 0.02, 0.95, z + 0.05), "chrome", 0.03))
    add(ladder(space.end + 0.06, (0.0, 0.2), space.floor + 0.1, top, "chrome"))
    add(box((space.end + 0.06, 0.16, top - 0.04), (rear + 0.5, 0.2, top), "chrome"))
    add(box((space.end + 0.015, 0.42, space.floor + 0.3), (space.end + 0.05, 0.82, space.floor + 0.6), "#e07b18"))
    out.parts += mudguards(space)


def mixer_body(space: CargoSpace) -> Cargo:
    """Return an inclined concrete drum between its pedestals, with hopper, chute, water tank and ladder."""
    s, rng, out = space.shape, space.rng(), Cargo()
    add, front, rear = out.parts.append, space.ahead - 0.75, space.end + 1.05
    length, top = front - rear, s.height
    widest = min(space.half - 0.1, (top - space.floor) * 0.44)
    base = space.floor + 0.16 + widest

    def section(share: float, radius: float) -> tuple[float, float, float, float]:
        return front - share * length, base + 0.42 * (share - 0.36), radius, radius

    profile = [(1.0, 0.0), (1.0, 0.5), (0.97, 0.52), (0.55, 1.0), (0.36, 1.0), (0.08, 0.72), (0.0, 0.6), (-0.02, 0.0)]
    tone = GRAPHIC_COLORS[int(rng.integers(len(GRAPHIC_COLORS)))]
    stripe = tone if rng.uniform() < 0.6 else "livery"
    add(
        barrel(
            [section(share, widest * size) for share, size in profile],
            ["trim", "trim", "livery", stripe, "livery", "livery", "rail"],
            sharp=True,
        )
    )
    mouth = section(1.0, widest * 0.5)
    low = space.floor
    # Pedestals: a wall at the front, an inclined frame at the rear; a roller under the drum's ring.
    add(
        prism(
            [(front - 0.1, low), (front + 0.16, low), (front + 0.12, base + 0.1), (front - 0.04, base + 0.1)],
            0.5,
            "rail",
        )
    )
    for y in (0.42, 0.7):
        add(beam((rear - 0.15, y, low), (rear + 0.25, y, mouth[1] - 0.35), 0.05, 0.07, "rail"))
    add(box((rear + 0.1, 0.0, mouth[1] - 0.62), (rear + 0.34, 0.76, mouth[1] - 0.45), "rail"))
    add(pipe((front + 0.45, 0.0, low + 0.5), (front + 0.45, space.half - 0.25, low + 0.5), 0.3, "livery", sides=12))
    # The hopper above the mouth, and the folded chute at the rear.
    hopper = [(rear + 0.25, top - 0.42), (rear + 0.4, top), (rear - 0.5, top), (rear - 0.5, top - 0.42)]
    add(prism(hopper, 0.55, "livery"))
    add(
        prism(
            [
                (rear - 0.2, mouth[1] - 0.2),
                (rear - 0.12, top - 0.4),
                (rear - 0.36, top - 0.4),
                (rear - 0.5, mouth[1] - 0.2),
            ],
            0.4,
            "rail",
        )
    )
    add(beam((rear - 0.28, 0.0, mouth[1] - 0.2), (space.end + 0.2, 0.0, low + 0.55), 0.24, 0.1, "rail"))
    add(beam((space.end + 0.5, 0.0, low + 0.1), (space.end + 0.2, 0.0, low + 0.6), 0.2, 0.08, "rail"))
    add(ladder(rear - 0.42, (0.62, 0.92), low + 0.05, top - 0.4, "chrome"))
    add(box((rear - 0.6, 0.55, top - 0.42), (rear - 0.05, 0.95, top - 0.38), "rail"))
    # The end of the frame, with the lamps.
    add(box((space.end + 0.04, 0.0, low - 0.22), (rear + 0.2, space.half - 0.12, low + 0.02), "trim"))
    out.parts += mudguards(space)
    out.mark(
        np.array([rear - 0.5, 0.55, top]),
        np.array([rear - 0.5, 0.55, top - 0.42]),
        np.array([space.end + 0.04, space.half - 0.12, low - 0.22]),
    )
    return out


def living_body(space: CargoSpace) -> Cargo:
    """Return a motorhome body.

    It has windows with dark frames, a bed over the cab, stripes, a hatch, vents on the roof and a rack at the rear.
    """
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
    shell.draw(rectangle_outline(-1, 99, 0, space.floor + 0.1), WRAP_AXES, "rail")
    _draw_stripes(shell, space, rng)
    _draw_motorhome_side(shell, space)
    belt = space.floor + CLOSED_BODIES.belt_height_m
    window = end - 0.62
    shell.paint(rectangle_outline(window - 0.05, end + 0.1, belt - 0.05, belt + 0.5), WRAP_AXES, "trim")
    shell.paint(rectangle_outline(window, end + 0.1, belt, belt + 0.45), WRAP_AXES, "glass_tinted")
    corner = end - space.half
    shell.draw(rectangle_outline(corner + 0.1, corner + 0.2, top - 0.35, top - 0.22), WRAP_AXES, "brake_light", layer=2)
    out.parts += [
        shell.half,
        *_outer_fittings(space, top),
        peak(replace(space, shape=replace(s, height=top)), "paint"),
    ]
    out.mark(
        shell.place((corner, top - 0.115), WRAP_AXES)[0],
        shell.place((window, belt), WRAP_AXES)[0],
        shell.corner(BOTTOM, rear=True),
    )
    return out


def _draw_stripes(shell: Surface, space: CargoSpace, rng: np.random.Generator) -> None:
    tones = [GRAPHIC_COLORS[k] for k in rng.choice(len(GRAPHIC_COLORS), 2, replace=False)]
    low = space.floor + 0.45
    for tone, lift, wide in ((tones[0], 0.0, 0.16), (tones[1], 0.2, 0.05)):
        sweep = [
            (space.end + 0.1, low + lift + 0.3),
            (space.ahead, low + lift),
            (space.ahead, low + lift + wide),
            (space.end + 0.1, low + lift + 0.3 + wide),
        ]
        shell.draw(sweep, SIDE_AXES, tone, layer=2, facing=PANEL_LIMITS.left_axis)


def _draw_motorhome_side(shell: Surface, space: CargoSpace) -> None:
    """Draw the windows and the door."""
    belt, length = space.floor + CLOSED_BODIES.belt_height_m, space.ahead - space.end
    for share, wide, high in ((0.16, 0.7, 0.5), (0.46, 0.9, 0.55), (0.84, 0.5, 0.45)):
        x = space.end + share * length
        shell.paint(
            rectangle_outline(x - wide / 2 - 0.04, x + wide / 2 + 0.04, belt - 0.04, belt + high + 0.04),
            SIDE_AXES,
            "trim",
            facing=PANEL_LIMITS.left_axis,
        )
        shell.paint(
            rectangle_outline(x - wide / 2, x + wide / 2, belt, belt + high),
            SIDE_AXES,
            "glass_tinted",
            facing=PANEL_LIMITS.left_axis,
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
        SIDE_AXES,
        width=0.014,
        facing=PANEL_LIMITS.left_axis,
    )


def _outer_fittings(space: CargoSpace, top: float) -> list[Mesh]:
    """Return the window of the bed over the cab, vents on the roof at height `top`, and half of a bicycle rack."""
    s, belt, length = space.shape, space.floor + CLOSED_BODIES.belt_height_m, space.ahead - space.end
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
