"""Wheels: tyre, rim with spokes, brake disc."""

import numpy as np

from skope.gen.mesh import Mesh, cross, lathe, merged, quads
from skope.types import Array

_WHEEL_SIDES = 20


def wheel_mesh(radius: float, width: float, spokes: int, rim_share: float = 0.68) -> Mesh:
    """Return a wheel about the y axis, with its outer face at y = width / 2 (the left side of a vehicle)."""
    half, rim = width / 2, radius * rim_share
    tyre = lathe(
        [
            (-half, 0.0),
            (-half, radius * 0.91),
            (-half * 0.62, radius),
            (half * 0.62, radius),
            (half * 0.97, radius * 0.91),
            (half * 0.93, rim * 1.02),
        ],
        ["under", *["tyre"] * 4],
        _WHEEL_SIDES,
        "y",
    )
    deep = half * 0.93 - min(0.075, 0.6 * width)
    barrel = lathe([(half * 0.93, rim * 1.02), (deep, rim * 0.94)], ["rim"], _WHEEL_SIDES, "y")
    back = lathe(
        [(deep, rim * 0.94), (deep + 0.01, rim * 0.66), (deep + 0.01, 0.0)], ["under", "disc"], _WHEEL_SIDES, "y"
    )
    return merged([tyre, barrel, back, _spokes(rim, half, spokes)])


def _spokes(rim: float, half: float, count: int) -> Mesh:
    """Return spokes from the hub to the rim, their sides, and the hub's cap."""
    face, edge, depth = half * 0.8, half * 0.88, 0.035
    pitch = 2 * np.pi / count
    # The ends of the spokes are inside the barrel.
    inner, outer = 0.19 * rim, 1.012 * rim
    wide = min(0.42, 1.7 / count)
    corners = []
    for k in range(count):
        middle = k * pitch
        start, end = pitch * wide, pitch * wide * 0.55
        ring = [(inner, -start), (outer, -end), (outer, end), (inner, start)]
        front = [_point_at_angle(r, middle + a, edge if r > inner else face) for r, a in ring]
        behind = [p - [0, depth, 0] for p in front]
        corners.append([front[0], front[1], front[2], front[3]])
        corners.append(behind[::-1])
        for i in (0, 2):
            j = i + 1
            corners.append([front[i], behind[i], behind[j], front[j]])
    spokes = quads(np.array(corners), "rim")
    hub = lathe([(face - depth, inner * 1.25), (face + 0.004, inner * 1.2), (face + 0.012, 0.0)], ["rim"] * 2, 10, "y")
    return merged([spokes, hub])


def _point_at_angle(radius: float, angle: float, y: float) -> Array:
    """Return the point at `radius` and `angle` from the z axis towards x, at `y` along the axle."""
    return np.array([radius * np.sin(angle), y, radius * np.cos(angle)])


def steel_wheel(radius: float, width: float) -> Mesh:
    """Return a commercial vehicle's wheel: a dished disc with holes and nuts around a hub."""
    half, rim = width / 2, radius * 0.58
    tyre = lathe(
        [
            (-half, 0.0),
            (-half, radius * 0.92),
            (-half * 0.8, radius),
            (half * 0.8, radius),
            (half, radius * 0.92),
            (half * 0.96, rim),
        ],
        ["under", *["tyre"] * 4],
        _WHEEL_SIDES,
        "y",
    )
    dish = lathe(
        [
            (half * 0.96, rim),
            (half * 0.8, rim * 0.93),
            (half * 0.5, rim * 0.86),
            (half * 0.62, rim * 0.5),
            (half * 0.62, rim * 0.34),
            (half * 0.98, rim * 0.28),
            (half, rim * 0.1),
            (half, 0.0),
        ],
        ["rim", "under", "rim", "rim", "disc", "rim", "rim"],
        _WHEEL_SIDES,
        "y",
    )
    holes = []
    for k in range(8):
        turn = np.linspace(0, 2 * np.pi, 7)[:-1]
        center = _point_at_angle(rim * 0.69, k * np.pi / 4, half * 0.575)
        u, v = _point_at_angle(1, k * np.pi / 4, 0), np.cross([0, 1.0, 0], _point_at_angle(1, k * np.pi / 4, 0))
        ring = center + 0.075 * rim * (np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v) + [0, 0.02, 0]
        holes.append([ring[0], ring[1], ring[2], ring[3]])
        holes.append([ring[0], ring[3], ring[4], ring[5]])
    return merged([tyre, dish, _turned_to_face_left(quads(np.array(holes), "under"))])


def _turned_to_face_left(mesh: Mesh) -> Mesh:
    """Return the mesh with all its triangles facing left."""
    v = mesh.vertices[mesh.triangles]
    normal = cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    triangles = np.where((normal[:, 1] < 0)[:, None], mesh.triangles[:, ::-1], mesh.triangles)
    normals = mesh.normals * np.sign(mesh.normals[:, 1:2])
    return Mesh(mesh.vertices, normals, triangles, mesh.materials, mesh.material)
