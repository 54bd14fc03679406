"""Small parts that project from a body's left side: mirrors, handles, rails, plates, exhausts, arch lips."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, box, cross, from_triangles, grid, lathe, merged, quads
from skope.gen.vehicles.solids import pipe
from skope.types import Array


@dataclass(frozen=True)
class PartSizes:
    """Sizes of number plates and roof signs."""

    plate_step_m: float = 0.125
    """Step of the heights of plates above the road, metres. The renderer derives the rows of a plate's text from it."""
    plate_m: tuple[float, float] = (0.26, 0.11)
    """Half of a plate's width, and its height, metres."""
    sign_height_m: float = 0.12
    """Height of a taxi's sign above the roof, metres."""


PART_SIZES: Final = PartSizes()


def block(low: ArrayLike, high: ArrayLike, material: str, bevel: float) -> Mesh:
    """Return a box with rounded vertical and horizontal edges, similar to a coarse superellipsoid."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    center, half = (a + b) / 2, (b - a) / 2
    share = np.minimum(bevel / half, 0.99)
    turn, rise = np.linspace(0, 2 * np.pi, 9), np.linspace(-np.pi / 2, np.pi / 2, 5)
    turn = turn + np.pi / 8
    c, s = np.cos(turn)[None], np.sin(turn)[None]
    flat, up = np.cos(rise)[:, None], np.sin(rise)[:, None]
    unit = np.stack(np.broadcast_arrays(flat * c, flat * s, up), axis=-1)
    # Corners of a sphere's octants, moved apart with flat faces between them.
    points = center + np.sign(np.round(unit, 9)) * half * (1 - share) + unit * half * share
    return grid(points, [[material] * 8] * 4)


def _mirror_shell(center: Array, sections: Array, material: str) -> Mesh:
    """Return a closed shell along y with a flat rear.

    `sections` (N, 4) are y, half height, reach ahead and behind `center`.
    """
    turn = np.linspace(0, 2 * np.pi, 9) + np.pi / 8
    # A nearly square ring: flatter at the top, bottom and rear than a circle.
    c, s = (np.sign(f(turn)) * np.abs(f(turn)) ** 0.7 for f in (np.cos, np.sin))
    y, high, ahead, behind = sections.T[..., None]
    points = np.stack(np.broadcast_arrays(np.where(c > 0, ahead * c, -behind), y, high * s), axis=-1)
    # From tip to root, so that the ring's faces point outwards.
    return grid(center + points[::-1], [[material] * 8] * (len(sections) - 1))


def mirror(root: tuple[float, float, float], tall: bool, material: str = "paint") -> tuple[Mesh, Array]:
    """Return a door mirror with its foot at `root` on the body's side, and its outer tip."""
    x, y, z = root
    high, reach = (0.17, 0.17) if tall else (0.075, 0.205)
    near = 0.05
    middle = np.array([x - 0.03, y, z + (0.12 if tall else 0.055)])
    ahead, behind = (0.075, 0.03) if tall else (0.085, 0.035)
    shares = np.array([(0.0, 0.02, 0.4), (0.015, 0.7, 0.8), (0.35, 0.95, 1.0), (0.78, 1.0, 0.85), (0.97, 0.72, 0.5)])
    shares = np.vstack([shares, (1.0, 0.02, 0.2)])
    sections = np.column_stack(
        [
            near + (reach - near) * shares[:, 0],
            high * shares[:, 1],
            ahead * shares[:, 2],
            np.full(len(shares), behind) * np.minimum(1, 2 * shares[:, 1]),
        ]
    )
    shell = _mirror_shell(middle, sections, material)
    edge = np.array([(0.1, -0.62), (0.1, 0.72), (0.3, 0.84), (0.76, 0.8), (0.84, 0.5), (0.84, -0.5), (0.74, -0.8)])
    edge = np.vstack([edge, (0.2, -0.8)])
    ring = middle + np.column_stack(
        [np.full(len(edge), -behind - 0.0005), near + (reach - near) * edge[:, 0], high * edge[:, 1]]
    )
    glass = from_triangles(ring, [[0, i, i + 1] for i in range(1, len(ring) - 1)], "glass_mirror")
    foot = _mirror_foot((x, y, z), near + 0.035, middle[2])
    tip = middle + np.array([0.04 * ahead, reach, 0.0])
    tip[0] = middle[0]
    return merged([shell, _turned_to_face(glass, (-1.0, 0.0, 0.0)), foot]), tip


