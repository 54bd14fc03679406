"""Fronts of vehicles.

They have grilles and intakes with depth, fog lamps, a plate and a logo. Headlights have lenses behind clear glass,
daytime light strips and indicators.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles import parts
from skope.gen.vehicles.lofted_surfaces import FRONT_END, SIDE_START, WRAP_AXES, Surface
from skope.gen.vehicles.panels import (
    Points,
    disc,
    grown,
    mirrored,
    plate_height,
    quad,
    rectangle_outline,
    rounded,
    within,
)
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.types import Array


@dataclass(frozen=True)
class FrontSizes:
    """Sizes of parts of a front."""

    rim_m: float = 0.009
    """Width of the dark rim around a headlight, metres."""
    logo_radius_m: float = 0.042
    """Radius of the logo, metres."""


FRONT_SIZES: Final = FrontSizes()

_RIM_SHIFT: Final = np.array([FRONT_SIZES.rim_m, 0.0])
_DARK_KINDS: Final = frozenset(("swept", "hook", "slim", "narrow", "blade", "pixel", "split"))
"""Kinds of headlights with a dark housing."""
LENS_PLACES: Final[dict[str, tuple[tuple[float, float], ...]]] = {
    "slim": ((0.2, 0.52), (0.42, 0.52)),
    "drop": ((0.4, 0.52),),
    "twin": ((0.22, 0.52), (0.6, 0.52)),
    "narrow": ((0.2, 0.55), (0.4, 0.55), (0.6, 0.55)),
    "blade": ((0.35, 0.5), (0.6, 0.5)),
    "tall": ((0.45, 0.3), (0.45, 0.7)),
    "split": (),
    "pixel": (),
}
"""Positions of the lenses by kind, shares across and up. Other kinds have (0.24, 0.52) and (0.5, 0.52)."""
LIGHT_STRIPS: Final[dict[str, tuple[tuple[float, float, float, float], ...]]] = {
    "swept": ((0.04, 0.86, 0.05, 0.17),),
    "hook": ((0.03, 0.86, 0.84, 0.95), (0.03, 0.08, 0.1, 0.84)),
    "slim": ((0.03, 0.8, 0.78, 0.95),),
    "box": ((0.05, 0.74, 0.82, 0.94),),
    "drop": ((0.08, 0.7, 0.08, 0.2),),
    "narrow": ((0.03, 0.84, 0.05, 0.3),),
    "blade": ((0.03, 0.97, 0.8, 0.97),),
    "tall": ((0.05, 0.14, 0.08, 0.92),),
    "split": ((0.03, 0.78, 0.25, 0.8),),
}
"""Daytime light strips by kind: shares across from and to, up from and to."""
INDICATOR_PARTS: Final = {
    "swept": (0.72, 0.95, 0.3, 0.82),
    "slim": (0.72, 0.96, 0.2, 0.7),
    "drop": (0.72, 0.92, 0.25, 0.75),
    "narrow": (0.76, 0.97, 0.4, 0.9),
    "blade": (0.76, 0.97, 0.2, 0.7),
    "tall": (0.72, 0.93, 0.12, 0.5),
    "split": (0.8, 0.97, 0.15, 0.85),
}
"""Indicators by kind, in the form of `LIGHT_STRIPS`."""


def draw_headlight(
    shell: Surface, kind: str, along: tuple[float, float], up: tuple[float, float], below: float, points: Points
) -> None:
    """Draw a headlight on a shell and record its keypoints.

    Args:
        shell: The shell to draw on.
        kind: One of `VehicleStyle.headlight`.
        along: From and to, metres along the shell.
        up: From and to, metres above the road.
        below: Minimum height of a lamp's lower half above the road, metres.
        points: Keypoints by stem.
    """
    if kind in ("round", "ring"):
        _draw_round(shell, along, up, kind == "ring", points)
    else:
        _draw_lenses(shell, kind, along, up, below, points)


def _draw_lenses(
    shell: Surface, kind: str, along: tuple[float, float], up: tuple[float, float], below: float, points: Points
) -> None:
    """Draw a lamp behind clear glass: lenses, a daytime light strip, an indicator."""
    lamp, tall = _headlight_outline(kind, along, up)
    inner, outer = lamp[0, 0], lamp[1, 0]
    shape = rounded(lamp, 0.045 if kind == "drop" else 0.02)
    points["headlight_inner"] = shell.place((lamp[0] + lamp[3]) / 2 - _RIM_SHIFT, WRAP_AXES)[0]
    points["headlight_outer"] = shell.place((lamp[1] + lamp[2]) / 2 + _RIM_SHIFT, WRAP_AXES)[0]
    shell.sink(grown(shape, FRONT_SIZES.rim_m), WRAP_AXES, 0.014, "trim", wall="trim")
    shell.draw(shape, WRAP_AXES, "lamp_dark" if kind in _DARK_KINDS else "lamp_clear")
    radius = min(0.34 * tall, 0.085 * (outer - inner) + 0.01)
    for across, upward in LENS_PLACES.get(kind, ((0.24, 0.52), (0.5, 0.52))):
        center = within(lamp, across, across, upward, upward)[0]
        shell.draw(disc(center, radius * 1.3), WRAP_AXES, "chrome", layer=2)
        shell.draw(disc(center, radius), WRAP_AXES, "headlight", layer=3)
    if kind == "pixel":
        for across, upward in ((0.1, 0.12), (0.1, 0.56), (0.42, 0.12), (0.42, 0.56)):
            shell.draw(within(lamp, across, across + 0.26, upward, upward + 0.32), WRAP_AXES, "headlight", layer=3)
    for strip in LIGHT_STRIPS.get(kind, ()):
        shell.draw(within(lamp, *strip), WRAP_AXES, "daylight", layer=4)
    shell.draw(within(lamp, *INDICATOR_PARTS.get(kind, (0.78, 0.96, 0.12, 0.8))), WRAP_AXES, "indicator_left", layer=2)
    if kind == "split":
        _draw_lower_lamp(shell, (inner + 0.5 * (outer - inner), outer - 0.06), (below + 0.015, lamp[0, 1] - 0.035))


def _headlight_outline(kind: str, along: tuple[float, float], up: tuple[float, float]) -> tuple[Array, float]:
    """Return the lamp's corners, from its inner lower corner around, and the height of its lenses, metres."""
    (inner, outer), (low, high) = along, up
    tall = high - low
    if kind == "blade":
        return quad(
            inner, outer + 0.03, (low + 0.4 * tall, low + 0.2 * tall), (high - 0.12 * tall, high + 0.035)
        ), 0.6 * tall
    if kind == "tall":
        start = max(inner, outer - 0.3)
        return quad(start, outer, (low - 0.09, low - 0.06), (high - 0.01, high + 0.01)), 0.35 * tall
    if kind == "pixel":
        return quad(max(inner, outer - 0.36), outer, (low, low + 0.01), (high, high)), tall
    rise = {"swept": 0.055, "hook": 0.04, "slim": 0.03, "drop": 0.09, "narrow": 0.02, "split": 0.015}.get(kind, 0.0)
    low += {"slim": 0.35, "narrow": 0.5, "split": 0.52}.get(kind, 0.0) * tall
    return quad(inner, outer, (low, low + rise), (high - rise * 0.8, high + rise * 0.3)), high - low - 0.4 * rise


