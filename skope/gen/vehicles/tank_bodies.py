"""Round cargo bodies: tanks for liquids, and concrete mixers."""

import numpy as np

from skope.gen.mesh import Mesh, box
from skope.gen.vehicles import parts
from skope.gen.vehicles.cargo import Cargo, CargoSpace, mudguards
from skope.gen.vehicles.liveries import TONES
from skope.gen.vehicles.solids import barrel, beam, ladder, pipe, prism, ring


def tank_body(space: CargoSpace) -> Cargo:
    """An elliptical tank on saddles, with bands, a walkway with lids on top, hose trays, a cabinet and a ladder."""
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
        out.parts.append(_band(x, z, half + 0.012, high + 0.012, square))
    tone = TONES[int(rng.integers(len(TONES)))]
    if rng.uniform() < 0.6:
        # A stripe at half height, where the side is upright.
        out.parts.append(box((rear + 0.1, half - 0.05, z - 0.12), (front - 0.1, half + 0.008, z + 0.12), tone))
    _tank_fittings(out, space, (rear, front), z, (half, high))
    end = ring(rear, z, half, high, square=square)
    inner = ring(rear - 0.06, z, 0.86 * half, 0.86 * high, square=square)
    out.mark(end[9], inner[9], end[3])
    return out


def _band(x: float, z: float, half: float, high: float, square: float) -> Mesh:
    wide = 0.03
    return barrel(
        [(x - wide, z, half - 0.02, high - 0.02), (x - wide, z, half, high), (x + wide, z, half, high),
         (x + wide, z, half - 0.02, high - 0.02)],
        "rail", square=square, sharp=True,
    )  # fmt: skip


def _tank_fittings(
    out: Cargo, space: CargoSpace, along: tuple[float, float], z: float, size: tuple[float, float]
) -> None:
    """Fittings around a tank."""
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
    # The walkway, its lids, and the rail along it.
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
    """A drum for concrete that leans back, between its pedestals, with hopper, chute, water tank and ladder."""
    s, rng, out = space.shape, space.rng(), Cargo()
    add, front, rear = out.parts.append, space.ahead - 0.75, space.end + 1.05
    length, top = front - rear, s.height
    widest = min(space.half - 0.1, (top - space.floor) * 0.44)
    base = space.floor + 0.16 + widest

    def section(share: float, radius: float) -> tuple[float, float, float, float]:
        return front - share * length, base + 0.42 * (share - 0.36), radius, radius

    profile = [(1.0, 0.0), (1.0, 0.5), (0.97, 0.52), (0.55, 1.0), (0.36, 1.0), (0.08, 0.72), (0.0, 0.6), (-0.02, 0.0)]
    tone = TONES[int(rng.integers(len(TONES)))]
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
    # Pedestals: a wall ahead, a leaning frame behind; a roller under the drum's ring.
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
    # The hopper over the mouth, and the chute that is folded up behind.
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
    # The end of the frame, which carries the lamps.
    add(box((space.end + 0.04, 0.0, low - 0.22), (rear + 0.2, space.half - 0.12, low + 0.02), "trim"))
    out.parts += mudguards(space)
    out.mark(
        np.array([rear - 0.5, 0.55, top]),
        np.array([rear - 0.5, 0.55, top - 0.42]),
        np.array([space.end + 0.04, space.half - 0.12, low - 0.22]),
    )
    return out