def _mirror_foot(root: tuple[float, float, float], reach: float, top: float) -> Mesh:
    """Return a flat arm from the body to a mirror, wider at its root."""
    x, y, z = root
    low = np.array([(x + 0.045, y - 0.05), (x - 0.07, y - 0.05), (x - 0.05, y + reach), (x + 0.01, y + reach)])
    inner, outer = z - 0.012, top - 0.035
    bottom = np.column_stack([low, [inner, inner, outer, outer]])
    upper = np.add(bottom, [0, 0, 0.03])
    sides = [[bottom[i], bottom[(i + 1) % 4], upper[(i + 1) % 4], upper[i]] for i in range(4)]
    faces = np.array([upper, bottom[::-1], *sides])
    middle = faces.reshape(-1, 3).mean(axis=0)
    out = cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    wrong = (out * (faces.mean(axis=1) - middle)).sum(axis=1) < 0
    return quads(np.where(wrong[:, None, None], faces[:, ::-1], faces), "trim")


def _turned_to_face(mesh: Mesh, direction: tuple[float, float, float]) -> Mesh:
    """Return a flat mesh, turned to face a direction."""
    return mesh if (mesh.normals @ np.array(direction)).mean() > 0 else _flipped(mesh)


def _flipped(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, -mesh.normals, mesh.triangles[:, ::-1], mesh.materials, mesh.material)


def handle(at: tuple[float, float, float], material: str = "paint") -> Mesh:
    """Return a door handle: a curved bar."""
    x, y, z = at
    along = np.array([-0.105, -0.075, 0.075, 0.105])
    out = np.array([-0.012, 0.024, 0.024, -0.012])
    low, high = (np.column_stack([x + along, y + out, np.full(4, z + d)]) for d in (-0.013, 0.013))
    inner = np.column_stack([x + along, np.full(4, y - 0.012), np.full(4, z)])
    edge = np.array([0, 0, 0.013])
    return grid(np.stack([inner - edge, low, high, inner + edge])[:, ::-1], [[material] * 3] * 3)


