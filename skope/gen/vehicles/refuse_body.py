"""Refuse collectors: a compacting body, and behind it a hopper that is loaded from the rear."""

from typing import Final

import numpy as np

from skope.gen.mesh import box
from skope.gen.vehicles.cargo import BEACON, Cargo, CargoSpace, mudguards
from skope.gen.vehicles.liveries import TONES, draw_graphics
from skope.gen.vehicles.lofted_surfaces import WRAP, Plan
from skope.gen.vehicles.panels import rectangle_outline
from skope.gen.vehicles.parts import block
from skope.gen.vehicles.solids import pipe, prism
from skope.gen.vehicles.upright_shells import Tower

_HOPPER: Final = 1.55
"""Length of a hopper, metres."""


def refuse_body(space: CargoSpace) -> Cargo:
    """A compacting body with ribs, and behind it a hopper: cheeks, the bin's edge, the comb that lifts, steps."""
    rng, out = space.rng(), Cargo()
    add, half, floor = out.parts.append, space.half - 0.03, space.floor
    start, high = space.end + _HOPPER, space.shape.height - 0.12
    tower = Tower(
        Plan(half - 0.03, space.ahead, start - 0.1, 0.0, 0.0, 0.08, 0.035), floor, high - 0.08,
        edge=0.16, crown=0.05, ridge=0.6, stations=3, levels=3,
    )  # fmt: skip
    shell, _, _ = tower.surface("livery")
    draw_graphics(shell, (start + 0.3, space.ahead - 0.2), (floor + 0.3, high - 0.35), rng)
    shell.draw(rectangle_outline(-1, 99, 0, floor + 0.14), WRAP, "trim")
    add(shell.half)
    for x in (space.ahead - 0.06, start + 0.02):
        add(box((x - 0.06, half - 0.05, floor + 0.02), (x + 0.06, half + 0.012, high - 0.26), "livery"))
    _add_hopper(out, space, start, high)
    out.parts += mudguards(space)
    return out


def _add_hopper(out: Cargo, space: CargoSpace, start: float, high: float) -> None:
    """Add the hopper behind x = `start`, `high` over the road, and note the keypoints."""
    add, half, floor = out.parts.append, space.half - 0.03, space.floor
    # The hopper's outline from its roof down the back to the bin, and forward under it; the opening lies between.
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
    _add_fittings(out, space, roof, lip, under)
    out.mark(
        np.array([roof[0], half, roof[1]]),
        np.array([space.end + 0.45, inside, high - 0.75]),
        np.array([space.end + 0.06, half, under]),
    )


def _add_fittings(
    out: Cargo, space: CargoSpace, roof: tuple[float, float], lip: tuple[float, float], under: float
) -> None:
    """Add what a hopper has on its cheeks, between the roof's rear edge and the bin's `lip`, and below: x, z."""
    add, half, floor, high = out.parts.append, space.half - 0.03, space.floor, roof[1]
    # Hazard stripes and lamps on the cheeks, rails to hold on to, steps to stand on, the beacon.
    for k, z in enumerate(np.linspace(floor + 0.5, floor + 1.2, 6).tolist()):
        x = float(np.interp(z, [lip[1], floor + 1.35], [lip[0], space.end + 0.2]))
        add(box((x - 0.012, half - 0.13, z), (x + 0.1, half - 0.01, z + 0.115), TONES[0] if k % 2 else "#f0f0ee"))
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
    add(block((roof[0] + 0.1, 0.62, high - 0.03), (roof[0] + 0.26, 0.78, space.shape.height), BEACON, 0.05))