def _draw_lower_lamp(shell: Surface, along: tuple[float, float], up: tuple[float, float]) -> None:
    """Draw the main lamp in the bumper below a daytime light strip."""
    (inner, outer), (low, high) = along, up
    low = min(low, high - 0.06)
    pocket = quad(inner, outer, (low, low + 0.01), (high, high + 0.01))
    radius = min(0.3 * (high - low), 0.16 * (outer - inner))
    shell.draw(grown(pocket, 0.008), WRAP_AXES, "lamp_dark", layer=14)
    for share in (0.28, 0.72):
        center = within(pocket, share, share, 0.5, 0.5)[0]
        shell.draw(disc(center, 1.3 * radius), WRAP_AXES, "chrome", layer=15)
        shell.draw(disc(center, radius), WRAP_AXES, "headlight", layer=16)


def _draw_round(
    shell: Surface, along: tuple[float, float], up: tuple[float, float], ring: bool, points: Points
) -> None:
    (inner, outer), (low, high) = along, up
    radius = (high - low) * 0.62
    center, reach = np.array([(inner + outer) / 2, (low + high) / 2]), np.array([radius, 0])
    points["headlight_inner"] = shell.place(center - reach, WRAP_AXES)[0]
    points["headlight_outer"] = shell.place(center + reach, WRAP_AXES)[0]
    shell.sink(disc(center, radius, 12), WRAP_AXES, 0.02, "chrome", wall="chrome")
    shell.draw(disc(center, radius - 0.016, 12), WRAP_AXES, "daylight" if ring else "lamp_dark")
    if ring:
        shell.draw(disc(center, radius - 0.034, 12), WRAP_AXES, "lamp_dark", layer=1.5)
    shell.draw(disc(center, radius * 0.66, 12), WRAP_AXES, "headlight", layer=2)
    shell.draw(disc(center, radius * 0.3, 8), WRAP_AXES, "lamp_clear", layer=3)
    side = rounded(rectangle_outline(center[0] + radius * 0.1, center[0] + radius * 1.1, low - 0.13, low - 0.07), 0.02)
    shell.draw(side, WRAP_AXES, "indicator_left")