def rail(path: Array) -> Mesh:
    """Return a roof rail along points (N, 3) that bends down to the roof at its ends."""
    high = path + np.array([0, 0, 0.05])
    low = path + np.array([0, 0, 0.024])
    ends = path[[0, -1]] + [[-0.09, 0, -0.03], [0.09, 0, -0.03]]
    high, low = (np.vstack([ends[0], p, ends[1]]) for p in (high, low))
    a, b = np.array([0, 0.021, 0]), np.array([0, -0.021, 0])
    # Around the bar, counter-clockwise seen from the rear.
    ring = np.stack([low + b, high + b * 0.7, high + a * 0.7, low + a, low + b])
    bar = grid(ring, [["rail"] * (len(high) - 1)] * 4)
    x, y, z = path[len(path) // 2]
    return merged([bar, box((x - 0.05, y - 0.014, z - 0.05), (x + 0.05, y + 0.014, z + 0.03), "rail")])


def spoiler(rear: float, top: float, half_width: float, material: str = "paint") -> Mesh:
    """Return a lip above the rear window that extends the roof, from the middle to `half_width`."""
    section = np.array([(0.2, -0.004), (-0.04, 0.004), (-0.05, -0.012), (0.1, -0.07)])
    y = np.array([0.0, half_width - 0.12, half_width])
    drop = np.array([0.0, -0.008, -0.05])
    points = np.stack(
        [
            np.column_stack([rear + section[:, 0] + 0.5 * d, np.full(4, v), top + 0.03 + section[:, 1] + d])
            for v, d in zip(y, drop, strict=True)
        ]
    )
    loop = np.concatenate([points, points[:, :1]], axis=1)
    skin = grid(loop, [[material] * 4] * 2)
    end = from_triangles(points[-1], [[0, 1, 2], [0, 2, 3]], material)
    return merged([_turned_outward(skin, points.reshape(-1, 3).mean(axis=0)), _turned_to_face(end, (0.0, 1.0, 0.0))])


def _turned_outward(mesh: Mesh, center: Array) -> Mesh:
    """Return the mesh with all its triangles facing away from `center`."""
    v = mesh.vertices[mesh.triangles]
    normal = cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    wrong = ((v.mean(axis=1) - center)[:, [0, 2]] * normal[:, [0, 2]]).sum(axis=1) < 0
    triangles = np.where(wrong[:, None], mesh.triangles[:, ::-1], mesh.triangles)
    return quads(mesh.vertices[triangles][:, [0, 1, 2, 2]], mesh.materials[0])


def deflector(front: float, rear: float, half_width: float, z: float, high: float) -> Mesh:
    """Return the left half of a wind deflector on a cab's roof at `z`, from `front` up to `high` above it at `rear`."""
    x = np.array([front, front - 0.35 * (front - rear), rear])
    up = np.array([-0.02, 0.62 * high, 0.94 * high])
    top = np.stack([np.column_stack([x, np.full(3, y), z + up]) for y in (0.0, half_width - 0.06)])
    low = top[1] + [0, 0.06, 0]
    side = np.stack([low, np.column_stack([x, np.full(3, half_width), np.full(3, z - 0.06)])])
    cover = np.concatenate([top, low[None] - [0, 0, 0.04], side[1:]])
    rim = np.vstack([cover[:, -1], [rear, 0.0, z - 0.06]])
    back = from_triangles(rim, [[0, i, i + 1] for i in range(1, len(rim) - 1)], "trim")
    return merged(
        [_turned_to_face(grid(cover, [["paint"] * 2] * 3), (0.0, 0.0, 1.0)), _turned_to_face(back, (-1.0, 0.0, 0.0))]
    )


def roof_sign(x: float, z: float, material: str = "sign") -> Mesh:
    """Return the left half of a lit sign across the roof of a taxi or a delivery car."""
    low = np.array([(x + 0.075, 0.0, z), (x + 0.075, 0.26, z), (x - 0.075, 0.26, z), (x - 0.075, 0.0, z)])
    top = z + PART_SIZES.sign_height_m
    high = np.array([(x + 0.045, 0.0, top), (x + 0.045, 0.21, top), (x - 0.045, 0.21, top), (x - 0.045, 0.0, top)])
    foot = box((x - 0.085, 0.0, z - 0.05), (x + 0.085, 0.27, z + 0.012), "trim")
    sides = [[low[i], low[i + 1], high[i + 1], high[i]] for i in range(3)]
    return merged([quads(np.array([*sides, high]), material), foot])


def plate(x: float, z: float, tilt: float, sign: float, material: str = "plate") -> Mesh:
    """Return the left half of a number plate with its lower edge at `x`.

    `tilt` is the backward lean of its upper edge.
    """
    half, high = PART_SIZES.plate_m
    face = np.array([(x, 0, z), (x, half, z), (x - sign * tilt, half, z + high), (x - sign * tilt, 0, z + high)])
    rim = face + np.array([(0, 0, -0.012), (0, 0.012, -0.012), (0, 0.012, 0.012), (0, 0, 0.012)]) - [sign * 0.004, 0, 0]
    back = rim - [sign * 0.03, 0, 0]
    sides = [[a[i], b[i], b[i + 1], a[i + 1]] for a, b in ((face, rim), (rim, back)) for i in range(3)]
    mesh = merged([quads(face, material), quads(np.array(sides), "trim")])
    return mesh if sign > 0 else _flipped(mesh)


def badge(at: Array, radius: float, sign: float, material: str = "chrome") -> Mesh:
    """Return the left half of a round badge on the middle of the front (`sign` 1) or the rear (-1)."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 8)
    ring = at + np.column_stack([0 * turn + sign * 0.009, radius * np.cos(turn), radius * np.sin(turn)])
    back = ring - [sign * 0.02, 0, 0]
    face = from_triangles(ring, [[0, i, i + 1] for i in range(1, len(ring) - 1)], material)
    edge = grid(np.stack([back, ring]), [["rail"] * (len(ring) - 1)])
    return merged([_turned_to_face(face, (sign, 0.0, 0.0)), edge if sign > 0 else _flipped(edge)])


def exhaust(x: float, y: float, z: float, radius: float = 0.036) -> Mesh:
    """Return a tail pipe that ends at `x`."""
    pipe = lathe([(-0.16, radius * 0.9), (0.0, radius), (-0.002, radius * 0.8)], ["chrome"] * 2, 8, "z")
    hole = lathe([(-0.05, radius * 0.82), (-0.05, 0.0)], ["gap"], 8, "z")
    mesh = merged([pipe, hole])

    def rearward(v: Array) -> Array:
        return np.stack([-v[:, 2], v[:, 1], v[:, 0]], axis=-1)

    return Mesh(
        np.add(rearward(mesh.vertices), [x, y, z]),
        rearward(mesh.normals),
        mesh.triangles,
        mesh.materials,
        mesh.material,
    )


def arch_lip(
    edges: Array, center: tuple[float, float], material: str, side: Callable[[Array], float], width: float = 0.034
) -> Mesh:
    """Return a rolled lip along a wheel arch's edges (N, 2, 3) around the axle at x, z.

    `side` is y of the body at x, z.
    """
    chain = _ordered_along_arch(edges.reshape(-1, 3), center)
    axle = np.array([center[0], 0.0, center[1]])
    outward = (chain - axle) * [1, 0, 1]
    outward[:, 2] = np.maximum(outward[:, 2], 0)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    outer = chain + width * outward
    outer[:, 1] = [side(point) - 0.004 for point in outer[:, [0, 2]]]
    crest = chain + 0.012 * outward + [0, 0.012, 0]
    # Chords of the arch: slightly nearer to the wheel than the edge that they hide.
    inner = chain - 0.005 * outward + [0, -0.05, 0]
    # From behind the wheel around it to the front, and inwards.
    return grid(np.stack([outer, crest, inner])[:, ::-1], [[material] * (len(chain) - 1)] * 2)


def _ordered_along_arch(points: Array, center: tuple[float, float], count: int = 12) -> Array:
    """Return `count` points of an arch, in order from ahead of the wheel to behind it."""
    x, z = points[:, 0] - center[0], points[:, 2] - center[1]
    radius = np.abs(x).max()
    turn = np.where(z > 0, np.arctan2(z, x), np.where(x > 0, z / radius, np.pi - z / radius))
    order = np.argsort(turn)
    wanted = np.linspace(turn.min(), turn.max(), count)
    nearest = np.abs(turn[order][None] - wanted[:, None]).argmin(axis=1)
    return np.asarray(points[order[np.unique(nearest)]])


def arm_mirror(
    root: tuple[float, float, float],
    material: str,
    *,
    reach: float = 0.25,
    high: float = 0.62,
    upright: bool = True,
    sunk: float = 0.06,
) -> tuple[Mesh, Array]:
    """Return a mirror on arms, `high` metres tall, with its root at `root` on the body's side, and its outer tip.

    The arms are level on an `upright` side, else both start at its foot; they begin `sunk` metres inside it.
    """
    x, y, z = root
    inner, outer = y + reach - 0.2, y + reach
    middle = z + high / 2 - 0.05
    low, top = middle - high / 2, middle + high / 2
    at = x
    housing = block((at - 0.06, inner, low), (at + 0.08, outer, top), material, 0.05)
    panes = [
        [
            (at - 0.0615, inner + 0.05, a),
            (at - 0.0615, outer - 0.05, a),
            (at - 0.0615, outer - 0.05, b),
            (at - 0.0615, inner + 0.05, b),
        ]
        for a, b in ((low + 0.24 * high, top - 0.07), (low + 0.07, low + 0.22 * high))
    ]
    glass = quads(np.array(panes)[:, ::-1], "glass_mirror")
    feet = (low + 0.08, top - 0.08) if upright else (z + 0.02, z + 0.07)
    arms = [
        pipe((x, y - sunk, foot), (at + 0.01, inner + 0.06, level), 0.018, "trim", sides=6)
        for foot, level in zip(feet, (low + 0.08, top - 0.14), strict=True)
    ]
    return merged([housing, glass, *arms]), np.array([at + 0.01, outer, middle])
