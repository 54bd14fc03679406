"""Panels on shells, with outlines in metres along and up.

They are stripes and adverts on cars, and large graphics and marker lamps on the sides of heavy bodies.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.vehicles.lofted_surfaces import CENTER, SHOULDER, SIDE_AXES, TOP_AXES, WRAP_AXES, Surface
from skope.gen.vehicles.parts import PART_SIZES
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.types import Array


@dataclass(frozen=True)
class PanelLimits:
    """Graphics and marker lamps on the sides."""

    left_axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Normal of a vehicle's left side."""
    marked_from_m: float = 2.1
    """Minimum width of a body with marker lamps, metres."""
    plain_share: float = 0.2
    """Share of bodies without graphics."""


PANEL_LIMITS: Final = PanelLimits()


Points = dict[str, Array]


def quad(a: float, b: float, low: tuple[float, float], high: tuple[float, float]) -> Array:
    """Return the outline of a panel from `a` to `b` along the shell; `low` and `high` are its ends' edges, metres."""
    return np.array([(a, low[0]), (b, low[1]), (b, high[1]), (a, high[0])])


def rectangle_outline(a: float, b: float, low: float, high: float) -> Array:
    return quad(a, b, (low, low), (high, high))


def draw_on_left(shell: Surface, rectangle: tuple[float, float, float, float], material: str, *, layer: float) -> None:
    """Draw an upright rectangle on the left side: from and to along the vehicle, lower and upper edge, metres."""
    shell.draw(rectangle_outline(*rectangle), SIDE_AXES, material, layer=layer, facing=PANEL_LIMITS.left_axis)


def within(outline: Array, start: float, end: float, low: float = 0.0, high: float = 1.0) -> Array:
    """Return the part of a quad between shares across and up."""
    bottom, top = outline[[0, 1]], outline[[3, 2]]

    def at(u: float, v: float) -> Array:
        return np.asarray((1 - v) * (bottom[0] + u * (bottom[1] - bottom[0])) + v * (top[0] + u * (top[1] - top[0])))

    return np.array([at(start, low), at(end, low), at(end, high), at(start, high)])


def disc(center: ArrayLike, radius: float, sides: int = 10) -> Array:
    turn = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return np.asarray(center) + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def grown(outline: Array, edge: float) -> Array:
    """Return a polygon with its corners moved away from its middle by `edge`, along and up."""
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return np.asarray(outline + np.sign(np.round(outline - middle, 6)) * edge)


def rounded(polygon: ArrayLike, radius: float) -> Array:
    """Return a convex polygon with its corners cut off, close to a fillet."""
    p = np.asarray(polygon, dtype=np.float64)
    out = []
    for before, corner, after in zip(np.roll(p, 1, axis=0), p, np.roll(p, -1, axis=0), strict=True):
        a, b = before - corner, after - corner
        reach = min(radius, 0.45 * np.hypot(*a), 0.45 * np.hypot(*b))
        out += [corner + a / np.hypot(*a) * reach, corner + b / np.hypot(*b) * reach]
    return np.array(out)


def mirrored(side: Sequence[tuple[float, float]]) -> Array:
    """Return a symmetric outline from its half, which runs from the bottom upwards."""
    half = np.array(side)
    return np.vstack([half, half[::-1] * [-1, 1]])


def plate_height(wanted: float) -> float:
    """Return the possible height of a plate that is nearest to a wanted height, metres."""
    return round(wanted / PART_SIZES.plate_step_m) * PART_SIZES.plate_step_m


_DECAL_COLORS: Final = ("#cc2222", "#224488", "#228844", "#ee8822", "#eeeeee", "#222222", "#eecc22")


def draw_decal(shell: Surface, s: Shape, style: VehicleStyle) -> None:
    """Draw a vehicle's stickers between its axles.

    Their colour follows from its length, so that few vehicles are equal.
    """
    if not style.decal:
        return
    color = _DECAL_COLORS[int(s.length * 1e4) % len(_DECAL_COLORS)]
    if style.decal == "racing":
        strip = rectangle_outline(s.cowl_x - 0.1, s.length / 2, 0.1, 0.3)
        shell.draw(strip, TOP_AXES, color, layer=0.6, levels=(SHOULDER, CENTER))
        return
    if style.decal == "checks":
        _draw_checks(shell, s)
        return
    ahead, behind = s.front_axle_x - 0.75, s.rear_axle_x + 0.65
    top = s.belt_height - 0.2
    low = top - min(0.22, 0.45 * (top - s.clearance))
    if style.decal == "stripe":
        shell.draw(rectangle_outline(behind, ahead, low - 0.06, low + 0.02), SIDE_AXES, color, layer=0.6)
        return
    middle = behind + 0.35 * (ahead - behind)
    half = 0.26 * (ahead - behind)
    if style.decal == "panel":
        shell.draw(rectangle_outline(middle - half, middle + half, low - 0.05, top), SIDE_AXES, "#eeeeee", layer=0.6)
        shell.draw(rectangle_outline(middle - half, middle - 0.55 * half, low - 0.05, top), SIDE_AXES, color, layer=0.8)
        color = "#222222"
    draw_letters(shell, (middle - 0.45 * half, middle + 0.9 * half), (low, top - 0.05), color, int(s.length * 1e5))


