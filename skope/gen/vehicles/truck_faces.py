"""The face of a cab over the engine, between its headlights and its windscreen."""

from typing import Final

from skope.gen.vehicles.lofted_surfaces import WRAP, Surface
from skope.gen.vehicles.panels import grown, mirrored, rectangle_outline
from skope.gen.vehicles.shape import Shape

_FACES: Final = ("", "slots", "mask", "shield", "ladder")
"""Kinds of faces; "" is one large grille."""


def draw_face(cab: Surface, kind: str, place: tuple[float, float, float], s: Shape) -> None:
    """Draw a face on a cab.

    Args:
        cab: The cab's shell.
        kind: One of `VehicleStyle.face`.
        place: Half its width, its lower and its upper edge, metres.
        s: The vehicle's shape, which draws a face where the kind is "any".
    """
    half, low, high = place
    if kind == "any":
        kind = _FACES[int(s.length * 1e4) % len(_FACES)]
    tall = high - low
    if kind == "slots":
        for k in range(3):
            base = low + (0.08 + 0.31 * k) * tall
            slot = rectangle_outline(-half + 0.06 * (2 - k), half - 0.06 * (2 - k), base, base + 0.2 * tall)
            cab.sink(slot, WRAP, 0.03, "grille_mesh", wall="gap")
    elif kind == "mask":
        cab.paint(rectangle_outline(-half - 0.1, half + 0.1, low - 0.04, high + 0.06), WRAP, "trim")
        cab.sink(mirrored([(0.62 * half, low + 0.05), (0.8 * half, low + 0.6 * tall)]), WRAP, 0.03, "grille_mesh")
        cab.draw(rectangle_outline(-half, half, high - 0.1, high - 0.07), WRAP, "chrome", layer=2)
    elif kind == "shield":
        outline = mirrored([(0.42 * half, low), (0.62 * half, low + 0.35 * tall), (0.55 * half, high)])
        cab.paint(grown(outline, 0.025), WRAP, "chrome")
        cab.sink(outline, WRAP, 0.03, "grille_bars", wall="gap")
    elif kind == "ladder":
        cab.paint(rectangle_outline(-half, half, low + 0.5 * tall, high), WRAP, "trim")
        for k in range(3):
            base = low + (0.54 + 0.15 * k) * tall
            cab.draw(rectangle_outline(-half + 0.03, half - 0.03, base, base + 0.06 * tall), WRAP, "rail", layer=2)
        cab.line([(-0.1, low + 0.42 * tall), (half, low + 0.42 * tall)], WRAP, width=0.014)
    else:
        grille = rectangle_outline(-half, half, low, high)
        cab.paint(grown(grille, 0.02), WRAP, "trim")
        cab.sink(grille, WRAP, 0.025, "grille_slats", wall="gap")
