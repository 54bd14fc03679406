"""Tail lamps: red glass with brake light, indicator and reversing light in it."""

from typing import Final

import numpy as np

from skope.gen.vehicles.lofted_surfaces import WRAP, Surface
from skope.gen.vehicles.panels import Points, disc, grown, quad, rectangle_outline, rounded, within
from skope.types import Array

_BEYOND: Final = 99.0
"""Farther along a shell than the middle of its rear, metres."""
_RIM_WIDTH_M: Final = 0.009
"""Width of the dark rim around a tail lamp, metres."""
_RIM_SHIFT: Final = np.array([_RIM_WIDTH_M, 0.0])
_PANES: Final = {
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
"""The part of a lamp that shines: shares across from and to, up from and to."""
_SLANT: Final = {"wide": 0.035, "band": 0.02, "hook": 0.03, "slim": 0.015}
_LENS: Final = {"clear": "lamp_clear", "bar": "lamp_dark"}
"""The material around the panes. Default: red glass."""


def draw_taillight(
    shell: Surface, kind: str, along: tuple[float, float], up: tuple[float, float], points: Points
) -> None:
    """Draw a tail lamp on a shell and note its keypoints.

    Args:
        shell: What it is drawn on.
        kind: One of `VehicleStyle.taillight`.
        along: Outer and inner end, metres along the shell.
        up: From and to, metres above the road.
        points: Keypoints by stem.
    """
    lamp = _outline(kind, along, up)
    points["taillight_outer"] = shell.place((lamp[0] + lamp[3]) / 2 - _RIM_SHIFT, WRAP)[0]
    points["taillight_inner"] = shell.place((lamp[1] + lamp[2]) / 2 + _RIM_SHIFT, WRAP)[0]
    _draw_lamp(shell, kind, lamp)


def _outline(kind: str, along: tuple[float, float], up: tuple[float, float]) -> Array:
    """The lamp's corners, from its outer lower one around, metres."""
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
    slant = _SLANT.get(kind, 0.0)
    return quad(outer, inner, (low + slant, low), (high, high - slant))


def _draw_lamp(shell: Surface, kind: str, lamp: Array) -> None:
    outer, inner = lamp[0, 0], lamp[1, 0]
    low, high = lamp[:, 1].min(), lamp[:, 1].max()
    shape = rounded(lamp, 0.022)
    shell.sink(grown(shape, _RIM_WIDTH_M), WRAP, 0.006, "gap", wall="chrome")
    shell.draw(shape, WRAP, _LENS.get(kind, "taillight"))
    if kind in ("round", "rings"):
        radius = 0.4 * min(high - low, (inner - outer) / 2.2)
        for share, name in ((0.28, "brake_light"), (0.72, "indicator_left")):
            center = (outer + (inner - outer) * share, (low + high) / 2)
            shell.draw(disc(center, radius * 1.12), WRAP, "gap", layer=2)
            shell.draw(disc(center, radius), WRAP, name, layer=3)
        shell.draw(disc(center, radius * 0.45, 8), WRAP, "reverse_light", layer=4)
        return
    for name, pane in _PANES[kind].items():
        shell.draw(within(lamp, *pane), WRAP, name, layer=3)
    if kind == "hook":
        shell.draw(within(lamp, 0.06, 0.3, 0.08, 0.72), WRAP, "brake_light", layer=3)
    if kind == "band":
        shell.draw(rectangle_outline(inner, _BEYOND, high - 0.085, high - 0.02), WRAP, "gap")
        shell.draw(rectangle_outline(inner, _BEYOND, high - 0.075, high - 0.03), WRAP, "taillight", layer=2)
    if kind == "bar":
        middle = (low + high) / 2
        shell.draw(rectangle_outline(inner, _BEYOND, middle - 0.03, middle + 0.03), WRAP, "gap")
        shell.draw(rectangle_outline(inner, _BEYOND, middle - 0.018, middle + 0.018), WRAP, "taillight", layer=2)
