"""Rears of vehicles: plate in its recess, bumper, reflectors, exhausts, and tail lamps.

Tail lamps are of red glass with brake light, indicator and reversing light in it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles import parts
from skope.gen.vehicles.lofted_surfaces import FRONT_END, SIDE_START, WRAP_AXES, Surface
from skope.gen.vehicles.panels import Points, disc, grown, plate_height, quad, rectangle_outline, rounded, within
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.types import Array


@dataclass(frozen=True)
class RearSizes:
    """Sizes of parts of a rear."""

    beyond_rear_m: float = 99.0
    """Distance along a shell beyond the middle of its rear, metres."""
    rim_m: float = 0.009
    """Width of the dark rim around a tail lamp, metres."""


REAR_SIZES: Final = RearSizes()

_RIM_SHIFT: Final = np.array([REAR_SIZES.rim_m, 0.0])
LAMP_PANES: Final = {
    "wide": {
        "brake_light": (0.36, 0.97, 0.55, 0.92),
        "indicator_left": (0.34, 0.62, 0.1, 0.42),
        "reverse_light": (0.66, 0.95, 0.1, 0.42),
    },
    "tall": {
        "brake_light": (0.12, 0.9, 0.56, 0.95),
        "indicator_left": (0.12, 0.9, 0.32, 0.5),
        "reverse_light": (0.12, 0.9, 0.08, 0.26),
    },
    "band": {
        "brake_light": (0.06, 0.97, 0.6, 0.86),
        "indicator_left": (0.3, 0.7, 0.12, 0.44),
        "reverse_light": (0.74, 0.96, 0.12, 0.44),
    },
    "hook": {
        "brake_light": (0.06, 0.95, 0.72, 0.92),
        "indicator_left": (0.4, 0.9, 0.4, 0.62),
        "reverse_light": (0.4, 0.9, 0.1, 0.3),
    },
    "bar": {
        "brake_light": (0.04, 0.98, 0.3, 0.8),
        "indicator_left": (0.04, 0.4, 0.04, 0.22),
        "reverse_light": (0.5, 0.9, 0.04, 0.22),
    },
    "column": {
        "brake_light": (0.15, 0.85, 0.45, 0.97),
        "indicator_left": (0.15, 0.85, 0.22, 0.42),
        "reverse_light": (0.15, 0.85, 0.04, 0.18),
    },
    "pillar": {
        "brake_light": (0.12, 0.88, 0.5, 0.97),
        "indicator_left": (0.12, 0.88, 0.27, 0.47),
        "reverse_light": (0.12, 0.88, 0.04, 0.23),
    },
    "slim": {
        "brake_light": (0.05, 0.95, 0.5, 0.9),
        "indicator_left": (0.05, 0.5, 0.1, 0.42),
        "reverse_light": (0.55, 0.95, 0.1, 0.42),
    },
    "blade": {
        "brake_light": (0.05, 0.97, 0.6, 0.93),
        "indicator_left": (0.05, 0.45, 0.1, 0.5),
        "reverse_light": (0.5, 0.75, 0.15, 0.5),
    },
    "clear": {
        "brake_light": (0.08, 0.92, 0.6, 0.94),
        "indicator_left": (0.08, 0.5, 0.08, 0.5),
        "reverse_light": (0.55, 0.92, 0.08, 0.5),
    },
    "block": {
        "brake_light": (0.04, 0.55, 0.06, 0.94),
        "indicator_left": (0.58, 0.96, 0.52, 0.94),
        "reverse_light": (0.58, 0.96, 0.06, 0.46),
    },
}
"""Luminous parts of each kind of lamp: shares across from and to, up from and to."""
LAMP_SLANTS: Final = {"wide": 0.035, "band": 0.02, "hook": 0.03, "slim": 0.015}
LENS_MATERIALS: Final = {"clear": "lamp_clear", "bar": "lamp_dark"}
"""Material around the panes by kind of lamp. Default: red glass."""


def draw_taillight(
    shell: Surface, kind: str, along: tuple[float, float], up: tuple[float, float], points: Points
) -> None:
    """Draw a tail lamp on a shell and record its keypoints.

    Args:
        shell: The shell to draw on.
        kind: One of `VehicleStyle.taillight`.
        along: Outer and inner end, metres along the shell.
        up: From and to, metres above the road.
        points: Keypoints by stem.
    """
    lamp = _taillight_outline(kind, along, up)
    points["taillight_outer"] = shell.place((lamp[0] + lamp[3]) / 2 - _RIM_SHIFT, WRAP_AXES)[0]
    points["taillight_inner"] = shell.place((lamp[1] + lamp[2]) / 2 + _RIM_SHIFT, WRAP_AXES)[0]
    _draw_panes(shell, kind, lamp)


def _taillight_outline(kind: str, along: tuple[float, float], up: tuple[float, float]) -> Array:
    """Return the lamp's corners, from its outer lower corner around, metres."""
    (outer, inner), (low, high) = along, up
    tall = high - low
    if kind == "bar":
        return quad(outer, inner, (high - 0.5 * tall,) * 2, (high, high))
    if kind == "column":
        return quad(outer, min(inner, outer + 0.22), (low - 0.05,) * 2, (high + 0.005, high))
    if kind == "slim":
        low += 0.4 * tall
    if kind == "blade":
        return quad(outer, inner, (low, low + 0.45 * tall), (high, high - 0.1 * tall))
    slant = LAMP_SLANTS.get(kind, 0.0)
    return quad(outer, inner, (low + slant, low), (high, high - slant))


