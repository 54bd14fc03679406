"""Trees of several species with or without leaves, bushes and hedges."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely import LineString, Point, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, box, from_triangles, grid, lathe, merged, tube
from skope.gen.towns.land_use import LAND_USE, Layout
from skope.gen.towns.regions import is_free, polygons, rectangle_polygon
from skope.gen.towns.road_graph import places_along
from skope.gen.towns.town_style import Season, drawn_name
from skope.types import Array


@dataclass(frozen=True)
class TreeLimits:
    """Sizes and clearances of trees."""

    forks: tuple[tuple[int], tuple[int, int], tuple[int, int, int], tuple[int, int, int]] = (
        (4,),
        (6, 3),
        (6, 4, 2),
        (7, 4, 3),
    )
    """Number of branches that each branch forks into, per level, by a tree's detail."""
    branch_sides: int = 3
    """Number of sides of a branch."""
    clearance_m: float = 0.4
    """Minimum distance between crowns and the carriageway, metres."""
    open_view_m: float = 32.0
    """Radius around a camera in which its view of the road is free of trees, metres."""
    wide_m: float = 2.6
    """Radius above which a crown has more clumps, metres."""
    crown_m: float = 4.0
    """Maximum radius of crowns, metres."""


TREE_LIMITS: Final = TreeLimits()


def branches(
    height: float, bare: float, reach: float, stem: float, bark: str, detail: int, rng: np.random.Generator
) -> Mesh:
    """Return the branches of a tree without leaves, which fork upwards and outwards from its stem.

    Args:
        height: Height of the tree, metres.
        bare: Height of the stem below the crown, metres.
        reach: Radius of the crown, metres.
        stem: Radius of the stem near the ground, metres.
        bark: Material.
        detail: Detail of the crown, from 0 to 3.
        rng: Random generator.
    """
    crown = height - bare
    count = TREE_LIMITS.forks[detail][0]
    turn = rng.uniform(0, 2 * np.pi) + 2.399963 * np.arange(count)
    foot = np.column_stack([np.zeros((count, 2)), bare + crown * np.linspace(0.0, 0.6, count)])
    out = np.linspace(0.75, 0.25, count) * rng.uniform(0.7, 1.1, count) * reach
    up = (0.25 + 0.2 * rng.random(count)) * crown
    tip = foot + np.column_stack([out * np.cos(turn), out * np.sin(turn), up])
    thick = np.linspace(0.55, 0.3, count) * stem
    starts, ends, radii = [foot], [tip], [np.column_stack([thick, 0.5 * thick])]
    for forks in TREE_LIMITS.forks[detail][1:]:
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
    """Return tapered tubes between two sets of points (N, 3), with radii (N, 2) at both ends."""
    along = ends - starts
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    across = np.cross(along, side)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    angle = 2 * np.pi * np.arange(TREE_LIMITS.branch_sides) / TREE_LIMITS.branch_sides
    ring = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * across[:, None]  # (N, sides, 3)
    rings = np.stack([starts[:, None] + radii[:, :1, None] * ring, ends[:, None] + radii[:, 1:, None] * ring], axis=1)
    low, high = np.arange(TREE_LIMITS.branch_sides), np.arange(TREE_LIMITS.branch_sides) + TREE_LIMITS.branch_sides
    after = np.roll(low, -1)
    cells = np.concatenate(
        [np.stack([low, after, high], 1), np.stack([after, after + TREE_LIMITS.branch_sides, high], 1)]
    )
    first = 2 * TREE_LIMITS.branch_sides * np.arange(len(starts))[:, None, None]
    return from_triangles(rings.reshape(-1, 3), (first + cells).reshape(-1, 3), material)


def drooping_branches(
    height: float, bare: float, reach: float, leaves: str, detail: int, rng: np.random.Generator
) -> list[Mesh]:
    """Return the crown of a conifer: whorls of drooping single branches of uneven length around a core of leaves."""
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
    # A branch consists of two leaning halves, so that it has an area from any direction.
    hang = np.array([0.0, 0.0, 0.45]) * (step + half)
    left, right = middle - half * side - hang, middle + half * side - hang
    points = np.stack([root, left, right, tip, middle], axis=1)
    cells = np.array([[0, 1, 4], [0, 4, 2], [1, 3, 4], [4, 3, 2]])
    first = 5 * np.arange(len(level))[:, None, None]
    core = lathe([(bare, 0.0), (bare + 0.2, 0.45 * reach), (0.98 * height, 0.03)], [leaves] * 2, 7, "z")
    return [core, from_triangles(points.reshape(-1, 3), (first + cells).reshape(-1, 3), leaves)]


