"""Read a 3D model with 33 keypoints marked by small spheres, as in the first stage of the SKoPe3D paper.

A marker is an object named `kp_00` ... `kp_32` or `kp_<keypoint name>`; its centre is the keypoint. Markers for the
wheel centres are optional: the default is the wheels' own centres. The markers also define the axes: front and rear,
right and left.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.errors import UserError
from skope.gen.mesh import Mesh, from_triangles, merged
from skope.types import Array

WHEEL_CORNERS: Final = tuple(keypoints.NAMES[k].removeprefix("wheel_") for k in keypoints.WHEELS)
"""front_right, front_left, rear_right, rear_left."""


@dataclass(frozen=True)
class ModelFileLimits:
    """Limits of models in files."""

    lengths_m: tuple[float, float] = (2.0, 25.0)
    """Minimum and maximum length of a vehicle, metres. Models outside this range use another unit."""
    color_steps: int = 16
    """Number of levels to which each channel of a model's colours is rounded."""


MODEL_FILES: Final = ModelFileLimits()

_UNIT_METRES: Final = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048}
_AXIS_VECTORS: Final = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
LAMP_MATERIALS: Final = ("headlight", "taillight", "brake_light", "indicator_left", "indicator_right", "reverse_light")
"""Materials that light up. A surface of a material with one of these names is that lamp."""


@dataclass(frozen=True, eq=False)
class Marked:
    """Model in the vehicle frame."""

    mesh: Mesh
    """Body; its materials are colours such as "#a0b4c8", and `LAMP_MATERIALS`."""
    wheel: Mesh
    """Front left wheel about its centre."""
    points: Array
    """(33, 3) keypoints, metres."""
    wheel_radius: float
    wheel_width: float
    size_lwh: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class _Object:
    name: str
    vertices: Array
    triangles: NDArray[np.int64]
    materials: NDArray[np.str_]
    """(T,) colour of each triangle, such as "#a0b4c8", or one of `LAMP_MATERIALS`."""


def read_marked(
    path: Path,
    *,
    wheels: Mapping[str, str] | None = None,
    up: str | None = None,
    forward: str | None = None,
    scale: float = 1.0,
) -> Marked:
    """Read a model.

    Args:
        path: A .glb, .gltf or .obj file.
        wheels: Names of the objects of the corners front_right, front_left, rear_right and rear_left. Needed if their
            names do not contain "wheel".
        up: Axis such as "+y" that the markers must agree with; None: no check.
        forward: Axis such as "+x" that the markers must agree with; None: no check.
        scale: Metres per unit.

    Raises:
        UserError: One line with the file and the error.
    """
    objects = _load_objects(path)
    marks = _read_marks(path, objects)
    solid = [o for o in objects if _marked_keypoint(path, o.name) is None]
    chosen = _wheel_objects(path, solid, wheels)
    centers = {name: _box_center(o.vertices) for name, o in chosen.items()}
    T = _to_vehicle(path, marks, np.array(list(centers.values())), up, forward) * scale
    at = {name: T @ center for name, center in centers.items()}
    corners = _wheel_corners(path, at)
    turned = [_Object(o.name, o.vertices @ T.T, o.triangles, o.materials) for o in solid]
    body = [o for o in turned if o.name not in corners.values()]
    if not body:
        raise UserError(f"{path}: contains only markers and wheels; expected a body, too")
    low, high = (f(o.vertices[:, :2] for o in body) for f in (_lowest, _highest))
    _check_length(path, float(high[0] - low[0]), scale)
    wheel = next(o for o in turned if o.name == corners["front_left"])
    ground = min(float(o.vertices[:, 2].min()) for o in turned if o.name in corners.values())
    origin = np.array(
        [(low[0] + high[0]) / 2, 0.5 * (at[corners["front_left"]] + at[corners["front_right"]])[1], ground]
    )
    points = np.stack([marks[k] @ T.T if k in marks else np.zeros(3) for k in range(keypoints.K)]) - origin
    points[list(keypoints.WHEELS)] = np.array([at[corners[corner]] for corner in WHEEL_CORNERS]) - origin
    mesh = merged([_colored_mesh(o, origin) for o in body])
    width = float(np.ptp(mesh.vertices[:, 1]))
    centered = wheel.vertices - at[wheel.name]
    return Marked(
        mesh=mesh,
        wheel=_colored_mesh(wheel, at[wheel.name]),
        points=points,
        wheel_radius=float(np.ptp(centered[:, 2]) / 2),
        wheel_width=float(np.ptp(centered[:, 1])),
        size_lwh=(float(high[0] - low[0]), width, float(mesh.vertices[:, 2].max())),
    )


def _lowest(parts: Any) -> Array:
    return np.asarray(np.min([part.min(axis=0) for part in parts], axis=0))


