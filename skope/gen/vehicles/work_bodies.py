"""Bodies of work vehicles.

They are fire engines with shutters and a ladder, refuse collectors with a hopper at the rear, hook lifts with
containers, skip loaders, and decks that carry cars.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box
from skope.gen.vehicles.lofted_surfaces import BOTTOM, SIDE_AXES, TOP_AXES, WRAP_AXES, Plan, Surface
from skope.gen.vehicles.lorry_parts import BEACON_COLOR, Cargo, CargoSpace, mudguards
from skope.gen.vehicles.panels import GRAPHIC_COLORS, PANEL_LIMITS, draw_graphics, draw_on_left, rectangle_outline
from skope.gen.vehicles.parts import arch_lip, block
from skope.gen.vehicles.solids import Tower, arch, barrel, beam, ladder, pipe, prism


@dataclass(frozen=True)
class WorkBodySizes:
    """Sizes of parts of work vehicles."""

    ladder_m: float = 0.3
    """Height of the ladder above the roof, metres."""
    hopper_m: float = 1.55
    """Length of a hopper, metres."""


WORK_BODY_SIZES: Final = WorkBodySizes()


def fire_body(space: CargoSpace) -> Cargo:
    """Return a fire engine's body with side shutters, a roof ladder, reflective bands and lamps."""
    out = Cargo()
    floor, high = space.floor, space.shape.height - WORK_BODY_SIZES.ladder_m
    well = space.shape.track / 2 - space.shape.wheel_width * 1.7
    tower = Tower(
        Plan(space.half - 0.01, space.ahead + 0.02, space.end + 0.02, 0.0, 0.0, 0.06, 0.05), floor, high, edge=0.06,
        crown=0.02, well=well, stations=9, levels=3,
    )  # fmt: skip
    shell, w, _ = tower.surface("paint")
    lining, rim = shell.carve_well(arch(space.rear_axle, space.shape), well)
    out.parts += [lining, arch_lip(rim, (space.rear_axle, space.shape.wheel_radius), "trim", shell.side)]
    end = float(w[-1])
    sill, edge = max(floor + 0.12, space.shape.wheel_radius * 2.2), end - space.half + 0.3
    _draw_shutters(shell, space, (sill, high - 0.3), end)
    out.parts += [shell.half, *_fire_roof(space, high)]
    corner = end - space.half
    out.mark(
        shell.place((corner, high - 0.085), WRAP_AXES)[0],
        shell.place((edge, sill), WRAP_AXES)[0],
        shell.corner(BOTTOM, rear=True),
    )
    return out


def _draw_shutters(shell: Surface, space: CargoSpace, up: tuple[float, float], end: float) -> None:
    """Draw three shutters along the side and one at the rear, between two heights, a band below, lamps above.

    `end` is W of the middle of the rear.
    """
    (sill, top), edge = up, end - space.half + 0.3
    start, stop = space.end + 0.35, space.ahead - 0.2
    count = 3
    for k in range(count):
        a, b = (start + (stop - start) * (k + share) / count for share in (0.03, 0.97))
        shell.paint(rectangle_outline(a, b, sill, top), SIDE_AXES, "cladding_grey", facing=PANEL_LIMITS.left_axis)
        for z in np.arange(sill + 0.07, top, 0.09).tolist():
            shell.line([(a, z), (b, z)], SIDE_AXES, "rail", width=0.012, facing=PANEL_LIMITS.left_axis)
        draw_on_left(shell, (a, b, sill, sill + 0.05), "trim", layer=3)
    band = rectangle_outline(space.end + 0.1, space.ahead - 0.05, sill - 0.2, sill - 0.06)
    shell.draw(band, SIDE_AXES, "#d8c41c", layer=3, facing=PANEL_LIMITS.left_axis)
    shell.paint(rectangle_outline(edge, end + 0.1, sill, top), WRAP_AXES, "cladding_grey")
    for z in np.arange(sill + 0.07, top, 0.09).tolist():
        shell.line([(edge, z), (end + 0.1, z)], WRAP_AXES, "rail", width=0.012)
    for z, lamp in ((top + 0.1, "brake_light"), (top - 0.06, "indicator_left")):
        shell.draw(rectangle_outline(edge - 0.22, edge - 0.06, z, z + 0.11), WRAP_AXES, lamp, layer=3)


