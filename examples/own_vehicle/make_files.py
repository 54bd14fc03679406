"""Make courier.glb of this example: a parcel van of our own, with the 33 keypoints marked by small spheres.

An editor of 3D models would do: what matters are the objects' names, `kp_00` to `kp_32` and four with "wheel" in them.

python make_files.py [FILE]
"""

import sys
from pathlib import Path

import numpy as np
import shapely
import trimesh
from shapely import Point, Polygon

from skope import keypoints

HERE = Path(__file__).parent
GLTF = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Vehicle frame (x forward, y left, z up) -> glTF's: y up, forward along z."""
OUTLINE = np.array(
    [
        *((2.70, 0.20), (2.70, 0.62), (2.58, 1.12), (2.10, 1.30), (1.42, 2.22), (1.20, 2.46)),
        *((-2.55, 2.46), (-2.66, 2.36), (-2.69, 1.30), (-2.70, 0.62), (-2.70, 0.20)),
    ]
)
"""Side view from the lower edge of the front bumper over the roof to that of the rear one: x and z, metres."""
FRONT, SCREEN, BACK, TAIL = 1, 3, 7, 8
"""Strips of the body, by the point of the outline that each begins at."""
BELT, ROOF = 1.30, 2.46
AXLES, WHEEL_Y, WHEEL_RADIUS, WHEEL_WIDTH = (1.75, -1.55), 0.82, 0.34, 0.20
ARCH_RADIUS, ARCH_Y = 0.42, 0.62
PAINT, STRIPE, GLASS, TRIM = (20, 130, 140), (245, 200, 40), (25, 30, 35), (45, 45, 48)
LAMP, RED, AMBER = (235, 235, 225), (190, 20, 20), (255, 150, 20)
TYRE, HUB = (22, 22, 22), (170, 172, 175)
Parts = dict[str, trimesh.Trimesh]


def half_width(z: np.ndarray) -> np.ndarray:
    """Half the body's width at a height: straight up to the belt, leaning inwards above."""
    return 0.93 - 0.09 * np.maximum(z - BELT, 0) / (ROOF - BELT)


def on_strip(first: int, z: float, y: float, off: float = 0.0) -> np.ndarray:
    """A point `off` before the body's front, roof or rear: on the strip that begins at a point of the outline."""
    (x0, z0), (x1, z1) = OUTLINE[first : first + 2]
    outward = np.array([z1 - z0, 0.0, x0 - x1]) / np.hypot(z1 - z0, x0 - x1)
    return np.array([x0 + (x1 - x0) * (z - z0) / (z1 - z0), y, z]) + off * outward


def on_side(x: float, z: float, off: float = 0.0) -> np.ndarray:
    """A point of the body's left side."""
    return np.array([x, half_width(np.array(z)) + off, z])


def surface(polygons: list[np.ndarray], color: tuple[int, int, int], lamp: str | None = None) -> trimesh.Trimesh:
    """Convex polygons, counter-clockwise from outside, in one colour; a lamp's material has the lamp's name."""
    vertices = np.concatenate(polygons)
    starts = np.cumsum([0, *map(len, polygons)])
    faces = [[s, s + i, s + i + 1] for s, p in zip(starts, polygons, strict=False) for i in range(1, len(p) - 1)]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    material = trimesh.visual.material.PBRMaterial(name=lamp, baseColorFactor=color)
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    return mesh


def both(polygons: list[np.ndarray]) -> list[np.ndarray]:
    """Polygons of the left side, and their mirror images."""
    return [*polygons, *((polygon * [1, -1, 1])[::-1] for polygon in polygons)]


def cut_up(area: Polygon) -> list[np.ndarray]:
    """Triangles (3, 2), counter-clockwise, of an area that need not be convex."""
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(area))
    return [np.array(shapely.geometry.polygon.orient(one).exterior.coords[:3]) for one in triangles]