def _draw_panes(shell: Surface, kind: str, lamp: Array) -> None:
    outer, inner = lamp[0, 0], lamp[1, 0]
    low, high = lamp[:, 1].min(), lamp[:, 1].max()
    shape = rounded(lamp, 0.022)
    shell.sink(grown(shape, REAR_SIZES.rim_m), WRAP_AXES, 0.006, "gap", wall="chrome")
    shell.draw(shape, WRAP_AXES, LENS_MATERIALS.get(kind, "taillight"))
    if kind in ("round", "rings"):
        radius = 0.4 * min(high - low, (inner - outer) / 2.2)
        for share, name in ((0.28, "brake_light"), (0.72, "indicator_left")):
            center = (outer + (inner - outer) * share, (low + high) / 2)
            shell.draw(disc(center, radius * 1.12), WRAP_AXES, "gap", layer=2)
            shell.draw(disc(center, radius), WRAP_AXES, name, layer=3)
        shell.draw(disc(center, radius * 0.45, 8), WRAP_AXES, "reverse_light", layer=4)
        return
    for name, pane in LAMP_PANES[kind].items():
        shell.draw(within(lamp, *pane), WRAP_AXES, name, layer=3)
    if kind == "hook":
        shell.draw(within(lamp, 0.06, 0.3, 0.08, 0.72), WRAP_AXES, "brake_light", layer=3)
    if kind == "band":
        shell.draw(rectangle_outline(inner, REAR_SIZES.beyond_rear_m, high - 0.085, high - 0.02), WRAP_AXES, "gap")
        shell.draw(
            rectangle_outline(inner, REAR_SIZES.beyond_rear_m, high - 0.075, high - 0.03),
            WRAP_AXES,
            "taillight",
            layer=2,
        )
    if kind == "bar":
        middle = (low + high) / 2
        shell.draw(rectangle_outline(inner, REAR_SIZES.beyond_rear_m, middle - 0.03, middle + 0.03), WRAP_AXES, "gap")
        shell.draw(
            rectangle_outline(inner, REAR_SIZES.beyond_rear_m, middle - 0.018, middle + 0.018),
            WRAP_AXES,
            "taillight",
            layer=2,
        )