def _highest(parts: Any) -> Array:
    return np.asarray(np.max([part.max(axis=0) for part in parts], axis=0))


def _box_center(vertices: Array) -> Array:
    return np.asarray((vertices.min(axis=0) + vertices.max(axis=0)) / 2)


# --------------------------------------------------------------------------------------------------------------- files


def _load_objects(path: Path) -> list[_Object]:
    try:
        import trimesh
    except ImportError:
        raise UserError(f"{path}: reading models needs trimesh: pip install 'skope[mesh]'") from None
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if path.suffix.lower() not in (".glb", ".gltf", ".obj"):
        raise UserError(f"{path}: expected a .glb, .gltf or .obj file")
    try:
        # OBJ files keep their objects only if they are not grouped by material.
        options: dict[str, Any] = (
            {"split_objects": True, "group_material": False} if path.suffix.lower() == ".obj" else {}
        )
        scene: Any = trimesh.load_scene(path, **options)
    except Exception as error:  # trimesh's readers raise various exceptions for damaged files
        raise UserError(f"{path}: not a readable model: {error}") from None
    out = []
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        geometry = scene.geometry[name]
        vertices = np.asarray(geometry.vertices, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
        if not len(getattr(geometry, "faces", ())) or not np.isfinite(vertices).all():
            continue
        triangles = np.asarray(geometry.faces, dtype=np.int64)
        if np.linalg.det(T[:3, :3]) < 0:
            triangles = triangles[:, ::-1]
        out.append(_Object(str(node), vertices, triangles, _face_materials(geometry)))
    if not out:
        raise UserError(f"{path}: holds no surfaces")
    return out


def _face_materials(geometry: Any) -> NDArray[np.str_]:
    """Return the material (T,) of each triangle.

    It is a colour such as "#a0b4c8", or one lamp for all if the material has its name (also as a copy,
    "headlight.001").
    """
    name = str(getattr(getattr(geometry.visual, "material", None), "name", "")).partition(".")[0].lower()
    if name in LAMP_MATERIALS:
        return np.full(len(geometry.faces), name)
    return np.array([f"#{r:02x}{g:02x}{b:02x}" for r, g, b in _face_colors(geometry).tolist()])


def _face_colors(geometry: Any) -> NDArray[np.uint8]:
    """Return the colour (T, 3) of each triangle from texture, material or vertices, rounded to a few levels."""
    visual, faces = geometry.visual, geometry.faces
    try:
        material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if image is not None and uv is not None:
            pixels = np.asarray(image.convert("RGB"))
            middle = np.asarray(uv)[faces].mean(axis=1) % 1.0
            rows = ((1 - middle[:, 1]) * pixels.shape[0]).astype(int).clip(0, pixels.shape[0] - 1)
            columns = (middle[:, 0] * pixels.shape[1]).astype(int).clip(0, pixels.shape[1] - 1)
            colors = pixels[rows, columns]
        elif material is not None:
            colors = np.tile(np.asarray(material.main_color)[:3], (len(faces), 1))
        else:
            colors = np.asarray(visual.face_colors)[:, :3]
    except Exception:  # a model without usable colours is grey
        colors = np.full((len(faces), 3), 150)
    step = 255 / (MODEL_FILES.color_steps - 1)
    return np.asarray(np.rint(np.rint(colors / step) * step), dtype=np.uint8)


def _colored_mesh(o: _Object, origin: Array) -> Mesh:
    """Return a mesh about `origin` with a material per colour and lamp."""
    names, number = np.unique(o.materials, return_inverse=True)
    smooth = from_triangles(o.vertices - origin, o.triangles, "")
    return Mesh(smooth.vertices, smooth.normals, smooth.triangles, tuple(names.tolist()), number.astype(np.int64))


# ------------------------------------------------------------------------------------------------------------- markers


def _marked_keypoint(path: Path, name: str) -> int | None:
    """Return the keypoint that an object of that name marks, or None. Blender's suffix ".001" of a copy is ignored."""
    match = re.fullmatch(r"kp_(\w+?)(?:\.\d+)?", name)
    if not match:
        return None
    if match[1] in keypoints.INDEX:
        return keypoints.INDEX[match[1]]
    if match[1].isdigit() and int(match[1]) < keypoints.K:
        return int(match[1])
    raise UserError(f"{path}: marker {name}: expected kp_00 to kp_{keypoints.K - 1} or kp_ and a keypoint's name")


def _read_marks(path: Path, objects: list[_Object]) -> dict[int, Array]:
    marks: dict[int, Array] = {}
    names: dict[int, str] = {}
    for o in sorted(objects, key=lambda o: o.name):
        k = _marked_keypoint(path, o.name)
        if k is None:
            continue
        if k in marks:
            raise UserError(f"{path}: markers {names[k]} and {o.name} both mark {keypoints.NAMES[k]}")
        marks[k], names[k] = _box_center(o.vertices), o.name
    missing = [keypoints.NAMES[k] for k in range(keypoints.K) if k not in marks and k not in keypoints.WHEELS]
    if missing:
        raise UserError(f"{path}: no marker for {', '.join(missing)}")
    return marks


# -------------------------------------------------------------------------------------------------------- axes, wheels


def _to_vehicle(path: Path, marks: dict[int, Array], wheels: Array, up: str | None, forward: str | None) -> Array:
    """Return the rotation (3, 3) from the file's axes to the vehicle frame, as defined by the markers."""

    def mean(*parts: str) -> Array:
        chosen = [marks[k] for k, name in enumerate(keypoints.NAMES) if k in marks and all(p in name for p in parts)]
        return np.asarray(np.mean(chosen, axis=0))

    ahead = mean("bumper_front") - mean("bumper_rear")
    leftward = mean("_left") - mean("_right")
    above = mean("roof") - mean("bumper")
    found = {"forward": ahead, "left": leftward, "up": above}
    axes = {}
    for name, direction in found.items():
        axis = int(np.abs(direction).argmax())
        if abs(direction[axis]) < 0.85 * np.linalg.norm(direction):
            raise UserError(
                f"{path}: the markers' {name} is not along an axis of the file: align the model with the axes"
            )
        axes[name] = np.sign(direction[axis]) * np.eye(3)[axis]
    for name, given in (("up", up), ("forward", forward)):
        if given is not None and not np.array_equal(_parse_axis(f"--{name}", given), axes[name]):
            raise UserError(f"{path}: --{name} {given}: the markers say {_axis_name(axes[name])}")
    if not np.allclose(np.cross(axes["up"], axes["forward"]), axes["left"]):
        raise UserError(
            f"{path}: markers of left and right are swapped: seen from above, left is on the right of forward"
        )
    return np.stack([axes["forward"], axes["left"], axes["up"]])


def _parse_axis(flag: str, text: str) -> Array:
    match = re.fullmatch(r"([+-]?)([xyz])", text.lower())
    if not match:
        raise UserError(f"{flag}: expected an axis such as +y or -z, got {text!r}")
    return (-1 if match[1] == "-" else 1) * np.array(_AXIS_VECTORS[match[2]])


def _axis_name(axis: Array) -> str:
    return ("+" if axis.sum() > 0 else "-") + "xyz"[int(np.abs(axis).argmax())]


def _wheel_objects(path: Path, objects: list[_Object], wheels: Mapping[str, str] | None) -> dict[str, _Object]:
    by_name = {o.name: o for o in objects}
    if wheels is not None:
        lost = [name for name in wheels.values() if name not in by_name]
        if lost or sorted(wheels) != sorted(WHEEL_CORNERS):
            problem = f"no object {lost[0]}" if lost else f"expected {', '.join(WHEEL_CORNERS)}"
            raise UserError(f"{path}: --wheels: {problem}; there are {', '.join(by_name)}")
        return {name: by_name[name] for name in wheels.values()}
    found = {name: o for name, o in by_name.items() if re.search(r"wheel|tyre|tire", name.lower())}
    if len(found) < 4:
        raise UserError(
            f"{path}: {len(found)} objects are named as wheels, expected 4: name them with --wheels; "
            f"there are {', '.join(by_name)}"
        )
    return found


def _wheel_corners(path: Path, at: dict[str, Array]) -> dict[str, str]:
    """Return the objects of the four corners: the foremost and rearmost wheel of each side."""
    middle = np.mean([p[1] for p in at.values()])
    out = {}
    for side, chosen in (
        ("right", {n: p for n, p in at.items() if p[1] < middle}),
        ("left", {n: p for n, p in at.items() if p[1] >= middle}),
    ):
        if len(chosen) < 2:
            raise UserError(f"{path}: the {side} side has {len(chosen)} wheels, expected 2 or more")
        order = sorted(chosen, key=lambda name: float(chosen[name][0]))
        out[f"front_{side}"], out[f"rear_{side}"] = order[-1], order[0]
    return out


def _check_length(path: Path, length: float, scale: float) -> None:
    if MODEL_FILES.lengths_m[0] <= length <= MODEL_FILES.lengths_m[1]:
        return
    guesses = [
        f"{unit}: --scale {metres}" for unit, metres in _UNIT_METRES.items() if 2.5 < length / scale * metres < 20
    ]
    hint = (
        f"; in {' or in '.join(guesses)}?"
        if guesses
        else f"; --scale {4.5 / (length / scale):.2g} gives the length of a car"
    )
    raise UserError(
        f"{path}: is {length:.4g} m long, expected {MODEL_FILES.lengths_m[0]:g} to {MODEL_FILES.lengths_m[1]:g}{hint}"
    )
