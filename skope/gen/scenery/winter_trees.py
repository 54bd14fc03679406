"""Trees without leaves, and conifers of drooping branches: what a season puts in place of the usual crowns."""

from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, from_triangles, lathe
from skope.types import Array

FORKS: Final = ((4,), (6, 3), (6, 4, 2), (7, 4, 3))
"""Number of branches that each branch forks into, at each level, by a tree's detail."""
_BRANCH_SIDES: Final = 3


def branches(
    height: float, bare: float, reach: float, stem: float, bark: str, detail: int, rng: np.random.Generator
) -> Mesh:
    """The branches of a tree without leaves, which fork upwards and outwards from its stem.

    Args:
        height: Height of the tree, metres.
        bare: Height of the stem below the crown, metres.
        reach: Radius of the crown, metres.
        stem: Radius of the stem near the ground, metres.
        bark: Material.
        detail: Detail of the crown, from 0 to 3.
        rng: Draws.
    """
    crown = height - bare
    count = FORKS[detail][0]
    turn = rng.uniform(0, 2 * np.pi) + 2.399963 * np.arange(count)
    foot = np.column_stack([np.zeros((count, 2)), bare + crown * np.linspace(0.0, 0.6, count)])
    out = np.linspace(0.75, 0.25, count) * rng.uniform(0.7, 1.1, count) * reach
    up = (0.25 + 0.2 * rng.random(count)) * crown
    tip = foot + np.column_stack([out * np.cos(turn), out * np.sin(turn), up])
    thick = np.linspace(0.55, 0.3, count) * stem
    starts, ends, radii = [foot], [tip], [np.column_stack([thick, 0.5 * thick])]
    for forks in FORKS[detail][1:]:
        way, slender = ends[-1] - starts[-1], radii[-1]
        along = np.tile(np.linspace(0.35, 1.0, forks), len(way))[:, None]
        way, foot, slender = (np.repeat(values, forks, axis=0) for values in (way, starts[-1], slender))
        length = np.linalg.norm(way, axis=1, keepdims=True)
        aside = rng.normal(size=way.shape) * [1.0, 1.0, 0.6]
        foot = foot + along * way
        tip = foot + 0.55 * way + 0.34 * length * aside
        tip[:, 2] = np.minimum(tip[:, 2] + 0.1 * length[:, 0], height)
        thick = np.maximum(0.55 * (slender[:, 0] + along[:, 0] * (slender[:, 1] - slender[:, 0])), 0.008)
        starts.append(foot)
        ends.append(tip)
        radii.append(np.column_stack([thick, 0.5 * thick]))
    return _straight_tubes(np.concatenate(starts), np.concatenate(ends), np.concatenate(radii), bark)


def _straight_tubes(starts: Array, ends: Array, radii: Array, material: str) -> Mesh:
    """Tapered tubes from points (N, 3) to others, with radii (N, 2) at both ends."""
    along = ends - starts
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    across = np.cross(along, side)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    angle = 2 * np.pi * np.arange(_BRANCH_SIDES) / _BRANCH_SIDES
    ring = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * across[:, None]  # (N, sides, 3)
    rings = np.stack([starts[:, None] + radii[:, :1, None] * ring, ends[:, None] + radii[:, 1:, None] * ring], axis=1)
    low, high = np.arange(_BRANCH_SIDES), np.arange(_BRANCH_SIDES) + _BRANCH_SIDES
    after = np.roll(low, -1)
    cells = np.concatenate([np.stack([low, after, high], 1), np.stack([after, after + _BRANCH_SIDES, high], 1)])
    first = 2 * _BRANCH_SIDES * np.arange(len(starts))[:, None, None]
    return from_triangles(rings.reshape(-1, 3), (first + cells).reshape(-1, 3), material)


def drooping_branches(
    height: float, bare: float, reach: float, leaves: str, detail: int, rng: np.random.Generator
) -> list[Mesh]:
    """The crown of a conifer: whorls of single branches of uneven length that droop, around a core of leaves."""
    whorls, count = ((4, 5), (6, 6), (9, 8), (12, 9))[detail]
    fullness, levels = rng.uniform(0.75, 1.25), np.linspace(bare, 0.93 * height, whorls)
    step = levels[1] - levels[0]
    level = np.repeat(levels, count) + rng.uniform(-0.3, 0.3, whorls * count) * step
    share = 1 - (level - bare) / (height - bare)
    length = reach * np.clip(share, 0.06, 1.0) ** fullness * rng.uniform(0.6, 1.15, len(level))
    turn = np.tile(2 * np.pi * np.arange(count) / count, whorls) + np.repeat(rng.uniform(0, 6.3, whorls), count)
    turn += rng.uniform(-0.25, 0.25, len(level))
    out = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    side = np.column_stack([-out[:, 1], out[:, 0], np.zeros(len(turn))])
    half = (0.28 * length + 0.06 * reach)[:, None]
    root = np.column_stack([np.zeros((len(level), 2)), level + 0.25 * step])
    droop = np.array([0.0, 0.0, 1.0]) * (0.35 * length)[:, None]
    middle, tip = root + 0.6 * length[:, None] * out, root + length[:, None] * out - droop
    # A branch is a roof of two leaning halves: seen from any side it has an area.
    hang = np.array([0.0, 0.0, 0.45]) * (step + half)
    left, right = middle - half * side - hang, middle + half * side - hang
    points = np.stack([root, left, right, tip, middle], axis=1)
    cells = np.array([[0, 1, 4], [0, 4, 2], [1, 3, 4], [4, 3, 2]])
    first = 5 * np.arange(len(level))[:, None, None]
    core = lathe([(bare, 0.0), (bare + 0.2, 0.45 * reach), (0.98 * height, 0.03)], [leaves] * 2, 7, "z")
    return [core, from_triangles(points.reshape(-1, 3), (first + cells).reshape(-1, 3), leaves)]
