"""Large graphics on the sides of heavy bodies: bands, slants, panels, discs and rows of blocks as long as names."""

from typing import Final

import numpy as np

from skope.gen.vehicles.body_axes import LEFT_AXIS
from skope.gen.vehicles.decals import draw_letters
from skope.gen.vehicles.lofted_surfaces import SIDE, WRAP, Surface
from skope.gen.vehicles.panels import disc, rectangle_outline

TONES: Final = (
    "#b8202a", "#1f4e96", "#1d7a46", "#e07b18", "#e8e8e6", "#23262b", "#e3bd1c", "#5b2c83", "#1b8ca0", "#7a1f2e",
    "#9aa0a6", "#274b3a",
)  # fmt: skip
"""Colours of the graphics."""
MARKER: Final = "marker_amber"
"""Material of marker lamps along the sides, which burn with the headlights."""
FRONT_MARKER: Final = "marker_white"
REAR_MARKER: Final = "marker_red"
"""Materials of the marker lamps at the upper edges of vehicles wider than `MARKED_FROM_M`, after UNECE R48."""
MARKED_FROM_M: Final = 2.1
_PLAIN: Final = 0.2
"""Share of bodies without graphics."""


def draw_graphics(
    shell: Surface, along: tuple[float, float], up: tuple[float, float], rng: np.random.Generator
) -> None:
    """Draw graphics on the side of a shell between two x, rear and front, and two heights; some stay plain."""
    if rng.uniform() < _PLAIN:
        return
    rear, front = along
    low, high = up
    tall, length = high - low, front - rear
    first, second = (TONES[k] for k in rng.choice(len(TONES), 2, replace=False))
    kind = ("band", "slant", "panel", "disc", "name", "half")[int(rng.integers(6))]
    if kind == "band":
        at = low + rng.uniform(0.15, 0.55) * tall
        wide = rng.uniform(0.12, 0.3) * tall
        _fill(shell, rectangle_outline(rear, front, at, at + wide), first, 2)
        _fill(shell, rectangle_outline(rear, front, at - 0.3 * wide, at - 0.08 * wide), second, 2)
    elif kind == "slant":
        x, lean = rear + rng.uniform(0.25, 0.6) * length, rng.uniform(-0.8, 0.8) * tall
        for k, tone in enumerate((first, second)):
            start, end = x + 0.28 * k * length, x + (0.22 + 0.34 * k) * length
            corners = np.array([(start, low), (end, low), (end + lean, high), (start + lean, high)])
            _fill(shell, np.clip(corners, [rear, low], [front, high]), tone, 2 + 2 * k)
    elif kind == "panel":
        start = rear + rng.uniform(0.08, 0.3) * length
        _fill(shell, rectangle_outline(start, start + 0.6 * length, low + 0.12 * tall, high - 0.12 * tall), first, 2)
        _fill(shell, rectangle_outline(start, start + 0.6 * length, low + 0.12 * tall, low + 0.2 * tall), second, 4)
    elif kind == "disc":
        center = rear + rng.uniform(0.3, 0.7) * length, (low + high) / 2
        _fill(shell, disc(center, 0.36 * tall, 20), first, 2)
        _fill(shell, disc((center[0] + 0.1 * tall, center[1]), 0.24 * tall, 20), second, 4)
    elif kind == "half":
        share = rng.uniform(0.3, 0.6)
        _fill(shell, rectangle_outline(rear, front, low, low + share * tall), first, 2)
    if kind != "disc" and rng.uniform() < 0.75:
        ink = "#23262b" if first == "#e8e8e6" else "#f0f0ee"
        ink = ink if kind in ("panel", "half") else second
        start, size = rear + rng.uniform(0.2, 0.35) * length, min(0.28 * tall, 0.7)
        base = low + {"panel": 0.4, "half": 0.12}.get(kind, 0.62) * tall
        draw_letters(
            shell, (start, start + 0.5 * length), (base, base + size), ink, int(rng.integers(1 << 30)), layer=6
        )


def draw_upper_markers(shell: Surface, half: float, z: float, end: float | None = None) -> None:
    """Draw marker lamps on the upper corners of a shell: white ahead and, where `end` is given, red behind.

    Args:
        shell: The shell, half as wide as `half`.
        half: Half of its width, metres.
        z: Height of the lamps' lower edge, metres.
        end: W of the middle of its rear.
    """
    shell.draw(rectangle_outline(half - 0.24, half - 0.12, z, z + 0.05), WRAP, FRONT_MARKER, layer=3)
    if end is not None:
        corner = end - half
        shell.draw(rectangle_outline(corner + 0.12, corner + 0.24, z, z + 0.05), WRAP, REAR_MARKER, layer=9)


def _fill(shell: Surface, polygon: np.ndarray, tone: str, layer: float) -> None:
    shell.draw(polygon, SIDE, tone, layer=layer, facing=LEFT_AXIS)
