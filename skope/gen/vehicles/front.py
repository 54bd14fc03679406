"""The fronts of vehicles: grilles and intakes with depth, fog lamps, plate and logo, beside the headlights."""

from typing import Final

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles import parts
from skope.gen.vehicles.headlights import draw_headlight
from skope.gen.vehicles.lofted_surfaces import FRONT_END, SIDE_START, WRAP, Surface
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

_LOGO: Final = 0.042
"""Radius of the logo, metres."""
_PATTERN: Final = {
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
_SLOTS: Final = {
    "split": [((0.035, 0.0), (0.0, 0.62))],
    "blocks": [((0.06, 0.0), (0.0, 0.5)), ((0.03, 0.5), (-0.02, 1.0))],
    "kidneys": [((0.025, 0.0), (0.0, 0.4))],
}
"""Grilles of several openings: where those on the left begin and end, metres and shares of the way to the lamp."""


def draw_front(shell: Surface, w: Array, s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Draw a front on a shell and note its keypoints; returns what stands out from it."""
    inner, outer = s.headlight_inner, float(w[SIDE_START - 3]) + s.headlight_wrap
    low, high = s.headlight_low, s.headlight_high
    wide = float(w[FRONT_END])
    room = low - s.clearance - 0.09
    intake = (s.clearance + 0.09, s.clearance + 0.09 + 0.56 * room)
    plate = plate_height(intake[0] + 0.03 if style.intake in ("wide", "triple", "deep") else intake[1] + 0.02)
    plate = _stepped(plate, style.plate_steps, s.clearance + 0.06, (low + high) / 2 - 0.05)
    logo = shell.place((0.0, (low + high) / 2), WRAP)[0] * [1, 0, 1]
    # Hung before anything is sunk: in front of the skin, not in an intake.
    hung = (
        [parts.plate(*_plate_place(shell, plate, bent=style.soft_seams), 1.0, style.front_plate)]
        if style.front_plate
        else []
    )
    _draw_grille(shell, s, style, intake[1])
    _draw_intake(shell, s, style, intake, wide)
    draw_headlight(shell, style.headlight, (inner, outer), (low, high), intake[1], points)
    points["front_logo"] = np.add(logo, [0.009, 0, 0])
    return [parts.badge(logo, _LOGO * style.badge_size, 1.0, style.badge), *hung]


def _stepped(plate: float, steps: int, low: float, high: float) -> float:
    """A plate's height some places above its usual one, where it stays between two heights there, metres."""
    moved = plate + steps * parts.PLATE_STEP
    return moved if low <= moved <= high - parts.PLATE[1] else plate


def _plate_place(shell: Surface, plate: float, *, bent: bool) -> tuple[float, float, float]:
    """Place of a number plate at a front: x of its lower edge, height, how far it leans back.

    `bent`: the front may stand out between the plate's edges.
    """
    _, high = parts.PLATE
    (low_x, *_), (high_x, *_) = (shell.place((0.0, plate + z), WRAP)[0] for z in (0.0, high))
    tilt = float(np.clip(low_x - high_x, 0.0, 0.03))
    ahead = max(float(low_x), float(high_x))
    for share in np.linspace(0.1, 0.9, 9).tolist() if bent else ():
        ahead = max(ahead, float(shell.place((0.0, plate + share * high), WRAP)[0][0]) + share * tilt)
    return ahead + 0.002, plate, tilt


def _draw_grille(shell: Surface, s: Shape, style: VehicleStyle, intake: float) -> None:
    """The upper grille between the headlights, sunk behind its frame."""
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
    pattern = _PATTERN.get(style.grille, "")
    frame = style.grille_frame or ("chrome" if style.chrome else "trim")
    if style.grille in outlines:
        outline = mirrored(outlines[style.grille])
        shell.paint(grown(outline, 0.015), WRAP, frame)
        if style.grille == "panel":
            shell.draw(outline, WRAP, "lamp_dark", layer=1)
        else:
            shell.sink(outline, WRAP, 0.03, pattern, wall="gap")
        if style.grille == "bar":
            middle = (bottom + top) / 2
            shell.draw(rectangle_outline(-edge, edge, middle - 0.028, middle + 0.028), WRAP, "chrome", layer=9)
        if style.grille == "slim":
            shell.draw(rectangle_outline(-edge, edge, top - 0.072, top - 0.06), WRAP, "chrome", layer=9)
        if style.grille == "double":
            shell.draw(rectangle_outline(-edge, edge, top - 0.06, top - 0.02), WRAP, "gap", layer=1)
    elif style.grille in _SLOTS:
        for start, end in _SLOTS[style.grille]:
            a, b = (start[0] + start[1] * edge, end[0] + end[1] * edge)
            deep = 0.5 * (bottom - intake) if style.grille == "kidneys" else 0.04
            outline = quad(a, b, (bottom - deep, bottom - deep + 0.03), (top, top - 0.02))
            shell.paint(grown(outline, 0.012), WRAP, style.grille_frame or "chrome")
            shell.sink(outline, WRAP, 0.03, pattern, wall="chrome" if style.chrome else "gap")
    elif style.grille == "strip":
        shell.draw(rectangle_outline(-edge, edge, top - 0.055, top - 0.01), WRAP, "lamp_dark", layer=1)
        shell.draw(rectangle_outline(-edge, edge, top - 0.042, top - 0.022), WRAP, "daylight", layer=2)
    elif style.grille == "closed":
        # A closed nose: a glossy band between the lamps.
        shell.draw(rectangle_outline(-edge, edge, top - 0.05, top - 0.015), WRAP, "gap", layer=1)


def _draw_intake(shell: Surface, s: Shape, style: VehicleStyle, z: tuple[float, float], wide: float) -> None:
    """Draw the air intakes of the front bumper, the fog lamps, and the lip below."""
    low, high = z
    if style.intake == "wide":
        shell.sink(mirrored([(wide - 0.16, low), (wide - 0.1, high - 0.03)]), WRAP, 0.04, "grille_slats", wall="trim")
        pocket = quad(wide - 0.04, wide + 0.15, (low + 0.02, low + 0.05), (high - 0.02, high - 0.01))
        _draw_fog_lamp(shell, rounded(pocket, 0.03), (wide + 0.06, (low + high) / 2))
    elif style.intake == "triple":
        shell.sink(mirrored([(0.3, low), (0.36, high - 0.04)]), WRAP, 0.04, "grille_mesh", wall="trim")
        pocket = quad(wide - 0.16, wide + 0.14, (low, low + 0.03), (high - 0.06, high + 0.05))
        shell.sink(pocket, WRAP, 0.04, "grille_mesh", wall="gap")
        shell.draw(within(pocket, 0.06, 0.94, 0.86, 0.97), WRAP, "lamp_clear", layer=12)
    elif style.intake == "deep":
        shell.sink(mirrored([(wide - 0.05, low - 0.01), (wide - 0.12, high)]), WRAP, 0.05, "grille_mesh", wall="trim")
        shell.draw(rectangle_outline(-wide, wide, low - 0.045, low - 0.02), WRAP, "rail")
    elif style.intake == "slot":
        shell.sink(mirrored([(wide - 0.05, low + 0.01), (wide - 0.1, low + 0.09)]), WRAP, 0.03, "grille_slats")
        blade = quad(wide + 0.02, wide + 0.05, (low + 0.03, low + 0.05), (high + 0.03, high + 0.04))
        shell.draw(grown(blade, 0.018), WRAP, "trim")
        shell.draw(blade, WRAP, "lamp_clear", layer=2)
    elif style.intake == "skid":
        shell.sink(mirrored([(wide - 0.2, low + 0.07), (wide - 0.12, high)]), WRAP, 0.04, "grille_mesh", wall="trim")
        shell.draw(mirrored([(0.3, low - 0.03), (0.36, low + 0.06)]), WRAP, "rail", layer=2)
        pocket = quad(wide - 0.02, wide + 0.14, (low + 0.06, low + 0.08), (high + 0.02, high))
        _draw_fog_lamp(shell, rounded(pocket, 0.03), (wide + 0.06, (low + high) / 2 + 0.04))
    elif style.intake == "corners":
        shell.sink(mirrored([(wide - 0.22, low), (wide - 0.28, low + 0.1)]), WRAP, 0.03, "grille_mesh", wall="trim")
        pocket = quad(wide + 0.0, wide + 0.1, (low + 0.02, low + 0.03), (high + 0.05, high + 0.07))
        shell.sink(pocket, WRAP, 0.04, "gap", wall="gap")
    elif style.intake == "mouth":
        shell.paint(mirrored([(wide + 0.08, low - 0.03), (wide + 0.02, high + 0.05)]), WRAP, "trim")
        shell.sink(mirrored([(wide - 0.14, low), (wide - 0.22, high + 0.02)]), WRAP, 0.04, "grille_mesh", wall="gap")
        _draw_fog_lamp(shell, disc((wide - 0.02, (low + high) / 2), 0.055, 8), (wide - 0.02, (low + high) / 2))
    else:
        shell.draw(rectangle_outline(-0.1, wide - 0.1, low, high - 0.04), WRAP, "gap")
        _draw_fog_lamp(
            shell, rectangle_outline(wide - 0.02, wide + 0.12, low, high - 0.04), (wide + 0.05, (low + high) / 2 - 0.02)
        )


def _draw_fog_lamp(shell: Surface, pocket: Array, lamp: tuple[float, float]) -> None:
    shell.sink(pocket, WRAP, 0.025, "trim")
    shell.draw(disc(lamp, 0.042, 8), WRAP, "chrome", layer=2)
    shell.draw(disc(lamp, 0.032, 8), WRAP, "lamp_clear", layer=3)