@dataclass(frozen=True, kw_only=True)
class Species:
    """Shape of a species of tree; lengths are shares of its height."""

    height: tuple[float, float]
    """Minimum and maximum height, metres."""
    bare: float
    """Height of the stem below the crown."""
    reach: float
    """Radius of the crown."""
    form: Literal["round", "column", "cone", "shrub"] = "round"
    leaves: str = "leaves"
    bark: str = "bark"
    stem: float = 0.14
    """Radius of the stem near the ground, metres."""


TREE_SPECIES: Final = {
    "lime": Species(height=(6.0, 10.0), bare=0.30, reach=0.27),
    "maple": Species(height=(5.0, 8.5), bare=0.27, reach=0.31),
    "oak": Species(height=(8.0, 12.5), bare=0.22, reach=0.36, stem=0.24),
    "poplar": Species(height=(11.0, 17.0), bare=0.12, reach=0.10, form="column", stem=0.17),
    "hornbeam": Species(height=(5.5, 8.0), bare=0.24, reach=0.17, form="column"),
    "spruce": Species(height=(8.0, 14.0), bare=0.08, reach=0.21, form="cone", leaves="leaves_dark", stem=0.16),
    "pine": Species(height=(8.0, 13.0), bare=0.45, reach=0.21, leaves="leaves_dark", stem=0.17),
    "birch": Species(height=(7.0, 11.0), bare=0.28, reach=0.20, leaves="leaves_pale", bark="bark_white", stem=0.11),
    "shrub": Species(height=(1.3, 2.4), bare=0.0, reach=0.55, form="shrub"),
}


@dataclass(frozen=True, eq=False)
class Tree:
    species: Species
    position: Array
    """(2,) position of the foot, metres."""
    height: float
    room: float
    """Maximum radius of the crown, metres."""
    detail: int
    """Detail of the crown, from 0 to 3."""
    street: bool
    """Whether the tree is in the sidewalk."""

    @property
    def reach(self) -> float:
        """Approximate radius of the crown, metres."""
        return min(self.height * self.species.reach, self.room)

    @property
    def pit(self) -> Polygon:
        return rectangle_polygon(self.position, 0.0, 1.2, 1.2)


def plant(layout: Layout, built: Any, rng: np.random.Generator) -> list[Tree]:
    """Return the town's lines of trees, and trees in its medians."""
    graph = layout.graph
    seen = [layout.sightlines(TREE_LIMITS.open_view_m), layout.around_cameras.buffer(TREE_LIMITS.crown_m)]
    walls = graph.walled_road.buffer(2.0)
    keep_clear = unary_union([graph.road.buffer(1.2), walls, built.buffer(2.2), *seen])
    shapely.prepare(keep_clear)
    style, out = layout.style, []

    def grow(at: Array, street: bool, species: Species) -> None:
        distance = layout.camera_distance(at)
        room = graph.road.distance(Point(at)) - TREE_LIMITS.clearance_m
        detail = 3 if distance < 26 else 2 if distance < 50 else 1 if distance < LAND_USE.plain_from_m else 0
        out.append(Tree(species, at, rng.uniform(*species.height), room, detail, street))

    for line in style.planting:
        edges = graph.edges_of("ground")
        if line.roads:
            edges = [edge for edge in graph.edges if edge.getType() in line.roads]
        for edge, position, _ in places_along(edges, line.spacing, line.offset):
            street = line.offset < graph.kind(edge).sidewalk
            wander = rng.uniform(-1.0, 1.0, 2) * (0.15 if street else line.wander * line.offset)
            at, species, likely = position + wander, drawn_name(style.species, rng), rng.random()
            if likely < line.chance and is_free(keep_clear, at, 0.4):
                grow(at, street, TREE_SPECIES[species])
    # Crowns in medians are too high to hide anything in a camera's view, except near a camera.
    near_cameras = layout.around_cameras.buffer(TREE_LIMITS.crown_m)
    for island in polygons(layout.islands.buffer(-1.4)):
        for at in _places_along(island, 11.0):
            if rng.random() < style.median_trees and not near_cameras.intersects(Point(at)):
                grow(at, False, TREE_SPECIES[drawn_name(style.species, rng)])
    return out


