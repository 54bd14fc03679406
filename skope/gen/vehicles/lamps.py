"""Lamps, grilles and plates: what is drawn on the front and rear of a shell, in metres along its outline."""

import numpy as np
from numpy.typing import NDArray

from skope.gen.vehicles.loft import SIDE_START, WRAP, Surface, rounded
from skope.gen.vehicles.shape import Shape, Style

Array = NDArray[np.float64]

Points = dict[str, Array]


def _quad(a: float, b: float, low: tuple[float, float], high: tuple[float, float]) -> Array:
    return np.array([(a, low[0]), (b, low[1]), (b, high[1]), (a, high[0])])


def _grown(quad: Array, edge: float) -> Array:
    center = quad.mean(axis=0)
    return np.asarray(quad + np.sign(quad - center) * edge)


def _between(quad: Array, start: float, end: float, low: float = 0.0, high: float = 1.0) -> Array:
    """Part of a quad by shares across and up."""
    bottom, top = quad[[0, 1]], quad[[3, 2]]

    def at(u: float, v: float) -> Array:
        return np.asarray((1 - v) * (bottom[0] + u * (bottom[1] - bottom[0])) + v * (top[0] + u * (top[1] - top[0])))

    return np.array([at(start, low), at(end, low), at(end, high), at(start, high)])


def draw_front(shell: Surface, w: Array, s: Shape, style: Style, points: Points) -> None:
    """Grille, intake, headlights with indicators, plate and logo."""
    inner = s.headlight_inner
    outer = float(w[SIDE_START - 3]) + s.headlight_wrap
    low, high = s.headlight_low, s.headlight_high
    tall = high - low
    intake = (s.clearance + 0.09, s.clearance + 0.09 + 0.58 * (low - s.clearance - 0.09))
    wide = w[SIDE_START - 6]
    shell.paint(_quad(-0.1, wide - 0.02, (intake[0],) * 2, (intake[1], intake[1] - 0.03)), WRAP, "trim")
    shell.paint(_quad(-0.1, wide - 0.1, (intake[0] + 0.03,) * 2, (intake[1] - 0.02, intake[1] - 0.05)), WRAP, "grille")
    fog = np.array(
        [
            (wide - 0.02, intake[0] + 0.03),
            (wide + 0.13, intake[0] + 0.05),
            (wide + 0.1, intake[1]),
            (wide - 0.02, intake[1]),
        ]
    )
    shell.paint(fog, WRAP, "trim")
    shell.paint(_grown(fog, -0.035), WRAP, "lamp_clear")
    _grille(shell, s, style, inner, intake[1])
    rise = {"swept": 0.05, "slim": 0.025}.get(style.headlight, 0.0)
    lamp = _quad(inner, outer, (low, low + rise), (high - rise * 0.8, high + rise * 0.3))
    if style.headlight == "round":
        radius = tall * 0.62
        center = np.array([(inner + outer) / 2, (low + high) / 2])
        angle = np.linspace(0, 2 * np.pi, 13)[:-1]
        disc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        inner, outer = center[0] - radius, center[0] + radius
        shell.paint(center + disc * (radius + 0.02), WRAP, "chrome")
        shell.paint(center + disc * radius, WRAP, "lamp_clear")
        shell.paint(center + disc * radius * 0.62, WRAP, "headlight")
        side = _quad(center[0] + radius * 0.2, outer + 0.05, (low - 0.13,) * 2, (low - 0.08,) * 2)
        shell.paint(rounded(side, 0.02), WRAP, "indicator_left")
        lamp = np.array([(inner, center[1]), (outer, center[1])])
    else:
        shape = lamp
        shell.paint(_grown(lamp, 0.012), WRAP, "trim")
        shell.paint(shape, WRAP, "lamp_clear")
        for start, end in ((0.08, 0.34), (0.4, 0.66)) if style.headlight != "slim" else ((0.05, 0.62),):
            shell.paint(_between(lamp, start, end, 0.16, 0.84), WRAP, "headlight")
        strip = (0.74, 0.97, 0.12, 0.88) if style.headlight != "slim" else (0.68, 0.97, 0.2, 0.8)
        shell.paint(_between(lamp, *strip), WRAP, "indicator_left")
        lamp = np.array([(lamp[0] + lamp[3]) / 2, (lamp[1] + lamp[2]) / 2])
    plate = (intake[1] + 0.005, intake[1] + 0.115) if style.grille in ("closed", "slim", "split") else None
    low_plate = plate or (intake[0] + 0.06, intake[0] + 0.17)
    shell.paint(_quad(-0.1, 0.27, (low_plate[0] - 0.01,) * 2, (low_plate[1] + 0.01,) * 2), WRAP, "trim")
    shell.paint(_quad(-0.1, 0.26, (low_plate[0],) * 2, (low_plate[1],) * 2), WRAP, "plate")
    logo = (low + high) / 2
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    shell.paint(np.stack([0.055 * np.cos(angle), logo + 0.055 * np.sin(angle)], axis=-1), WRAP, "chrome")
    points["front_logo"] = shell.nearest((0.0, logo), WRAP) * [1, 0, 1]
    points["headlight_inner"], points["headlight_outer"] = (shell.nearest(p, WRAP) for p in lamp)


