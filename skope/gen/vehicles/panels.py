"""Outlines of what is drawn on a shell's ends, in metres along it and up."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.vehicles.parts import PLATE_STEP
from skope.types import Array

Points = dict[str, Array]


def quad(a: float, b: float, low: tuple[float, float], high: tuple[float, float]) -> Array:
    """Outline of a panel from `a` to `b` along the shell, with its lower and upper edge at either end, metres."""
    return np.array([(a, low[0]), (b, low[1]), (b, high[1]), (a, high[0])])


def rectangle_outline(a: float, b: float, low: float, high: float) -> Array:
    return quad(a, b, (low, low), (high, high))


def within(outline: Array, start: float, end: float, low: float = 0.0, high: float = 1.0) -> Array:
    """Part of a quad by shares across and up."""
    bottom, top = outline[[0, 1]], outline[[3, 2]]

    def at(u: float, v: float) -> Array:
        return np.asarray((1 - v) * (bottom[0] + u * (bottom[1] - bottom[0])) + v * (top[0] + u * (top[1] - top[0])))

    return np.array([at(start, low), at(end, low), at(end, high), at(start, high)])


def disc(center: ArrayLike, radius: float, sides: int = 10) -> Array:
    turn = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return np.asarray(center) + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def grown(outline: Array, edge: float) -> Array:
    """A polygon whose corners are pushed away from its middle, along and up."""
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return np.asarray(outline + np.sign(np.round(outline - middle, 6)) * edge)


def rounded(polygon: ArrayLike, radius: float) -> Array:
    """A convex polygon with its corners cut off, near a fillet."""
    p = np.asarray(polygon, dtype=np.float64)
    out = []
    for before, corner, after in zip(np.roll(p, 1, axis=0), p, np.roll(p, -1, axis=0), strict=True):
        a, b = before - corner, after - corner
        reach = min(radius, 0.45 * np.hypot(*a), 0.45 * np.hypot(*b))
        out += [corner + a / np.hypot(*a) * reach, corner + b / np.hypot(*b) * reach]
    return np.array(out)


def mirrored(side: Sequence[tuple[float, float]]) -> Array:
    """The whole of an outline that is symmetric about the shell's middle, from its half from below upwards."""
    half = np.array(side)
    return np.vstack([half, half[::-1] * [-1, 1]])


def plate_height(wanted: float) -> float:
    """The height nearest to a wanted one at which a plate may hang, metres."""
    return round(wanted / PLATE_STEP) * PLATE_STEP