def _fire_roof(space: CargoSpace, high: float) -> list[Mesh]:
    """Return a ladder over a roof at height `high`, boxes beside it, and blue lamps above the cab and at the rear."""
    out: list[Mesh] = []
    add = out.append
    top = space.shape.height
    for z in (high + 0.08, top - 0.07):
        add(box((space.end + 0.2, 0.3, z), (space.ahead + 0.9, 0.36, z + 0.07), "chrome"))
    for x in np.arange(space.end + 0.35, space.ahead + 0.8, 0.35).tolist():
        add(box((x, 0.0, top - 0.06), (x + 0.04, 0.31, top - 0.02), "chrome"))
    add(box((space.end + 0.6, 0.55, high - 0.04), (space.ahead - 0.6, space.half - 0.2, high + 0.2), "rail"))
    bar = space.ahead + 0.45 * space.shape.cab_length
    add(
        box(
            (bar - 0.15, 0.42, space.cab_height - 0.08),
            (bar + 0.15, space.half - 0.25, space.cab_height + 0.12),
            "#1b52d8",
        )
    )
    add(
        box(
            (space.end + 0.1, space.half - 0.35, high - 0.04),
            (space.end + 0.3, space.half - 0.15, high + 0.12),
            "#1b52d8",
        )
    )
    return out


def refuse_body(space: CargoSpace) -> Cargo:
    """Return a compacting body with ribs, and behind it a hopper with its lifting comb and steps."""
    rng, out = space.rng(), Cargo()
    add, half, floor = out.parts.append, space.half - 0.03, space.floor
    start, high = space.end + WORK_BODY_SIZES.hopper_m, space.shape.height - 0.12
    tower = Tower(
        Plan(half - 0.03, space.ahead, start - 0.1, 0.0, 0.0, 0.08, 0.035), floor, high - 0.08,
        edge=0.16, crown=0.05, ridge=0.6, stations=3, levels=3,
    )  # fmt: skip
    shell, _, _ = tower.surface("livery")
    draw_graphics(shell, (start + 0.3, space.ahead - 0.2), (floor + 0.3, high - 0.35), rng)
    shell.draw(rectangle_outline(-1, 99, 0, floor + 0.14), WRAP_AXES, "trim")
    add(shell.half)
    for x in (space.ahead - 0.06, start + 0.02):
        add(box((x - 0.06, half - 0.05, floor + 0.02), (x + 0.06, half + 0.012, high - 0.26), "livery"))
    _add_hopper(out, space, start, high)
    out.parts += mudguards(space)
    return out


def _add_hopper(out: Cargo, space: CargoSpace, start: float, high: float) -> None:
    """Add the hopper behind x = `start` with its top at height `high`, and record the keypoints."""
    add, half, floor = out.parts.append, space.half - 0.03, space.floor
    # The hopper's outline from its roof down the rear to the bin, and forwards under it; the opening lies between.
    roof, lip = (space.end + 0.62, high), (space.end + 0.02, floor + 0.42)
    under = max(floor - 0.14, space.shape.taillight_high + 0.09)
    cheek = [(start, high), roof, (space.end + 0.2, floor + 1.35), lip, (space.end + 0.06, under), (start, under)]
    add(prism(cheek, half, "livery", inner=half - 0.14))
    inside = half - 0.139
    add(
        prism(
            [(start, high), roof, (space.end + 0.45, high - 0.75), (start - 0.2, high - 0.75), (start, high - 0.6)],
            inside,
            "livery",
        )
    )
    add(
        prism(
            [(start, high - 0.7), (start - 0.2, high - 0.76), (start - 0.55, floor + 0.5), (start, floor)],
            inside,
            "under",
        )
    )
    add(
        prism(
            [(space.end + 0.08, floor + 0.4), (space.end + 0.1, under), (start, under), (start, floor + 0.1)],
            inside,
            "livery",
        )
    )
    add(box((space.end + 0.02, 0.0, floor + 0.36), (space.end + 0.2, inside, floor + 0.46), "rail"))
    for y in np.linspace(0.1, inside - 0.15, 5).tolist():
        add(box((space.end + 0.0, y - 0.03, floor + 0.2), (space.end + 0.09, y + 0.03, floor + 0.6), "trim"))
    _add_refuse_fittings(out, space, roof, lip, under)
    out.mark(
        np.array([roof[0], half, roof[1]]),
        np.array([space.end + 0.45, inside, high - 0.75]),
        np.array([space.end + 0.06, half, under]),
    )


