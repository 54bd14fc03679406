"""Trees, bushes and hedges, and the wooded hills around a town."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Point, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, box, from_triangles, grid, lathe, merged, tube
from skope.gen.towns.ground import MARGIN
from skope.gen.towns.layout import KERB_HEIGHT, Layout, along, free, rectangle

Array = NDArray[np.float64]

CLEARANCE: Final = 0.4
"""Between crowns and the carriageway, metres."""
SIGHT: Final = 38.0
"""Trees keep out of the view of road that is nearer than that to a camera, metres."""

CROWN: Final = 4.0
"""How far crowns reach at most, metres."""


@dataclass(frozen=True, eq=False)
class Tree:
    place: Array
    """(2,) of its foot."""
    height: float
    room: float
    """How far its crown may reach, metres."""
    detail: int
    """0, 1 or 2: what its crown is made of."""
    street: bool
    """Whether it stands in the sidewalk."""

    @property
    def pit(self) -> Polygon:
        return rectangle(self.place, 0.0, 1.2, 1.2)


def plant(layout: Layout, built: Any, rng: np.random.Generator) -> list[Tree]:
    """Street trees, trees in gardens, and groves behind the houses."""
    seen = [layout.sightlines(SIGHT), layout.around_cameras.buffer(CROWN)]
    keep_clear = unary_union([layout.road.buffer(1.2), built.buffer(2.2), *seen])
    shapely.prepare(keep_clear)
    out = []
    for spacing, offset, chance in ((15.0, 2.15, 0.5), (13.0, 5.5, 0.4), (12.0, 22.0, 0.5), (13.0, 50.0, 0.7)):
        for _, place, _ in along(layout, spacing, offset):
            street = offset < 3
            wander = rng.uniform(-1.0, 1.0, 2) * (0.15 if street else 0.25 * offset)
            at, height, likely = place + wander, rng.uniform(5.0, 9.5), rng.random()
            if likely < chance and free(keep_clear, at, 0.4):
                distance = layout.camera_distance(at)
                room = layout.road.distance(Point(at)) - CLEARANCE
                out.append(Tree(at, height, room, 2 if distance < 30 else 1 if distance < 58 else 0, street))
    return out


def tree_meshes(trees: list[Tree], rng: np.random.Generator) -> Iterator[Mesh]:
    for tree in trees:
        yield _tree(tree, rng).moved([*tree.place, KERB_HEIGHT], rng.uniform(0, 2 * np.pi))


def _tree(tree: Tree, rng: np.random.Generator) -> Mesh:
    """A trunk with branches that carry a crown of many overlapping clumps of leaves."""
    height = tree.height
    bare = height * rng.uniform(0.26, 0.34)
    up = height * rng.uniform(0.27, 0.36)
    # Clumps at the rim stand out by up to 0.7 of the crown's own radius.
    across = min(0.8 * up, tree.room / 1.7)
    reach = np.array([across, across, up])
    middle = np.array([0.0, 0.0, height - reach[2] * 0.95])
    count, share = ((7, 0.7), (17, 0.52), (22, 0.45))[tree.detail]
    centers = middle + reach * 0.78 * _spread(count, rng)
    size = share * across
    parts = [lathe([(-0.05, 0.2), (0.3, 0.14), (middle[2], 0.08)], ["bark", "bark"], 6, "z")]
    if tree.detail:
        parts += [tube([(0.0, 0.0, bare), center], (0.06, 0.02), "bark", 4) for center in centers[::5]]
    for center in centers:
        parts.append(_clump(center, size * rng.uniform(0.75, 1.25), middle, 1 if tree.detail == 2 else 0, rng))
    return merged(parts)


def _spread(count: int, rng: np.random.Generator) -> Array:
    """(count, 3) points in the unit ball, more of them near its surface."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(0.35, 1.0, (count, 1)) ** 0.5


def _clump(center: Array, radius: float, middle: Array, detail: int, rng: np.random.Generator) -> Mesh:
    """An uneven ball of leaves whose normals lean away from the crown's middle: the crown is lit as one."""
    points, triangles = _ball(detail)
    points = points * rng.uniform(0.72, 1.28, (len(points), 1)) * radius * np.array([1.0, 1.0, 0.8])
    part = from_triangles(center + points, triangles, "leaves")
    outward = center + points - middle
    normals = part.normals + 1.1 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return Mesh(part.vertices, normals, part.triangles, part.materials, part.material)


