"""The fronts of vehicles: grilles and intakes with depth, headlights, fog lamps, plate and logo."""

from typing import Final

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles import parts
from skope.gen.vehicles.lofted_surfaces import FRONT_END, SIDE_START, WRAP, Surface
from skope.gen.vehicles.panels import Points, disc, grown, mirrored, plate_height, quad, rectangle, rounded, within
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.types import Array

_LOGO: Final = 0.042
"""Radius of the logo, metres."""
_RIM: Final = 0.009
"""Width of the dark rim around a headlight, metres."""
_BESIDE: Final = np.array([_RIM, 0.0])
_PATTERN: Final = {
    "wide": "grille_slats",
    "shield": "grille_mesh",
    "slim": "grille_mesh",
    "split": "grille_bars",
    "hexagon": "grille_mesh",
    "oval": "grille_mesh",
    "bar": "grille_slats",
    "blocks": "grille_bars",
}


def draw_front(shell: Surface, w: Array, s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Draw a front on a shell and note its keypoints; returns what stands out from it."""
    inner, outer = s.headlight_inner, float(w[SIDE_START - 3]) + s.headlight_wrap
    low, high = s.headlight_low, s.headlight_high
    wide = float(w[FRONT_END])
    room = low - s.clearance - 0.09
    intake = (s.clearance + 0.09, s.clearance + 0.09 + 0.56 * room)
    plate = plate_height(intake[0] + 0.03 if style.intake in ("wide", "triple", "deep") else intake[1] + 0.02)
    hung = parts.plate(*_plate_place(shell, plate), 1.0)
    logo = shell.place((0.0, (low + high) / 2), WRAP)[0] * [1, 0, 1]
    _draw_grille(shell, s, style, intake[1])
    _draw_intake(shell, s, style, intake, wide)
    if style.headlight == "round":
        _draw_round_headlight(shell, inner, outer, low, high, points)
    else:
        _draw_headlight(shell, style.headlight, (inner, outer), (low, high), points)
    points["front_logo"] = np.add(logo, [0.009, 0, 0])
    return [parts.badge(logo, _LOGO, 1.0), hung]


def _plate_place(shell: Surface, plate: float) -> tuple[float, float, float]:
    """Place of a number plate at a front: x of its lower edge, height, how far it leans back."""
    _, high = parts.PLATE
    (low_x, *_), (high_x, *_) = (shell.place((0.0, plate + z), WRAP)[0] for z in (0.0, high))
    return max(float(low_x), float(high_x)) + 0.002, plate, float(np.clip(low_x - high_x, 0.0, 0.03))


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
    }
    pattern = _PATTERN.get(style.grille, "")
    if style.grille in outlines:
        outline = mirrored(outlines[style.grille])
        shell.paint(grown(outline, 0.015), WRAP, "chrome" if style.chrome else "trim")
        shell.sink(outline, WRAP, 0.03, pattern, wall="gap")
        if style.grille == "bar":
            middle = (bottom + top) / 2
            shell.draw(rectangle(-edge, edge, middle - 0.028, middle + 0.028), WRAP, "chrome", layer=9)
        if style.grille == "slim":
            shell.draw(rectangle(-edge, edge, top - 0.072, top - 0.06), WRAP, "chrome", layer=9)
    elif style.grille in ("split", "blocks"):
        slots = {"split": [(0.035, 0.62 * edge)], "blocks": [(0.06, 0.5 * edge), (0.5 * edge + 0.03, edge - 0.02)]}
        for a, b in slots[style.grille]:
            outline = quad(a, b, (bottom - 0.04, bottom - 0.01), (top, top - 0.02))
            shell.paint(grown(outline, 0.012), WRAP, "chrome")
            shell.sink(outline, WRAP, 0.03, pattern, wall="chrome" if style.chrome else "gap")
    else:
        # A closed nose: a glossy band between the lamps.
        shell.draw(rectangle(-edge, edge, top - 0.05, top - 0.015), WRAP, "gap", layer=1)


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
        shell.draw(rectangle(-wide, wide, low - 0.045, low - 0.02), WRAP, "rail")
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
    else:
        shell.draw(rectangle(-0.1, wide - 0.1, low, high - 0.04), WRAP, "gap")
        _draw_fog_lamp(
            shell, rectangle(wide - 0.02, wide + 0.12, low, high - 0.04), (wide + 0.05, (low + high) / 2 - 0.02)
        )


def _draw_fog_lamp(shell: Surface, pocket: Array, lamp: tuple[float, float]) -> None:
    shell.sink(pocket, WRAP, 0.025, "trim")
    shell.draw(disc(lamp, 0.042, 8), WRAP, "chrome", layer=2)
    shell.draw(disc(lamp, 0.032, 8), WRAP, "lamp_clear", layer=3)


def _draw_headlight(
    shell: Surface, kind: str, along: tuple[float, float], up: tuple[float, float], points: Points
) -> None:
    """A lamp behind clear glass: lenses, a strip of daytime light, an indicator."""
    (inner, outer), (low, high) = along, up
    rise = {"swept": 0.055, "hook": 0.04, "slim": 0.03, "drop": 0.09}.get(kind, 0.0)
    if kind == "slim":
        low += 0.35 * (high - low)
    lamp = quad(inner, outer, (low, low + rise), (high - rise * 0.8, high + rise * 0.3))
    shape = rounded(lamp, 0.045 if kind == "drop" else 0.02)
    points["headlight_inner"] = shell.place((lamp[0] + lamp[3]) / 2 - _BESIDE, WRAP)[0]
    points["headlight_outer"] = shell.place((lamp[1] + lamp[2]) / 2 + _BESIDE, WRAP)[0]
    shell.sink(grown(shape, _RIM), WRAP, 0.014, "trim", wall="trim")
    shell.draw(shape, WRAP, "lamp_dark" if kind in ("swept", "hook", "slim") else "lamp_clear")
    radius = min(0.34 * (high - low - 0.4 * rise), 0.085 * (outer - inner) + 0.01)
    for share in {"slim": (0.2, 0.42), "drop": (0.4,), "twin": (0.22, 0.6)}.get(kind, (0.24, 0.5)):
        center = within(lamp, share, share, 0.52, 0.52)[0]
        shell.draw(disc(center, radius * 1.3), WRAP, "chrome", layer=2)
        shell.draw(disc(center, radius), WRAP, "headlight", layer=3)
    strips = {
        "swept": [(0.04, 0.86, 0.05, 0.17)],
        "hook": [(0.03, 0.86, 0.84, 0.95), (0.03, 0.08, 0.1, 0.84)],
        "slim": [(0.03, 0.8, 0.78, 0.95)],
        "box": [(0.05, 0.74, 0.82, 0.94)],
        "drop": [(0.08, 0.7, 0.08, 0.2)],
    }
    for strip in strips.get(kind, []):
        shell.draw(within(lamp, *strip), WRAP, "daylight", layer=4)
    amber = {"swept": (0.72, 0.95, 0.3, 0.82), "slim": (0.72, 0.96, 0.2, 0.7), "drop": (0.72, 0.92, 0.25, 0.75)}
    shell.draw(within(lamp, *amber.get(kind, (0.78, 0.96, 0.12, 0.8))), WRAP, "indicator_left", layer=2)


def _draw_round_headlight(shell: Surface, inner: float, outer: float, low: float, high: float, points: Points) -> None:
    radius = (high - low) * 0.62
    center, reach = np.array([(inner + outer) / 2, (low + high) / 2]), np.array([radius, 0])
    points["headlight_inner"] = shell.place(center - reach, WRAP)[0]
    points["headlight_outer"] = shell.place(center + reach, WRAP)[0]
    shell.sink(disc(center, radius, 12), WRAP, 0.02, "chrome", wall="chrome")
    shell.draw(disc(center, radius - 0.016, 12), WRAP, "lamp_dark")
    shell.draw(disc(center, radius * 0.66, 12), WRAP, "headlight", layer=2)
    shell.draw(disc(center, radius * 0.3, 8), WRAP, "lamp_clear", layer=3)
    side = rounded(rectangle(center[0] + radius * 0.1, center[0] + radius * 1.1, low - 0.13, low - 0.07), 0.02)
    shell.draw(side, WRAP, "indicator_left")