def _draw_checks(shell: Surface, s: Shape) -> None:
    """Draw two rows of checks along the sides, as on ambulances and other emergency vehicles."""
    size, top = 0.3, s.belt_height - 0.1
    tone = ("#d8c41c", "#d8631c", "#1b52a8")[int(s.length * 1e4) % 3]
    second = "#1d8a3c" if tone == "#d8c41c" else "#e8e8e6"
    start, stop = -s.length / 2 + 0.3, s.length / 2 - 0.75
    count = int((stop - start) / size)
    for k in range(count):
        for row in range(2):
            x, z = start + k * size, top - (row + 1) * size * 0.8
            ink = tone if (k + row) % 2 else second
            shell.draw(rectangle_outline(x, x + size, z, z + size * 0.8), SIDE_AXES, ink, layer=0.7)


def draw_letters(
    shell: Surface, along: tuple[float, float], up: tuple[float, float], color: str, seed: int, layer: float = 0.9
) -> None:
    """Draw two lines of blocks with the widths of words in a distant view."""
    rng = np.random.default_rng(seed)
    (start, end), (low, high) = along, up
    middle = low + 0.4 * (high - low)
    for bottom, top, gap in ((middle + 0.02, high, 0.025), (low, middle - 0.02, 0.012)):
        x = start
        while x < end - 0.04:
            wide = float(rng.uniform(0.35, 0.8)) * (top - bottom)
            shell.draw(rectangle_outline(x, min(x + wide, end), bottom, top), SIDE_AXES, color, layer=layer)
            x += wide + gap


GRAPHIC_COLORS: Final = (
    "#b8202a", "#1f4e96", "#1d7a46", "#e07b18", "#e8e8e6", "#23262b", "#e3bd1c", "#5b2c83", "#1b8ca0", "#7a1f2e",
    "#9aa0a6", "#274b3a",
)  # fmt: skip
"""Colours of the graphics."""
MARKER_MATERIAL: Final = "marker_amber"
"""Material of marker lamps along the sides, which burn with the headlights."""
FRONT_MARKER: Final = "marker_white"
REAR_MARKER: Final = "marker_red"
"""Materials of the marker lamps at the upper edges of vehicles wider than `PANEL_LIMITS.marked_from_m`, from UNECE
R48."""


def draw_graphics(
    shell: Surface, along: tuple[float, float], up: tuple[float, float], rng: np.random.Generator
) -> None:
    """Draw random graphics on the side of a shell between rear and front and between two heights.

    Some sides stay plain.
    """
    if rng.uniform() < PANEL_LIMITS.plain_share:
        return
    rear, front = along
    low, high = up
    tall, length = high - low, front - rear
    first, second = (GRAPHIC_COLORS[k] for k in rng.choice(len(GRAPHIC_COLORS), 2, replace=False))
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
    """Draw marker lamps on the upper corners of a shell: white at the front and, if `end` is given, red at the rear.

    Args:
        shell: The shell.
        half: Half of the shell's width, metres.
        z: Height of the lamps' lower edge, metres.
        end: W of the middle of its rear; None: no rear lamps.
    """
    shell.draw(rectangle_outline(half - 0.24, half - 0.12, z, z + 0.05), WRAP_AXES, FRONT_MARKER, layer=3)
    if end is not None:
        corner = end - half
        shell.draw(rectangle_outline(corner + 0.12, corner + 0.24, z, z + 0.05), WRAP_AXES, REAR_MARKER, layer=9)


def _fill(shell: Surface, polygon: np.ndarray, tone: str, layer: float) -> None:
    shell.draw(polygon, SIDE_AXES, tone, layer=layer, facing=PANEL_LIMITS.left_axis)