def body() -> list[np.ndarray]:
    """The closed shell: strips over front, roof and rear, the sides with their wheel arches, and the underside."""
    width = half_width(OUTLINE[:, 1])
    left, right = (np.column_stack([OUTLINE[:, 0], side * width, OUTLINE[:, 1]]) for side in (1, -1))
    strips = [np.stack([right[i], left[i], left[i + 1], right[i + 1]]) for i in range(len(OUTLINE) - 1)]
    arches = [Point(x, WHEEL_RADIUS).buffer(ARCH_RADIUS, quad_segs=5) for x in AXLES]
    side = Polygon(OUTLINE).difference(shapely.union_all(arches))
    low, high = (side.intersection(shapely.box(-9, a, 9, b)) for a, b in ((0, BELT), (BELT, 9)))
    # Counter-clockwise from outside: seen from the left, x points to the left.
    sides = [np.array([on_side(x, z) for x, z in one[::-1]]) for part in (low, high) for one in cut_up(part)]
    inner, floor = [], Polygon([(2.70, -0.93), (2.70, 0.93), (-2.70, 0.93), (-2.70, -0.93)])
    for arch in arches:
        opening = arch.intersection(shapely.box(-9, 0.20, 9, 9))
        wall = np.array(shapely.geometry.polygon.orient(opening).exterior.coords[:-1])
        inner.append(np.column_stack([wall[:, 0], np.full(len(wall), ARCH_Y), wall[:, 1]])[::-1])
        ends = zip(wall, np.roll(wall, -1, axis=0), strict=True)
        for (x0, z0), (x1, z1) in ((a, b) for a, b in ends if max(a[1], b[1]) > 0.2001):
            edge = [(x0, ARCH_Y, z0), (x1, ARCH_Y, z1), (x1, 0.93, z1), (x0, 0.93, z0)]
            inner.append(np.array(edge))
        x0, _, x1, _ = opening.bounds
        for y0, y1 in ((ARCH_Y, 0.93), (-0.93, -ARCH_Y)):
            floor = floor.difference(shapely.box(x0, y0, x1, y1))
    under = [np.column_stack([one, np.full(3, 0.20)])[::-1] for one in cut_up(floor)]
    return [*strips, *both([*sides, *inner]), *under]


def panel(first: int, low: float, high: float, inner: float, outer: float) -> np.ndarray:
    """A quadrilateral on a strip between two heights and two distances from the middle, on the left."""
    corners = [(low, inner), (low, outer), (high, outer), (high, inner)]
    polygon = np.array([on_strip(first, z, y, 0.005) for z, y in corners])
    return polygon if first < BACK else polygon[::-1]  # at the rear, left is on the other side


def wheel() -> trimesh.Trimesh:
    """A wheel about its centre, its axle along y."""
    tyre = trimesh.creation.cylinder(WHEEL_RADIUS, WHEEL_WIDTH, sections=24)
    hub = trimesh.creation.cylinder(0.6 * WHEEL_RADIUS, WHEEL_WIDTH + 0.01, sections=16)
    for part, color in ((tyre, TYRE), (hub, HUB)):
        part.visual = trimesh.visual.ColorVisuals(part, vertex_colors=np.tile((*color, 255), (len(part.vertices), 1)))
    both_parts = trimesh.util.concatenate([tyre, hub])
    both_parts.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    return both_parts


def indicators() -> Parts:
    """Those of the left side, front and rear, and those of the right."""
    left = [panel(FRONT, 0.74, 0.98, 0.62, 0.68), panel(TAIL, 0.85, 0.95, 0.74, 0.90)]
    sides = {"left": left, "right": both(left)[len(left) :]}
    return {f"indicators_{side}": surface(of, AMBER, f"indicator_{side}") for side, of in sides.items()}