@cache
def _ball(detail: int) -> tuple[Array, NDArray[np.int64]]:
    """An icosahedron with its triangles divided into four `detail` times; radius 1."""
    g = (1 + 5**0.5) / 2
    corners = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0)]
    points = np.array([*corners, *[(z, x, y) for x, y, z in corners], *[(y, z, x) for x, y, z in corners]], float)
    points /= np.linalg.norm(points[0])
    hull = [
        (i, j, k)
        for i in range(12)
        for j in range(12)
        for k in range(12)
        if i < j
        and i < k
        and j != k
        and all(np.linalg.norm(points[a] - points[b]) < 1.1 for a, b in ((i, j), (j, k), (k, i)))
        and np.dot(np.cross(points[j] - points[i], points[k] - points[i]), points[i]) > 0
    ]
    triangles = np.array(hull, dtype=np.int64)
    for _ in range(detail):
        middles = [(points[triangles[:, a]] + points[triangles[:, b]]) / 2 for a, b in ((0, 1), (1, 2), (2, 0))]
        t, n = len(triangles), len(points)
        new = np.concatenate(middles)
        points = np.concatenate([points, new / np.linalg.norm(new, axis=1, keepdims=True)])
        ab, bc, ca = (n + k * t + np.arange(t) for k in range(3))
        a, b, c = triangles.T
        triangles = np.concatenate(
            [np.stack(row, axis=1) for row in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        rounded, index = np.unique(points.round(9), axis=0, return_inverse=True)
        points, triangles = rounded, index.ravel()[triangles]
    return points, triangles


def bush(radius: float, rng: np.random.Generator) -> Mesh:
    middle = np.array([0.0, 0.0, 0.4 * radius])
    centers = middle + radius * 0.6 * _spread(9, rng) * [1, 1, 0.6]
    return merged(_clump(center, 0.6 * radius, middle, 0, rng) for center in centers)


def hedge(length: float, height: float, depth: float, rng: np.random.Generator) -> Mesh:
    """A clipped hedge along x around the origin: a dark core within an uneven coat of leaves."""
    half, inner = length / 2, 0.07
    core = box([-half + inner, -depth / 2 + inner, 0.0], [half - inner, depth / 2 - inner, height - inner], "hedge")
    columns = max(3, int(length / 0.45))
    x = np.linspace(-half, half, columns)
    profile = np.array([[-0.5, 0.0], [-0.52, 0.55], [-0.42, 1.0], [0.42, 1.0], [0.52, 0.55], [0.5, 0.0]])
    y, z = profile[:, :1] * depth, profile[:, 1:] * height
    coat = np.stack(np.broadcast_arrays(x[None], y, z), axis=-1) + rng.normal(0, 0.025, (6, columns, 3))
    parts = [core, grid(coat, [["leaves"] * (columns - 1)] * 5)]
    for end in (0, -1):
        cap = coat[:, end]
        triangles = [[0, i, i + 1] for i in range(1, 5)]
        parts.append(from_triangles(cap, np.array(triangles)[:, :: -1 if end else 1], "leaves"))
    return merged(parts)


def hills(layout: Layout, rng: np.random.Generator) -> Mesh:
    """Wooded hills all around, where the ground ends."""
    x0, y0, x1, y1 = layout.road.bounds
    centre, half = np.array([x0 + x1, y0 + y1]) / 2, np.array([x1 - x0, y1 - y0]) / 2 + MARGIN
    angle = np.linspace(0, 2 * np.pi, 361)[::-1]
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    swell = 1 + 0.3 * sum(np.sin(k * angle + rng.uniform(0, 6)) / k for k in (2, 3, 5, 9))
    rows = []
    for share, height in ((0.62, -0.5), (0.64, 5.0), (0.70, 7.0), (0.85, 14.0), (0.86, 17.0), (1.0, 22.0)):
        crowns = np.resize(rng.uniform(0.78, 1.12, 360), 361)
        rows.append(np.column_stack([centre + share * half * ring, height * np.clip(swell, 0.3, 2) * crowns]))
    return grid(np.array(rows), [["woods"] * 360] * 5)