def _places_along(region: Polygon, spacing: float) -> Iterator[Array]:
    """Yield positions along a region's long axis, and across it where it is wide."""
    ring = np.array(region.minimum_rotated_rectangle.exterior.coords)
    sides = np.diff(ring, axis=0)[:2]
    lengths = np.hypot(*sides.T)
    a, along_it, across = ring[0], sides[lengths.argmax()], sides[lengths.argmin()]
    for share in (np.arange(int(lengths.max() // spacing)) + 0.5) * spacing / lengths.max():
        chord = region.intersection(LineString([a + share * along_it, a + share * along_it + across]))
        count = max(1, int(chord.length // spacing))
        for k in range(count) if not chord.is_empty else ():
            yield np.array(chord.interpolate((k + 0.5) / count, normalized=True).coords[0])


def tree_meshes(layout: Layout, trees: list[Tree], rng: np.random.Generator) -> Iterator[Mesh]:
    season = layout.style.season
    for tree in trees:
        mesh = _tree_in_season(tree, season, rng) if season else _tree(tree, rng)
        yield mesh.moved(layout.on_ground(tree.position), rng.uniform(0, 2 * np.pi))


def _tree_in_season(tree: Tree, season: Season, rng: np.random.Generator) -> Mesh:
    """Return a tree in a season: some trees without leaves, conifers with separate branches."""
    species, height, reach = tree.species, tree.height, tree.reach * rng.uniform(0.88, 1.12)
    bare = height * species.bare * rng.uniform(0.88, 1.12)
    if species.form == "cone":
        crown = drooping_branches(height, bare, min(reach, tree.room / 1.12), species.leaves, tree.detail, rng)
        return merged([_stem(species, 0.9 * height), *crown])
    if species.leaves == "leaves_dark" or species.form == "shrub" or rng.random() >= season.bare:
        return _tree(tree, rng)
    crowned = branches(height, bare, min(reach, tree.room / 1.4), species.stem, species.bark, tree.detail, rng)
    return merged([_stem(species, 0.85 * height), crowned])


def _stem(species: Species, top: float) -> Mesh:
    """Return a trunk up to a height, metres."""
    profile = [(-0.4, 1.4 * species.stem), (0.3, species.stem), (0.9 * top, 0.5 * species.stem)]
    return lathe(profile, [species.bark] * 2, 6, "z")


def _tree(tree: Tree, rng: np.random.Generator) -> Mesh:
    """Return a trunk with branches that carry a crown of many overlapping clumps of leaves."""
    species, height = tree.species, tree.height
    bare = height * species.bare * rng.uniform(0.88, 1.12)
    clumps, share = ((4, 0.85), (6, 0.72), (17, 0.52), (22, 0.45))[tree.detail]
    # Radius of the crown relative to the distance of the clumps' centres.
    rims = {"cone": 1.12, "column": 1.5}.get(species.form, 0.8 + 1.5 * share)
    reach = min(height * species.reach * rng.uniform(0.88, 1.12), tree.room / rims)
    top = 0.42 * height if species.form == "shrub" else height - 0.6 * reach
    parts = [_stem(species, top)]
    if species.form == "cone":
        return merged([*parts, *_conifer_tiers(tree, bare, reach, rng)])
    if species.form == "column":
        count, size = (4, 5, 9, 14)[tree.detail], 0.85 * reach
        levels = np.linspace(bare + size, height - size, count)
        swell = 0.75 + 0.35 * np.sin(np.pi * np.linspace(0.12, 0.95, count))
        centers = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)) * reach, levels])
        middle = np.array([0.0, 0.0, height / 2])
        stretch = np.array([1.0, 1.0, max(1.0, 1.7 * (height - bare) / (2 * size * count))])
        for center, grown in zip(centers, swell, strict=True):
            clump = _clump(
                center, size * grown * rng.uniform(0.9, 1.1), middle, 1 if tree.detail == 3 else 0, rng, stretch
            )
            parts.append(_with_material(clump, species.leaves))
        return merged(parts)
    up = (height - bare) / 2
    spread = np.array([reach, reach, up]) * 0.8
    middle = np.array([0.0, 0.0, bare + up])
    if tree.detail > 1 and reach > TREE_LIMITS.wide_m:  # more clumps in wide crowns, which would otherwise be lumps
        more = reach / TREE_LIMITS.wide_m
        clumps, share = round(clumps * more), share / more**0.5
    centers = middle + spread * _points_in_ball(clumps, rng)
    if tree.detail > 1 and species.form == "round":
        parts += [tube([(0.0, 0.0, bare), center], (0.06, 0.02), species.bark, 4) for center in centers[::5]]
    for center in centers:
        size = share * reach * rng.uniform(0.75, 1.25)
        parts.append(_with_material(_clump(center, size, middle, 1 if tree.detail == 3 else 0, rng), species.leaves))
    return merged(parts)


def _with_material(mesh: Mesh, material: str) -> Mesh:
    return Mesh(mesh.vertices, mesh.normals, mesh.triangles, (material,), mesh.material)


def _conifer_tiers(tree: Tree, bare: float, reach: float, rng: np.random.Generator) -> Iterator[Mesh]:
    """Yield a conifer's whorls of drooping branches: ragged cones above each other."""
    count, sides = (4, 5, 8, 11)[tree.detail], (6, 8, 11, 16)[tree.detail]
    levels = np.linspace(bare, 0.9 * tree.height, count)
    step = levels[1] - levels[0]
    core = [(bare, 0.0), (bare + 0.1, 0.7 * reach), (0.95 * tree.height, 0.02)]
    yield lathe(core, ["hedge"] * 2, sides, "z")
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    for k, low in enumerate(levels):
        radius = reach * (1 - 0.86 * k / count)
        rim = np.resize(rng.uniform(0.72, 1.12, sides), sides + 1) * np.resize([1.0, 0.82], sides + 1) * radius
        rim[-1] = rim[0]
        rows = []
        for share, z in ((1.0, low - 0.25 * step), (0.55, low + 0.55 * step), (0.04, low + 1.5 * step)):
            rows.append(
                np.column_stack([rim * share * np.cos(angle), rim * share * np.sin(angle), np.full(sides + 1, z)])
            )
        yield grid(np.array(rows), [[tree.species.leaves] * sides] * 2)


def _points_in_ball(count: int, rng: np.random.Generator) -> Array:
    """Return points (count, 3) in the unit ball, denser near its surface."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(0.35, 1.0, (count, 1)) ** 0.5


def _clump(
    center: Array,
    radius: float,
    middle: Array,
    detail: int,
    rng: np.random.Generator,
    stretch: ArrayLike = (1.0, 1.0, 0.8),
) -> Mesh:
    """Return an uneven ball of leaves; its normals lean away from the crown's middle for even lighting."""
    points, triangles = _icosphere(detail)
    uneven = 0.28 if detail else 0.16
    points = points * rng.uniform(1 - uneven, 1 + uneven, (len(points), 1)) * radius * np.asarray(stretch)
    part = from_triangles(center + points, triangles, "leaves")
    outward = center + points - middle
    normals = part.normals + 1.1 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return Mesh(part.vertices, normals, part.triangles, part.materials, part.material)


@cache
def _icosphere(detail: int) -> tuple[Array, NDArray[np.int64]]:
    """Return a unit icosahedron with its triangles divided into four `detail` times."""
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
    centers = middle + radius * 0.6 * _points_in_ball(6, rng) * [1, 1, 0.6]
    return merged(_clump(center, 0.7 * radius, middle, 0, rng) for center in centers)


def hedge(length: float, height: float, depth: float, rng: np.random.Generator) -> Mesh:
    """Return a clipped hedge along x around the origin: a dark core within an uneven coat of leaves."""
    half, inner = length / 2, 0.07
    core = box([-half + inner, -depth / 2 + inner, 0.0], [half - inner, depth / 2 - inner, height - inner], "hedge")
    columns = max(3, int(length / 0.7))
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