def draw_rear(shell: Surface, w: Array, s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Draw a rear on a shell and record its keypoints; return the parts that project from it."""
    end, last = float(w[-1]), len(w) - 1
    inner, outer = end - s.taillight_inner, float(w[last - SIDE_START + 3]) - s.taillight_wrap
    low, high = s.taillight_low, s.taillight_high
    hatch = s.deck_length < 0.3
    plate = s.taillight_low - 0.03 if hatch or s.taillight_inner < 0.45 else (low + high) / 2 - 0.06
    if style.taillight in ("tall", "round") or hatch:
        plate = max(s.clearance + 0.32, min(plate, s.taillight_low + 0.02))
    badge = plate = plate_height(min(plate, s.deck_height - 0.31))
    if style.low_plate:
        plate = plate_height(s.clearance + 0.31)
        badge = max(badge, (low + high) / 2 - 0.215)
    out = []
    if style.family == "truck":
        out.append(parts.plate(-s.length / 2 - 0.002, plate_height(low), 0.0, -1.0, style.rear_plate))
    else:
        _draw_plate(shell, end, plate, style.rear_plate)
        position = shell.place((end, badge + 0.215), WRAP_AXES)[0] * [1, 0, 1]
        out.append(parts.badge(position, 0.04 * style.badge_size, -1.0, style.badge))
    if style.family != "car" or style.taillight != "pillar":
        draw_taillight(shell, style.taillight, (outer, inner), (low, high), points)
    if style.family != "car":
        return out
    out += _draw_bumper(shell, s, style, float(w[last - FRONT_END]), end)
    for a, b in ((0.34, 0.44), (0.45, 0.5)) if s.taillight_inner > 0.55 else ():
        shell.draw(rectangle_outline(end - b, end - a, badge + 0.2, badge + 0.225), WRAP_AXES, "chrome")
    return out


def _draw_plate(shell: Surface, end: float, plate: float, material: str) -> None:
    half, high = parts.PART_SIZES.plate_m
    recess = quad(end - half - 0.07, end + 0.1, (plate - 0.03,) * 2, (plate + high + 0.04,) * 2)
    shell.sink(recess, WRAP_AXES, 0.022, "trim", wall="paint")
    shell.draw(rectangle_outline(end - half, end + 0.1, plate, plate + high), WRAP_AXES, material, layer=2)
    for a in (0.1, 0.16):
        shell.draw(
            rectangle_outline(end - a - 0.04, end - a, plate + high + 0.012, plate + high + 0.03),
            WRAP_AXES,
            "lamp_clear",
        )


def _draw_bumper(shell: Surface, s: Shape, style: VehicleStyle, corner: float, end: float) -> list[Mesh]:
    """Draw reflectors and the trim between the exhaust pipes; return the pipes."""
    low = s.clearance
    shell.draw(rectangle_outline(corner - 0.06, corner + 0.12, low + 0.2, low + 0.235), WRAP_AXES, "gap")
    shell.draw(
        rectangle_outline(corner - 0.055, corner + 0.115, low + 0.205, low + 0.23), WRAP_AXES, "taillight", layer=2
    )
    wide = end - corner - 0.1
    shell.sink(quad(end - wide, end + 0.1, (low + 0.05,) * 2, (low + 0.17,) * 2), WRAP_AXES, 0.03, "trim")
    if style.exhausts == "fins":
        for a in (0.12, 0.28, 0.44):
            shell.draw(rectangle_outline(end - a - 0.012, end - a, low + 0.05, low + 0.17), WRAP_AXES, "gap", layer=14)
    if style.exhausts == "blend":
        shell.draw(
            rectangle_outline(end - wide, end - wide + 0.16, low + 0.075, low + 0.135), WRAP_AXES, "chrome", layer=3
        )
    if style.exhausts not in ("pipes", "middle"):
        return []
    at = shell.place((end - (wide - 0.12 if style.exhausts == "pipes" else 0.07), low + 0.1), WRAP_AXES)[0]
    return [parts.exhaust(at[0] - 0.012, at[1], at[2])]