def _grille(shell: Surface, s: Shape, style: Style, inner: float, low: float) -> None:
    """The upper grille between the headlights."""
    bottom, top = s.headlight_low, s.headlight_high
    edge = inner - 0.035
    outlines = {
        "wide": [(-edge, top - 0.02), (edge, top - 0.02), (edge - 0.03, bottom - 0.01), (-edge + 0.03, bottom - 0.01)],
        "shield": [
            (-edge, top),
            (edge, top),
            (edge, bottom),
            (edge * 0.62, low + 0.03),
            (-edge * 0.62, low + 0.03),
            (-edge, bottom),
        ],
        "slim": [(-edge, top - 0.03), (edge, top - 0.03), (edge, top - 0.08), (-edge, top - 0.08)],
        "split": [(0.03, top - 0.01), (edge, top - 0.01), (edge - 0.05, bottom - 0.04), (0.03, bottom - 0.04)],
    }
    if style.grille not in outlines:
        return
    outline = np.array(outlines[style.grille])
    shell.paint(_grown(outline, 0.014), WRAP, "chrome")
    shell.paint(outline, WRAP, "grille")
    floor, ceiling = outline[:, 1].min(), outline[:, 1].max()
    if style.grille == "split":
        return
    for z in np.arange(floor + 0.05, ceiling - 0.02, 0.055):
        reach = edge * (0.93 if z > bottom else 0.6)
        shell.paint(
            [(-reach, z), (reach, z), (reach, z + 0.012), (-reach, z + 0.012)],
            WRAP,
            "trim" if style.grille == "shield" else "chrome",
        )


def draw_rear(shell: Surface, w: Array, s: Shape, style: Style, points: Points) -> None:
    """Taillights with brake, indicator and reversing panes, plate, reflectors and lower trim."""
    end = float(w[-1])
    inner, outer = end - s.taillight_inner, float(w[len(w) - 1 - SIDE_START + 3]) - s.taillight_wrap
    low, high = s.taillight_low, s.taillight_high
    slant = {"wide": 0.03, "band": 0.02}.get(style.taillight, 0.0)
    lamp = _quad(outer, inner, (low + slant, low), (high, high - slant))
    edge = "trim"
    if style.taillight == "round":
        shell.paint(_grown(lamp, 0.01), WRAP, edge)
        shell.paint(lamp, WRAP, "taillight")
        width, height = inner - outer, high - low
        angle = np.linspace(0, 2 * np.pi, 9)[:-1]
        disc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        radius = 0.4 * min(height, width / 2.2)
        for share, name in ((0.27, "brake_light"), (0.73, "indicator_left")):
            shell.paint([outer + width * share, (low + high) / 2] + disc * radius, WRAP, name)
        shell.paint([outer + width * 0.73, (low + high) / 2] + disc * radius * 0.4, WRAP, "reverse_light")
    else:
        shell.paint(_grown(lamp, 0.01), WRAP, edge)
        shell.paint(lamp, WRAP, "taillight")
        panes = {
            "tall": {
                "brake_light": (0.1, 0.9, 0.62, 0.95),
                "indicator_left": (0.1, 0.9, 0.36, 0.56),
                "reverse_light": (0.1, 0.9, 0.12, 0.3),
            },
        }.get(
            style.taillight,
            {
                "brake_light": (0.3, 0.95, 0.52, 0.9),
                "indicator_left": (0.3, 0.62, 0.12, 0.42),
                "reverse_light": (0.66, 0.95, 0.12, 0.42),
            },
        )
        for name, pane in panes.items():
            shell.paint(_between(lamp, *pane), WRAP, name)
    if style.taillight == "band":
        shell.paint(_quad(inner, end + 0.1, (high - 0.07,) * 2, (high - 0.025,) * 2), WRAP, "taillight")
    hatch = s.deck_length < 0.3
    plate = s.taillight_low - 0.03 if hatch or s.taillight_inner < 0.45 else (low + high) / 2 - 0.06
    if style.taillight in ("tall", "round") or hatch:
        plate = max(s.clearance + 0.32, min(plate, s.taillight_low + 0.02))
    plate = min(plate, s.deck_height - 0.31)
    shell.paint(_quad(end - 0.3, end + 0.1, (plate - 0.03,) * 2, (plate + 0.15,) * 2), WRAP, "trim")
    shell.paint(_quad(end - 0.26, end + 0.1, (plate,) * 2, (plate + 0.11,) * 2), WRAP, "plate")
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    badge = np.stack([end + 0.05 * np.cos(angle), plate + 0.21 + 0.05 * np.sin(angle)], axis=-1)
    shell.paint(badge, WRAP, "chrome")
    corner = float(w[len(w) - 1 - SIDE_START + 6])
    reflector = _quad(corner - 0.05, corner + 0.12, (s.clearance + 0.2,) * 2, (s.clearance + 0.235,) * 2)
    shell.paint(reflector, WRAP, "taillight")
    points["taillight_outer"] = shell.nearest((lamp[0] + lamp[3]) / 2, WRAP)
    points["taillight_inner"] = shell.nearest((lamp[1] + lamp[2]) / 2, WRAP)