def _add_refuse_fittings(
    out: Cargo, space: CargoSpace, roof: tuple[float, float], lip: tuple[float, float], under: float
) -> None:
    """Add the parts on the cheeks of a hopper.

    Args:
        out: The body to add to.
        space: The space behind the cab.
        roof: Rear edge of the roof, x and z.
        lip: Edge of the bin, x and z.
        under: Height of the lower edge.
    """
    add, half, floor, high = out.parts.append, space.half - 0.03, space.floor, roof[1]
    # Hazard stripes and lamps on the cheeks, handrails, steps and the beacon.
    for k, z in enumerate(np.linspace(floor + 0.5, floor + 1.2, 6).tolist()):
        x = float(np.interp(z, [lip[1], floor + 1.35], [lip[0], space.end + 0.2]))
        add(
            box(
                (x - 0.012, half - 0.13, z),
                (x + 0.1, half - 0.01, z + 0.115),
                GRAPHIC_COLORS[0] if k % 2 else "#f0f0ee",
            )
        )
    for z, lamp in ((high - 0.34, "brake_light"), (high - 0.5, "indicator_left")):
        x = float(np.interp(z, [floor + 1.35, high], [space.end + 0.2, roof[0]]))
        add(box((x - 0.03, half - 0.125, z), (x + 0.08, half - 0.015, z + 0.12), lamp))
    add(
        pipe(
            (space.end + 0.5, half + 0.012, floor + 0.4), (space.end + 0.62, half + 0.012, floor + 1.5), 0.02, "#e3bd1c"
        )
    )
    add(box((space.end + 0.12, half - 0.42, 0.42), (space.end + 0.5, half - 0.02, 0.47), "rail"))
    add(box((space.end + 0.42, half - 0.3, 0.45), (space.end + 0.47, half - 0.24, under), "rail"))
    add(block((roof[0] + 0.1, 0.62, high - 0.03), (roof[0] + 0.26, 0.78, space.shape.height), BEACON_COLOR, 0.05))


def hook_body(space: CargoSpace) -> Cargo:
    """Return a container with ribs, open or closed, on the rails of a hook lift with its arm behind the cab."""
    rng, out = space.rng(), Cargo()
    add, half, low = out.parts.append, space.half - 0.04, space.floor + 0.2
    room = space.shape.height - low
    high = low + float(rng.choice([0.55, 0.75, 0.96])) * room
    front = space.ahead - 0.75
    tower = Tower(
        Plan(half - 0.07, front, space.end, 0.0, 0.0, 0.04, 0.035), low, high, edge=0.03, crown=0.0, hollow=low + 0.2,
        stations=3, levels=2,
    )  # fmt: skip
    tone = ("livery", "#2f5b3c", "#24508c", "#6f3b20", "#8a8d90")[int(rng.integers(5))]
    shell, w, _ = tower.surface(tone)
    end = float(w[-1])
    shell.paint([(-99, -9), (99, -9), (99, 9), (-99, 9)], TOP_AXES, "bed", levels=(2.1, 3.0))
    for a in (0.12, 0.5):
        shell.draw(rectangle_outline(end - a - 0.05, end - a + 0.05, low + 0.06, high - 0.1), WRAP_AXES, tone, layer=5)
    shell.line([(end, low), (end, high)], WRAP_AXES, width=0.03)
    if rng.uniform() < 0.6:
        shell.draw(
            rectangle_outline(space.end + 1.0, space.end + 2.4, high - 0.75, high - 0.3),
            SIDE_AXES,
            "#e8e8e6",
            layer=0.5,
        )
    add(shell.half)
    for x in np.linspace(front - 0.06, space.end + 0.06, max(7, round((front - space.end) / 0.7))).tolist():
        add(
            prism(
                [(x - 0.06, low + 0.05), (x + 0.06, low + 0.05), (x + 0.06, high - 0.06), (x - 0.06, high - 0.06)],
                half,
                tone,
                inner=half - 0.08,
            )
        )
    for z in (low, high - 0.1):
        add(box((space.end, half - 0.1, z), (front + 0.01, half + 0.01, z + 0.12), tone))
    add(box((space.end + 0.1, 0.3, space.floor), (front + 0.3, 0.45, low + 0.01), "trim"))
    # The hook's arm before the container.
    top = min(high, low + 1.35)
    add(box((front + 0.22, 0.0, space.floor), (front + 0.42, 0.14, top), BEACON_COLOR))
    add(beam((front + 0.32, 0.0, top - 0.04), (front - 0.05, 0.0, top + 0.0), 0.12, 0.07, BEACON_COLOR))
    add(ladder(front + 0.06, (half - 0.45, half - 0.15), low + 0.1, high - 0.1, "rail"))
    out.parts += mudguards(space)
    corner = end - half + 0.07
    out.mark(
        np.array([space.end, half + 0.01, high + 0.02]),
        shell.place((corner + 0.12, high - 0.12), WRAP_AXES)[0],
        np.array([space.end, half + 0.01, low]),
    )
    return out


