"""Bodies of lorries that change what they carry: hook lifts with containers, skip loaders, decks that carry cars."""

import numpy as np

from skope.gen.mesh import box
from skope.gen.vehicles.cargo import BEACON, Cargo, CargoSpace, mudguards
from skope.gen.vehicles.liveries import TONES
from skope.gen.vehicles.lofted_surfaces import SIDE, TOP, WRAP, Plan
from skope.gen.vehicles.panels import rectangle_outline
from skope.gen.vehicles.parts import block
from skope.gen.vehicles.solids import barrel, beam, ladder, pipe, prism
from skope.gen.vehicles.upright_shells import Tower


def hook_body(space: CargoSpace) -> Cargo:
    """A container with ribs, open or closed above, on the rails of a hook lift whose arm stands behind the cab."""
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
    shell.paint([(-99, -9), (99, -9), (99, 9), (-99, 9)], TOP, "bed", levels=(2.1, 3.0))
    for a in (0.12, 0.5):
        shell.draw(rectangle_outline(end - a - 0.05, end - a + 0.05, low + 0.06, high - 0.1), WRAP, tone, layer=5)
    shell.line([(end, low), (end, high)], WRAP, width=0.03)
    if rng.uniform() < 0.6:
        shell.draw(
            rectangle_outline(space.end + 1.0, space.end + 2.4, high - 0.75, high - 0.3), SIDE, "#e8e8e6", layer=0.5
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
    add(box((front + 0.22, 0.0, space.floor), (front + 0.42, 0.14, top), BEACON))
    add(beam((front + 0.32, 0.0, top - 0.04), (front - 0.05, 0.0, top + 0.0), 0.12, 0.07, BEACON))
    add(ladder(front + 0.06, (half - 0.45, half - 0.15), low + 0.1, high - 0.1, "rail"))
    out.parts += mudguards(space)
    corner = end - half + 0.07
    out.mark(
        np.array([space.end, half + 0.01, high + 0.02]),
        shell.place((corner + 0.12, high - 0.12), WRAP)[0],
        np.array([space.end, half + 0.01, low]),
    )
    return out


def skip_body(space: CargoSpace) -> Cargo:
    """A skip between the two arms that lift it, hung on chains, with rubble in it."""
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
    base, top, tone = space.end + 0.9, low + 1.35, TONES[int(rng.integers(len(TONES)))]
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
    # The arms, bent over the skip, and the bar across between them; chains to the hull.
    knee, hand = (
        (space.end + 1.1, half - 0.09, space.shape.height - 0.12),
        (front - 0.9, half - 0.09, space.shape.height - 0.25),
    )
    add(beam((front - 0.1, half - 0.09, low), hand, 0.08, 0.1, BEACON if tone != TONES[3] else "rail"))
    add(beam(hand, knee, 0.08, 0.09, BEACON if tone != TONES[3] else "rail"))
    add(box((knee[0] - 0.08, 0.0, knee[2] - 0.08), (knee[0] + 0.08, half - 0.02, knee[2] + 0.1), "rail"))
    for x, z in ((base + 0.2, top - 0.1), (stop - 0.3, top - 0.1)):
        add(pipe((knee[0] + 0.3, half - 0.14, knee[2] - 0.02), (x, wide + 0.02, z), 0.02, "chrome", sides=6))
    # Stabilisers, and the boxes over the rear axles.
    add(box((space.end + 0.3, half - 0.3, 0.55), (space.end + 0.5, half - 0.08, floor), "rail"))
    out.parts += mudguards(space)
    out.mark(
        np.array([knee[0] - 0.08, half - 0.02, knee[2] + 0.1]),
        np.array([base + 0.06, wide + 0.04, top + 0.02]),
        np.array([space.end + 0.1, half, floor - 0.02]),
    )
    return out


def recovery_body(space: CargoSpace) -> Cargo:
    """A deck that slides and tilts, low rails along it, a winch behind the cab, ramps and a bar of beacons."""
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
    add(box((bar - 0.12, 0.0, space.cab_height - 0.08), (bar + 0.12, half - 0.35, space.shape.height), BEACON))
    # Ramps, folded up behind; boxes for tools below the deck.
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