def parts() -> Parts:
    """The body by colours, in the vehicle frame."""
    window = [(1.02, 1.36), (1.80, 1.36), (1.36, 2.08), (1.02, 2.08)]
    stripe = [(-2.45, 0.98), (0.95, 0.98), (0.95, 1.18), (-2.45, 1.18)]
    mirror = trimesh.creation.box(bounds=[[1.70, 0.90, 1.34], [1.84, 1.04, 1.66]])
    mirrors = [mirror.triangles[i] for i in range(len(mirror.faces))]
    return {
        "body": surface(body(), PAINT),
        "glass": surface(
            both(
                [
                    panel(SCREEN, 1.36, 2.16, 0.0, 0.82),
                    panel(BACK, 1.42, 2.28, 0.06, 0.76),
                    np.array([on_side(x, z, 0.005) for x, z in window[::-1]]),
                ]
            ),
            GLASS,
        ),
        "stripe": surface(both([np.array([on_side(x, z, 0.005) for x, z in stripe[::-1]])]), STRIPE),
        "headlights": surface(both([panel(FRONT, 0.74, 0.98, 0.68, 0.89)]), LAMP, "headlight"),
        **indicators(),
        "taillights": surface(both([panel(TAIL, 0.95, 1.05, 0.74, 0.90)]), RED, "taillight"),
        "brake_lights": surface(both([panel(TAIL, 1.05, 1.15, 0.74, 0.90)]), RED, "brake_light"),
        "reverse_lights": surface(both([panel(TAIL, 0.75, 0.85, 0.74, 0.90)]), LAMP, "reverse_light"),
        "bumpers": surface(both([panel(0, 0.24, 0.58, 0.0, 0.90), panel(TAIL + 1, 0.24, 0.58, 0.0, 0.90)]), TRIM),
        "mirrors": surface(both(mirrors), TRIM),
    }


def left_keypoints() -> dict[str, np.ndarray]:
    """Keypoints of the left side and the middle, by their names without the side."""
    corners = {
        "bumper_front": 0, "hood_front": 2, "windscreen_base": 3, "roof_front": 4,
        "roof_rear": 7, "rear_window_base": 8, "trunk_rear": 9, "bumper_rear": 10,
    }  # fmt: skip
    return {
        **{name: on_side(*OUTLINE[i]) for name, i in corners.items()},
        "headlight_outer": on_strip(FRONT, 0.86, 0.89),
        "headlight_inner": on_strip(FRONT, 0.86, 0.62),
        "taillight_outer": on_strip(TAIL, 1.00, 0.90),
        "taillight_inner": on_strip(TAIL, 1.00, 0.74),
        "mirror": np.array([1.77, 1.04, 1.50]),
        "beltline": on_side(0.95, BELT),
        "front_logo": on_strip(FRONT, 0.86, 0.0),
    }


def write(path: Path) -> None:
    """Write the model: body, wheels, and a sphere for each keypoint but the wheels' centres."""
    scene, here = trimesh.Scene(), np.eye(4)
    here[:3, :3] = GLTF
    for name, part in parts().items():
        scene.add_geometry(part, node_name=name, geom_name=name, transform=here)
    for front, x in zip(("front", "rear"), AXLES, strict=True):
        for side, y in (("right", -WHEEL_Y), ("left", WHEEL_Y)):
            place = trimesh.transformations.translation_matrix((x, y, WHEEL_RADIUS))
            scene.add_geometry(wheel(), node_name=f"wheel_{front}_{side}", geom_name="wheel", transform=here @ place)
    sphere, points = trimesh.creation.icosphere(subdivisions=0, radius=0.02), left_keypoints()
    for k, name in enumerate(keypoints.NAMES):
        if k not in keypoints.WHEELS:
            point = points[name.removesuffix("_left").removesuffix("_right")]
            point = point * [1, -1, 1] if name.endswith("_right") else point
            place = here @ trimesh.transformations.translation_matrix(point)
            scene.add_geometry(sphere, node_name=f"kp_{k:02d}", geom_name="marker", transform=place)
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene))


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "courier.glb")
