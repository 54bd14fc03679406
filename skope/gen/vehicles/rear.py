"""The rears of vehicles: tail lamps, plate in its recess, bumper, reflectors, exhausts."""

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles import parts
from skope.gen.vehicles.lofted_surfaces import FRONT_END, SIDE_START, WRAP, Surface
from skope.gen.vehicles.panels import Points, disc, grown, plate_height, quad, rectangle, rounded, within
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.types import Array

_RIM = 0.009
"""Width of the dark rim around a tail lamp, metres."""
_BESIDE = np.array([_RIM, 0.0])
_PANES = {
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
}


def draw_rear(shell: Surface, w: Array, s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Draw a rear on a shell and note its keypoints; returns what stands out from it."""
    end, last = float(w[-1]), len(w) - 1
    inner, outer = end - s.taillight_inner, float(w[last - SIDE_START + 3]) - s.taillight_wrap
    low, high = s.taillight_low, s.taillight_high
    slant = {"wide": 0.035, "band": 0.02, "hook": 0.03}.get(style.taillight, 0.0)
    lamp = quad(outer, inner, (low + slant, low), (high, high - slant))
    points["taillight_outer"] = shell.place((lamp[0] + lamp[3]) / 2 - _BESIDE, WRAP)[0]
    points["taillight_inner"] = shell.place((lamp[1] + lamp[2]) / 2 + _BESIDE, WRAP)[0]
    hatch = s.deck_length < 0.3
    plate = s.taillight_low - 0.03 if hatch or s.taillight_inner < 0.45 else (low + high) / 2 - 0.06
    if style.taillight in ("tall", "round") or hatch:
        plate = max(s.clearance + 0.32, min(plate, s.taillight_low + 0.02))
    plate = plate_height(min(plate, s.deck_height - 0.31))
    out = []
    if style.family == "truck":
        out.append(parts.plate(-s.length / 2 - 0.002, plate_height(low), 0.0, -1.0))
    else:
        _draw_plate(shell, end, plate)
        out.append(parts.badge(shell.place((end, plate + 0.215), WRAP)[0] * [1, 0, 1], 0.04, -1.0))
    _draw_taillight(shell, style, lamp, end, (inner, outer))
    if style.family != "car":
        return out
    out += _draw_bumper(shell, s, style, float(w[last - FRONT_END]), end)
    for a, b in ((0.34, 0.44), (0.45, 0.5)) if s.taillight_inner > 0.55 else ():
        shell.draw(rectangle(end - b, end - a, plate + 0.2, plate + 0.225), WRAP, "chrome")
    return out


def _draw_plate(shell: Surface, end: float, plate: float) -> None:
    half, high = parts.PLATE
    recess = quad(end - half - 0.07, end + 0.1, (plate - 0.03,) * 2, (plate + high + 0.04,) * 2)
    shell.sink(recess, WRAP, 0.022, "trim", wall="paint")
    shell.draw(rectangle(end - half, end + 0.1, plate, plate + high), WRAP, "plate", layer=2)
    for a in (0.1, 0.16):
        shell.draw(rectangle(end - a - 0.04, end - a, plate + high + 0.012, plate + high + 0.03), WRAP, "lamp_clear")


def _draw_taillight(shell: Surface, style: VehicleStyle, lamp: Array, end: float, span: tuple[float, float]) -> None:
    inner, outer = span
    low, high = lamp[:, 1].min(), lamp[:, 1].max()
    shape = rounded(lamp, 0.022)
    shell.sink(grown(shape, _RIM), WRAP, 0.006, "gap", wall="chrome")
    shell.draw(shape, WRAP, "taillight")
    if style.taillight == "round":
        radius = 0.4 * min(high - low, (inner - outer) / 2.2)
        for share, name in ((0.28, "brake_light"), (0.72, "indicator_left")):
            center = (outer + (inner - outer) * share, (low + high) / 2)
            shell.draw(disc(center, radius * 1.12), WRAP, "gap", layer=2)
            shell.draw(disc(center, radius), WRAP, name, layer=3)
        shell.draw(disc(center, radius * 0.45, 8), WRAP, "reverse_light", layer=4)
        return
    for name, pane in _PANES[style.taillight].items():
        shell.draw(within(lamp, *pane), WRAP, name, layer=3)
    if style.taillight == "hook":
        shell.draw(within(lamp, 0.06, 0.3, 0.08, 0.72), WRAP, "brake_light", layer=3)
    if style.taillight == "band":
        shell.draw(rectangle(inner, end + 0.1, high - 0.085, high - 0.02), WRAP, "gap")
        shell.draw(rectangle(inner, end + 0.1, high - 0.075, high - 0.03), WRAP, "taillight", layer=2)


def _draw_bumper(shell: Surface, s: Shape, style: VehicleStyle, corner: float, end: float) -> list[Mesh]:
    """Reflectors, the trim between the pipes, and the pipes."""
    low = s.clearance
    shell.draw(rectangle(corner - 0.06, corner + 0.12, low + 0.2, low + 0.235), WRAP, "gap")
    shell.draw(rectangle(corner - 0.055, corner + 0.115, low + 0.205, low + 0.23), WRAP, "taillight", layer=2)
    wide = end - corner - 0.1
    shell.sink(quad(end - wide, end + 0.1, (low + 0.05,) * 2, (low + 0.17,) * 2), WRAP, 0.03, "trim")
    if style.exhausts == "fins":
        for a in (0.12, 0.28, 0.44):
            shell.draw(rectangle(end - a - 0.012, end - a, low + 0.05, low + 0.17), WRAP, "gap", layer=14)
    if style.exhausts == "blend":
        shell.draw(rectangle(end - wide, end - wide + 0.16, low + 0.075, low + 0.135), WRAP, "chrome", layer=3)
    if style.exhausts != "pipes":
        return []
    at = shell.place((end - wide + 0.12, low + 0.1), WRAP)[0]
    return [parts.exhaust(at[0] - 0.012, at[1], at[2])]