def skip_body(space: CargoSpace) -> Cargo:
    """Return a skip with rubble, hung on chains between the two arms that lift it."""
    rng, out = space.rng(), Cargo()
    add, half, floor = out.parts.append, space.half - 0.05, space.floor
    front, low = space.ahead - 0.5, floor + 0.1
    add(
        prism(
            [(space.end + 0.1, floor - 0.02), (front + 0.2, floor - 0.02), (front + 0.2, low), (space.end + 0.1, low)],
            half,
            "trim",
        )
    )
    base, top, tone = space.end + 0.9, low + 1.35, GRAPHIC_COLORS[int(rng.integers(len(GRAPHIC_COLORS)))]
    stop, wide = front - 0.45, half - 0.32
    hull = [
        (base + 0.35, low),
        (stop - 0.35, low),
        (stop, low + 0.75),
        (stop - 0.1, top),
        (base + 0.1, top),
        (base, low + 0.75),
    ]
    add(prism(hull, wide, tone))
    add(box((base + 0.06, 0.0, top - 0.05), (stop - 0.06, wide + 0.04, top + 0.02), tone))
    add(box((base + 0.16, 0.0, top), (stop - 0.16, wide - 0.05, top + 0.025), "under"))
    if rng.uniform() < 0.7:
        middle, reach = (base + stop) / 2, (stop - base) / 2 - 0.2
        heap = ((-1.0, 0.0), (-0.6, 0.7), (0.1, 1.0), (0.6, 0.6), (1.0, 0.0))
        add(barrel([(middle + reach * x, top, (wide - 0.1) * size**0.3, 0.3 * size) for x, size in heap], "soil"))
    # The arms, bent over the skip, and the bar between them; chains to the hull.
    knee, hand = (
        (space.end + 1.1, half - 0.09, space.shape.height - 0.12),
        (front - 0.9, half - 0.09, space.shape.height - 0.25),
    )
    add(beam((front - 0.1, half - 0.09, low), hand, 0.08, 0.1, BEACON_COLOR if tone != GRAPHIC_COLORS[3] else "rail"))
    add(beam(hand, knee, 0.08, 0.09, BEACON_COLOR if tone != GRAPHIC_COLORS[3] else "rail"))
    add(box((knee[0] - 0.08, 0.0, knee[2] - 0.08), (knee[0] + 0.08, half - 0.02, knee[2] + 0.1), "rail"))
    for x, z in ((base + 0.2, top - 0.1), (stop - 0.3, top - 0.1)):
        add(pipe((knee[0] + 0.3, half - 0.14, knee[2] - 0.02), (x, wide + 0.02, z), 0.02, "chrome", sides=6))
    # Stabilisers, and the boxes above the rear axles.
    add(box((space.end + 0.3, half - 0.3, 0.55), (space.end + 0.5, half - 0.08, floor), "rail"))
    out.parts += mudguards(space)
    out.mark(
        np.array([knee[0] - 0.08, half - 0.02, knee[2] + 0.1]),
        np.array([base + 0.06, wide + 0.04, top + 0.02]),
        np.array([space.end + 0.1, half, floor - 0.02]),
    )
    return out


def recovery_body(space: CargoSpace) -> Cargo:
    """Return a deck that slides and tilts, with low rails, a winch behind the cab, ramps and a bar of beacons."""
    out = Cargo()
    add, half, floor = out.parts.append, space.half - 0.02, space.floor
    front = space.ahead - 0.4
    deck = [
        (space.end, floor + 0.02),
        (space.end, floor + 0.1),
        (space.end + 0.5, floor + 0.16),
        (front, floor + 0.16),
        (front, floor + 0.02),
    ]
    add(prism(deck, half, "rail"))
    for start, stop in ((space.end + 0.55, front),):
        add(box((start, half - 0.09, floor + 0.155), (stop, half - 0.005, floor + 0.26), "livery"))
    for x in np.arange(space.end + 0.7, front - 0.3, 0.32).tolist():
        add(box((x, 0.35, floor + 0.155), (x + 0.1, 0.8, floor + 0.175), "trim"))
    add(box((front - 0.02, 0.0, floor + 0.1), (front + 0.14, half - 0.05, floor + 0.95), "livery"))
    add(box((front - 0.03, 0.15, floor + 0.35), (front + 0.15, half - 0.3, floor + 0.75), "trim"))
    add(pipe((front + 0.28, 0.0, floor + 0.3), (front + 0.28, 0.4, floor + 0.3), 0.16, "trim"))
    bar = space.ahead + 0.5 * space.shape.cab_length
    add(box((bar - 0.12, 0.0, space.cab_height - 0.08), (bar + 0.12, half - 0.35, space.shape.height), BEACON_COLOR))
    # Ramps, folded up at the rear; boxes for tools below the deck.
    add(box((space.end + 0.01, 0.5, floor - 0.1), (space.end + 0.08, half - 0.08, floor + 0.1), "trim"))
    chest = space.rear_axle + space.shape.wheel_radius + 0.25
    add(block((chest, half - 0.5, floor - 0.5), (chest + 0.9, half - 0.02, floor), "livery", 0.02))
    out.parts += mudguards(space)
    out.mark(
        np.array([space.end + 0.55, half - 0.005, floor + 0.26]),
        np.array([space.end + 0.5, half, floor + 0.16]),
        np.array([space.end, half, floor + 0.02]),
    )
    return out
