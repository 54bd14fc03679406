"""Limbs and bodies of people: tubes with elliptic sections."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, flat, grid

CrossSection = tuple[tuple[float, float, float], float, float]
"""Centre, and half the depth (x) and width (y) of an ellipse, metres."""


def trunk(sections: Sequence[CrossSection], material: str, sides: int = 10) -> Mesh:
    """A closed upright body through level elliptic sections, from the lowest to the highest."""
    (low, *_), (high, *_) = sections[0], sections[-1]
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    rings = [
        np.asarray(center) + np.stack([rx * np.cos(angle), ry * np.sin(angle), 0 * angle], axis=-1)
        for center, rx, ry in ((low, 1e-4, 1e-4), *sections, (high, 1e-4, 1e-4))
    ]
    return grid(np.stack(rings), [[material] * sides] * (len(rings) - 1))


def limb(path: Sequence[ArrayLike], radii: Sequence[float], material: str, sides: int = 7) -> Mesh:
    """A closed round limb along points (N, 3) with a radius at each."""
    p = np.array([np.asarray(point, dtype=np.float64) for point in path])
    along = np.gradient(p, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [1.0, 0.0, 0.0])
    flat = np.linalg.norm(side, axis=1, keepdims=True) < 0.3
    side = np.where(flat, np.cross(along, [0.0, 1.0, 0.0]), side)
    u = side / np.linalg.norm(side, axis=1, keepdims=True)
    w = np.cross(along, u)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    ends = [1e-4, *radii, 1e-4]
    centers = [p[0], *p, p[-1]]
    frames = [(u[0], w[0]), *zip(u, w, strict=True), (u[-1], w[-1])]
    rings = [
        c + r * (np.cos(angle) * a + np.sin(angle) * b) for c, r, (a, b) in zip(centers, ends, frames, strict=True)
    ]
    return grid(np.stack(rings), [[material] * sides] * (len(rings) - 1))


def ball(center: ArrayLike, radii: tuple[float, float, float], material: str, *, above: float = -1.0) -> Mesh:
    """An ellipsoid, or what of it lies above a share of its height (-1: all)."""
    steps = np.linspace(np.arcsin(above), np.pi / 2, 6)
    angle = np.linspace(0, 2 * np.pi, 11)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = [np.column_stack([around * np.cos(step), np.full(len(angle), np.sin(step))]) for step in steps]
    return grid(np.asarray(center) + np.array(rings) * radii, [[material] * 10] * (len(steps) - 1))


def lens(center: ArrayLike, radius: float, material: str) -> Mesh:
    """The glass of a lamp: a disc that faces forward where it lies before the origin, else backward.

    Which way a lamp shines is worked out from its surface, and a closed one faces nowhere.
    """
    x, y, z = np.asarray(center, dtype=np.float64)
    angle = np.linspace(0, 2 * np.pi, 9)[:-1] * (1 if x > 0 else -1)
    return flat([np.stack([0 * angle + x, y + radius * np.cos(angle), z + radius * np.sin(angle)], axis=-1)], material)


NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), ("trim",), np.zeros(0, np.int64))
"""A part that a body does without."""
