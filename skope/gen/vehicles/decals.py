"""Decals on cars' sides and hoods: stripes, panels of adverts, rows of letters."""

from typing import Final

import numpy as np

from skope.gen.vehicles.lofted_surfaces import CENTER, SHOULDER, SIDE, TOP, Surface
from skope.gen.vehicles.panels import rectangle_outline
from skope.gen.vehicles.shape import Shape, VehicleStyle

_DECAL_COLORS: Final = ("#cc2222", "#224488", "#228844", "#ee8822", "#eeeeee", "#222222", "#eecc22")


def draw_decal(shell: Surface, s: Shape, style: VehicleStyle) -> None:
    """Draw a vehicle's stickers between its axles; their colour follows from its length, so that few are alike."""
    if not style.decal:
        return
    color = _DECAL_COLORS[int(s.length * 1e4) % len(_DECAL_COLORS)]
    if style.decal == "racing":
        strip = rectangle_outline(s.cowl_x - 0.1, s.length / 2, 0.1, 0.3)
        shell.draw(strip, TOP, color, layer=0.6, levels=(SHOULDER, CENTER))
        return
    if style.decal == "checks":
        _draw_checks(shell, s)
        return
    ahead, behind = s.front_axle_x - 0.75, s.rear_axle_x + 0.65
    top = s.belt_height - 0.2
    low = top - min(0.22, 0.45 * (top - s.clearance))
    if style.decal == "stripe":
        shell.draw(rectangle_outline(behind, ahead, low - 0.06, low + 0.02), SIDE, color, layer=0.6)
        return
    middle = behind + 0.35 * (ahead - behind)
    half = 0.26 * (ahead - behind)
    if style.decal == "panel":
        shell.draw(rectangle_outline(middle - half, middle + half, low - 0.05, top), SIDE, "#eeeeee", layer=0.6)
        shell.draw(rectangle_outline(middle - half, middle - 0.55 * half, low - 0.05, top), SIDE, color, layer=0.8)
        color = "#222222"
    draw_letters(shell, (middle - 0.45 * half, middle + 0.9 * half), (low, top - 0.05), color, int(s.length * 1e5))


def _draw_checks(shell: Surface, s: Shape) -> None:
    """Two rows of checks along the sides, as ambulances and other emergency vehicles have them."""
    size, top = 0.3, s.belt_height - 0.1
    tone = ("#d8c41c", "#d8631c", "#1b52a8")[int(s.length * 1e4) % 3]
    second = "#1d8a3c" if tone == "#d8c41c" else "#e8e8e6"
    start, stop = -s.length / 2 + 0.3, s.length / 2 - 0.75
    count = int((stop - start) / size)
    for k in range(count):
        for row in range(2):
            x, z = start + k * size, top - (row + 1) * size * 0.8
            ink = tone if (k + row) % 2 else second
            shell.draw(rectangle_outline(x, x + size, z, z + size * 0.8), SIDE, ink, layer=0.7)


def draw_letters(
    shell: Surface, along: tuple[float, float], up: tuple[float, float], color: str, seed: int, layer: float = 0.9
) -> None:
    """Two lines of blocks as wide as words look from afar."""
    rng = np.random.default_rng(seed)
    (start, end), (low, high) = along, up
    middle = low + 0.4 * (high - low)
    for bottom, top, gap in ((middle + 0.02, high, 0.025), (low, middle - 0.02, 0.012)):
        x = start
        while x < end - 0.04:
            wide = float(rng.uniform(0.35, 0.8)) * (top - bottom)
            shell.draw(rectangle_outline(x, min(x + wide, end), bottom, top), SIDE, color, layer=layer)
            x += wide + gap
