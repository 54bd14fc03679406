"""Headlights: lenses behind clear glass, strips of daytime light, indicators."""

from typing import Final

import numpy as np

from skope.gen.vehicles.lofted_surfaces import WRAP, Surface
from skope.gen.vehicles.panels import Points, disc, grown, quad, rectangle_outline, rounded, within
from skope.types import Array

_RIM_WIDTH_M: Final = 0.009
"""Width of the dark rim around a headlight, metres."""
_RIM_SHIFT: Final = np.array([_RIM_WIDTH_M, 0.0])
_DARK_KINDS: Final = frozenset(("swept", "hook", "slim", "narrow", "blade", "pixel", "split"))
"""Kinds with a dark housing."""
_LENSES: Final[dict[str, tuple[tuple[float, float], ...]]] = {
    "slim": ((0.2, 0.52), (0.42, 0.52)),
    "drop": ((0.4, 0.52),),
    "twin": ((0.22, 0.52), (0.6, 0.52)),
    "narrow": ((0.2, 0.55), (0.4, 0.55), (0.6, 0.55)),
    "blade": ((0.35, 0.5), (0.6, 0.5)),
    "tall": ((0.45, 0.3), (0.45, 0.7)),
    "split": (),
    "pixel": (),
}
"""Places of the lenses, shares across and up; of kinds that are not listed (0.24, 0.52) and (0.5, 0.52)."""
_STRIPS: Final[dict[str, tuple[tuple[float, float, float, float], ...]]] = {
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
"""Strips of daytime light: shares across from and to, up from and to."""
_AMBER: Final = {
    "swept": (0.72, 0.95, 0.3, 0.82),
    "slim": (0.72, 0.96, 0.2, 0.7),
    "drop": (0.72, 0.92, 0.25, 0.75),
    "narrow": (0.76, 0.97, 0.4, 0.9),
    "blade": (0.76, 0.97, 0.2, 0.7),
    "tall": (0.72, 0.93, 0.12, 0.5),
    "split": (0.8, 0.97, 0.15, 0.85),
}
"""The indicator, as the strips."""


def draw_headlight(
    shell: Surface, kind: str, along: tuple[float, float], up: tuple[float, float], below: float, points: Points
) -> None:
    """Draw a headlight on a shell and note its keypoints.

    Args:
        shell: What it is drawn on.
        kind: One of `VehicleStyle.headlight`.
        along: From and to, metres along the shell.
        up: From and to, metres above the road.
        below: Height above the road down to which a lamp's lower half may reach, metres.
        points: Keypoints by stem.
    """
    if kind in ("round", "ring"):
        _draw_round(shell, along, up, kind == "ring", points)
    else:
        _draw_lamp(shell, kind, along, up, below, points)


def _draw_lamp(
    shell: Surface, kind: str, along: tuple[float, float], up: tuple[float, float], below: float, points: Points
) -> None:
    """A lamp behind clear glass: lenses, a strip of daytime light, an indicator."""
    lamp, tall = _outline(kind, along, up)
    inner, outer = lamp[0, 0], lamp[1, 0]
    shape = rounded(lamp, 0.045 if kind == "drop" else 0.02)
    points["headlight_inner"] = shell.place((lamp[0] + lamp[3]) / 2 - _RIM_SHIFT, WRAP)[0]
    points["headlight_outer"] = shell.place((lamp[1] + lamp[2]) / 2 + _RIM_SHIFT, WRAP)[0]
    shell.sink(grown(shape, _RIM_WIDTH_M), WRAP, 0.014, "trim", wall="trim")
    shell.draw(shape, WRAP, "lamp_dark" if kind in _DARK_KINDS else "lamp_clear")
    radius = min(0.34 * tall, 0.085 * (outer - inner) + 0.01)
    for across, upward in _LENSES.get(kind, ((0.24, 0.52), (0.5, 0.52))):
        center = within(lamp, across, across, upward, upward)[0]
        shell.draw(disc(center, radius * 1.3), WRAP, "chrome", layer=2)
        shell.draw(disc(center, radius), WRAP, "headlight", layer=3)
    if kind == "pixel":
        for across, upward in ((0.1, 0.12), (0.1, 0.56), (0.42, 0.12), (0.42, 0.56)):
            shell.draw(within(lamp, across, across + 0.26, upward, upward + 0.32), WRAP, "headlight", layer=3)
    for strip in _STRIPS.get(kind, ()):
        shell.draw(within(lamp, *strip), WRAP, "daylight", layer=4)
    shell.draw(within(lamp, *_AMBER.get(kind, (0.78, 0.96, 0.12, 0.8))), WRAP, "indicator_left", layer=2)
    if kind == "split":
        _draw_lower_lamp(shell, (inner + 0.5 * (outer - inner), outer - 0.06), (below + 0.015, lamp[0, 1] - 0.035))


def _outline(kind: str, along: tuple[float, float], up: tuple[float, float]) -> tuple[Array, float]:
    """The lamp's corners, from its inner lower one around, and the height that its lenses have; metres."""
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
    """The main lamp in the bumper below a strip of daytime light."""
    (inner, outer), (low, high) = along, up
    low = min(low, high - 0.06)
    pocket = quad(inner, outer, (low, low + 0.01), (high, high + 0.01))
    radius = min(0.3 * (high - low), 0.16 * (outer - inner))
    shell.draw(grown(pocket, 0.008), WRAP, "lamp_dark", layer=14)
    for share in (0.28, 0.72):
        center = within(pocket, share, share, 0.5, 0.5)[0]
        shell.draw(disc(center, 1.3 * radius), WRAP, "chrome", layer=15)
        shell.draw(disc(center, radius), WRAP, "headlight", layer=16)


def _draw_round(
    shell: Surface, along: tuple[float, float], up: tuple[float, float], ring: bool, points: Points
) -> None:
    (inner, outer), (low, high) = along, up
    radius = (high - low) * 0.62
    center, reach = np.array([(inner + outer) / 2, (low + high) / 2]), np.array([radius, 0])
    points["headlight_inner"] = shell.place(center - reach, WRAP)[0]
    points["headlight_outer"] = shell.place(center + reach, WRAP)[0]
    shell.sink(disc(center, radius, 12), WRAP, 0.02, "chrome", wall="chrome")
    shell.draw(disc(center, radius - 0.016, 12), WRAP, "daylight" if ring else "lamp_dark")
    if ring:
        shell.draw(disc(center, radius - 0.034, 12), WRAP, "lamp_dark", layer=1.5)
    shell.draw(disc(center, radius * 0.66, 12), WRAP, "headlight", layer=2)
    shell.draw(disc(center, radius * 0.3, 8), WRAP, "lamp_clear", layer=3)
    side = rounded(rectangle_outline(center[0] + radius * 0.1, center[0] + radius * 1.1, low - 0.13, low - 0.07), 0.02)
    shell.draw(side, WRAP, "indicator_left")