_GRILLE_PATTERNS: Final = {
    "wide": "grille_slats",
    "shield": "grille_mesh",
    "slim": "grille_mesh",
    "split": "grille_bars",
    "hexagon": "grille_mesh",
    "oval": "grille_mesh",
    "bar": "grille_slats",
    "blocks": "grille_bars",
    "frame": "grille_mesh",
    "kidneys": "grille_bars",
    "tall": "grille_slats",
    "double": "grille_slats",
}
_GRILLE_SLOTS: Final = {
    "split": [((0.035, 0.0), (0.0, 0.62))],
    "blocks": [((0.06, 0.0), (0.0, 0.5)), ((0.03, 0.5), (-0.02, 1.0))],
    "kidneys": [((0.025, 0.0), (0.0, 0.4))],
}
"""Grilles with several openings: start and end of those on the left, in metres and shares of the distance to the
lamp."""


def draw_front(shell: Surface, w: Array, s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Draw a front on a shell and record its keypoints; return the parts that project from it."""
    inner, outer = s.headlight_inner, float(w[SIDE_START - 3]) + s.headlight_wrap
    low, high = s.headlight_low, s.headlight_high
    wide = float(w[FRONT_END])
    room = low - s.clearance - 0.09
    intake = (s.clearance + 0.09, s.clearance + 0.09 + 0.56 * room)
    plate = plate_height(intake[0] + 0.03 if style.intake in ("wide", "triple", "deep") else intake[1] + 0.02)
    plate = _stepped(plate, style.plate_steps, s.clearance + 0.06, (low + high) / 2 - 0.05)
    logo = shell.place((0.0, (low + high) / 2), WRAP_AXES)[0] * [1, 0, 1]
    # The plate is placed before anything is sunk, so that it is in front of the skin and not in an intake.
    hung = (
        [parts.plate(*_plate_position(shell, plate, bent=style.soft_seams), 1.0, style.front_plate)]
        if style.front_plate
        else []
    )
    _draw_grille(shell, s, style, intake[1])
    _draw_intake(shell, s, style, intake, wide)
    draw_headlight(shell, style.headlight, (inner, outer), (low, high), intake[1], points)
    points["front_logo"] = np.add(logo, [0.009, 0, 0])
    return [parts.badge(logo, FRONT_SIZES.logo_radius_m * style.badge_size, 1.0, style.badge), *hung]


def _stepped(plate: float, steps: int, low: float, high: float) -> float:
    """Return a plate's height `steps` places above its usual height, limited to `low` to `high`, metres."""
    moved = plate + steps * parts.PART_SIZES.plate_step_m
    return moved if low <= moved <= high - parts.PART_SIZES.plate_m[1] else plate


def _plate_position(shell: Surface, plate: float, *, bent: bool) -> tuple[float, float, float]:
    """Return the position of a number plate at a front: x of its lower edge, its height, and its backward lean.

    With `bent`, the front may project between the plate's edges.
    """
    _, high = parts.PART_SIZES.plate_m
    (low_x, *_), (high_x, *_) = (shell.place((0.0, plate + z), WRAP_AXES)[0] for z in (0.0, high))
    tilt = float(np.clip(low_x - high_x, 0.0, 0.03))
    ahead = max(float(low_x), float(high_x))
    for share in np.linspace(0.1, 0.9, 9).tolist() if bent else ():
        ahead = max(ahead, float(shell.place((0.0, plate + share * high), WRAP_AXES)[0][0]) + share * tilt)
    return ahead + 0.002, plate, tilt


def _draw_grille(shell: Surface, s: Shape, style: VehicleStyle, intake: float) -> None:
    """Draw the upper grille between the headlights, sunk behind its frame."""
    bottom, top, edge = s.headlight_low, s.headlight_high, s.headlight_inner - 0.03
    tall = top - bottom
    outlines = {
        "wide": [(edge - 0.05, bottom - 0.02), (edge, top - 0.02)],
        "shield": [(edge * 0.5, intake + 0.03), (edge * 0.82, bottom - 0.02), (edge * 0.7, top)],
        "slim": [(edge - 0.015, top - 0.1), (edge, top - 0.035)],
        "hexagon": [(edge * 0.62, intake + 0.03), (edge * 0.88, bottom + 0.02), (edge * 0.7, top - 0.05)],
        "oval": [
            (edge * 0.38, bottom - 0.06),
            (edge * 0.64, bottom - 0.02),
            (edge * 0.72, bottom + 0.3 * tall),
            (edge * 0.64, bottom + 0.72 * tall),
            (edge * 0.4, top - 0.01),
        ],
        "bar": [(edge - 0.01, bottom - 0.1), (edge, bottom), (edge, top - 0.01)],
        "frame": [(edge * 0.55, intake - 0.08), (edge * 0.86, bottom + 0.25 * tall), (edge * 0.8, top - 0.005)],
        "tall": [(edge * 0.3, intake - 0.06), (edge * 0.42, bottom + 0.3 * tall), (edge * 0.34, top)],
        "double": [(edge * 0.86, bottom - 0.11), (edge * 0.92, bottom - 0.03)],
        "panel": [(edge - 0.05, bottom - 0.07), (edge, bottom + 0.3 * tall), (edge, top - 0.01)],
    }
    pattern = _GRILLE_PATTERNS.get(style.grille, "")
    frame = style.grille_frame or ("chrome" if style.chrome else "trim")
    if style.grille in outlines:
        outline = mirrored(outlines[style.grille])
        shell.paint(grown(outline, 0.015), WRAP_AXES, frame)
        if style.grille == "panel":
            shell.draw(outline, WRAP_AXES, "lamp_dark", layer=1)
        else:
            shell.sink(outline, WRAP_AXES, 0.03, pattern, wall="gap")
        if style.grille == "bar":
            middle = (bottom + top) / 2
            shell.draw(rectangle_outline(-edge, edge, middle - 0.028, middle + 0.028), WRAP_AXES, "chrome", layer=9)
        if style.grille == "slim":
            shell.draw(rectangle_outline(-edge, edge, top - 0.072, top - 0.06), WRAP_AXES, "chrome", layer=9)
        if style.grille == "double":
            shell.draw(rectangle_outline(-edge, edge, top - 0.06, top - 0.02), WRAP_AXES, "gap", layer=1)
    elif style.grille in _GRILLE_SLOTS:
        for start, end in _GRILLE_SLOTS[style.grille]:
            a, b = (start[0] + start[1] * edge, end[0] + end[1] * edge)
            deep = 0.5 * (bottom - intake) if style.grille == "kidneys" else 0.04
            outline = quad(a, b, (bottom - deep, bottom - deep + 0.03), (top, top - 0.02))
            shell.paint(grown(outline, 0.012), WRAP_AXES, style.grille_frame or "chrome")
            shell.sink(outline, WRAP_AXES, 0.03, pattern, wall="chrome" if style.chrome else "gap")
    elif style.grille == "strip":
        shell.draw(rectangle_outline(-edge, edge, top - 0.055, top - 0.01), WRAP_AXES, "lamp_dark", layer=1)
        shell.draw(rectangle_outline(-edge, edge, top - 0.042, top - 0.022), WRAP_AXES, "daylight", layer=2)
    elif style.grille == "closed":
        # A closed nose has a glossy band between the lamps.
        shell.draw(rectangle_outline(-edge, edge, top - 0.05, top - 0.015), WRAP_AXES, "gap", layer=1)


def _draw_intake(shell: Surface, s: Shape, style: VehicleStyle, z: tuple[float, float], wide: float) -> None:
    """Draw the air intakes of the front bumper, the fog lamps, and the lip below."""
    low, high = z
    if style.intake == "wide":
        shell.sink(
            mirrored([(wide - 0.16, low), (wide - 0.1, high - 0.03)]), WRAP_AXES, 0.04, "grille_slats", wall="trim"
        )
        pocket = quad(wide - 0.04, wide + 0.15, (low + 0.02, low + 0.05), (high - 0.02, high - 0.01))
        _draw_fog_lamp(shell, rounded(pocket, 0.03), (wide + 0.06, (low + high) / 2))
    elif style.intake == "triple":
        shell.sink(mirrored([(0.3, low), (0.36, high - 0.04)]), WRAP_AXES, 0.04, "grille_mesh", wall="trim")
        pocket = quad(wide - 0.16, wide + 0.14, (low, low + 0.03), (high - 0.06, high + 0.05))
        shell.sink(pocket, WRAP_AXES, 0.04, "grille_mesh", wall="gap")
        shell.draw(within(pocket, 0.06, 0.94, 0.86, 0.97), WRAP_AXES, "lamp_clear", layer=12)
    elif style.intake == "deep":
        shell.sink(
            mirrored([(wide - 0.05, low - 0.01), (wide - 0.12, high)]), WRAP_AXES, 0.05, "grille_mesh", wall="trim"
        )
        shell.draw(rectangle_outline(-wide, wide, low - 0.045, low - 0.02), WRAP_AXES, "rail")
    elif style.intake == "slot":
        shell.sink(mirrored([(wide - 0.05, low + 0.01), (wide - 0.1, low + 0.09)]), WRAP_AXES, 0.03, "grille_slats")
        blade = quad(wide + 0.02, wide + 0.05, (low + 0.03, low + 0.05), (high + 0.03, high + 0.04))
        shell.draw(grown(blade, 0.018), WRAP_AXES, "trim")
        shell.draw(blade, WRAP_AXES, "lamp_clear", layer=2)
    elif style.intake == "skid":
        shell.sink(
            mirrored([(wide - 0.2, low + 0.07), (wide - 0.12, high)]), WRAP_AXES, 0.04, "grille_mesh", wall="trim"
        )
        shell.draw(mirrored([(0.3, low - 0.03), (0.36, low + 0.06)]), WRAP_AXES, "rail", layer=2)
        pocket = quad(wide - 0.02, wide + 0.14, (low + 0.06, low + 0.08), (high + 0.02, high))
        _draw_fog_lamp(shell, rounded(pocket, 0.03), (wide + 0.06, (low + high) / 2 + 0.04))
    elif style.intake == "corners":
        shell.sink(
            mirrored([(wide - 0.22, low), (wide - 0.28, low + 0.1)]), WRAP_AXES, 0.03, "grille_mesh", wall="trim"
        )
        pocket = quad(wide + 0.0, wide + 0.1, (low + 0.02, low + 0.03), (high + 0.05, high + 0.07))
        shell.sink(pocket, WRAP_AXES, 0.04, "gap", wall="gap")
    elif style.intake == "mouth":
        shell.paint(mirrored([(wide + 0.08, low - 0.03), (wide + 0.02, high + 0.05)]), WRAP_AXES, "trim")
        shell.sink(
            mirrored([(wide - 0.14, low), (wide - 0.22, high + 0.02)]), WRAP_AXES, 0.04, "grille_mesh", wall="gap"
        )
        _draw_fog_lamp(shell, disc((wide - 0.02, (low + high) / 2), 0.055, 8), (wide - 0.02, (low + high) / 2))
    else:
        shell.draw(rectangle_outline(-0.1, wide - 0.1, low, high - 0.04), WRAP_AXES, "gap")
        _draw_fog_lamp(
            shell, rectangle_outline(wide - 0.02, wide + 0.12, low, high - 0.04), (wide + 0.05, (low + high) / 2 - 0.02)
        )


def _draw_fog_lamp(shell: Surface, pocket: Array, lamp: tuple[float, float]) -> None:
    shell.sink(pocket, WRAP_AXES, 0.025, "trim")
    shell.draw(disc(lamp, 0.042, 8), WRAP_AXES, "chrome", layer=2)
    shell.draw(disc(lamp, 0.032, 8), WRAP_AXES, "lamp_clear", layer=3)
