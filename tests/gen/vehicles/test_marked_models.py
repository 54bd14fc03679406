"""Models with markers, written here by trimesh from a model of the fleet, must come back as they were."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from skope import keypoints
from skope.errors import UserError
from skope.gen.inspect import vehicle_models as vehicle_checks
from skope.gen.mesh import Mesh
from skope.gen.render import lit_lamps as traffic_lights
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.marked_models import LAMP_MATERIALS, WHEEL_CORNERS, read_marked

SEDAN = fleet()["sedan"].vehicle
GLTF = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Vehicle frame -> y up, forward along -z."""
Nodes = dict[str, trimesh.Trimesh]


def solid(mesh: Mesh, offset: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices + offset, mesh.triangles, process=False)


def nodes() -> Nodes:
    """Body, wheels and markers by name, in the vehicle frame."""
    out = {"body": solid(SEDAN.mesh, np.zeros(3))}
    wheels = (SEDAN.wheel.mirrored(), SEDAN.wheel) * 2
    for corner, wheel, center in zip(WHEEL_CORNERS, wheels, SEDAN.shape.wheel_centers(), strict=True):
        out[f"wheel_{corner}"] = solid(wheel, center)
    for k, point in enumerate(SEDAN.points):
        if k not in keypoints.WHEELS:
            marker = trimesh.creation.icosphere(subdivisions=1, radius=0.02)
            out[f"kp_{k:02d}"] = trimesh.Trimesh(marker.vertices + point, marker.faces, process=False)
    return out


def written(path: Path, parts: Nodes, axes: np.ndarray = GLTF, scale: float = 1.0) -> Path:
    scene = trimesh.Scene()
    for name, part in parts.items():
        turned = trimesh.Trimesh(part.vertices @ axes.T * scale, part.faces, process=False)
        scene.add_geometry(turned, node_name=name, geom_name=name)
    scene.export(path)
    return path


@pytest.mark.parametrize(
    ("suffix", "axes", "scale"),
    [
        (".glb", GLTF, 1.0),
        (".glb", GLTF @ np.diag([-1.0, -1.0, 1.0]), 1000.0),
        (".glb", np.eye(3), 1 / 0.0254),
        (".obj", GLTF, 1.0),
    ],
)
def test_a_marked_model_comes_back(tmp_path: Path, suffix: str, axes: np.ndarray, scale: float) -> None:
    path = written(tmp_path / f"car{suffix}", nodes(), axes, scale)
    marked = read_marked(path, scale=1 / scale)
    # The origin is under the middle of the body's box, with the wheels on the ground.
    np.testing.assert_allclose(marked.points, SEDAN.points, atol=2e-3)
    assert marked.wheel_radius == pytest.approx(SEDAN.shape.wheel_radius, abs=1e-3)
    assert marked.size_lwh[0] == pytest.approx(SEDAN.shape.length, abs=0.01)
    assert len(marked.mesh.triangles) == len(SEDAN.mesh.triangles)
    # Still counter-clockwise from outside.
    volume = [trimesh.Trimesh(m.vertices, m.triangles, process=False).volume for m in (marked.mesh, SEDAN.mesh)]
    assert volume[0] == pytest.approx(volume[1], rel=1e-2)


def without(name: str) -> Callable[[Nodes], Nodes]:
    return lambda parts: {key: part for key, part in parts.items() if key != name}


def renamed(old: str, new: str) -> Callable[[Nodes], Nodes]:
    return lambda parts: {new if key == old else key: part for key, part in parts.items()}


def doubled(parts: Nodes) -> Nodes:
    return {**parts, "kp_24.001": parts["kp_24"]}


def swapped(parts: Nodes) -> Nodes:
    return {
        f"kp_{keypoints.FLIP[int(key[3:])]:02d}" if key.startswith("kp_") else key: part for key, part in parts.items()
    }


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without("kp_24"), r"car\.glb: no marker for hood_front_right$"),
        (doubled, r"markers kp_24 and kp_24\.001 both mark hood_front_right"),
        (swapped, "markers of left and right are swapped"),
        (renamed("kp_24", "kp_33"), "marker kp_33: expected kp_00 to kp_32"),
        (renamed("kp_24", "kp_bonnet"), "marker kp_bonnet: expected"),
        (renamed("wheel_rear_left", "rear_left"), "3 objects are named as wheels, expected 4: name them with --wheels"),
    ],
)
def test_what_is_wrong_with_markers_is_said(tmp_path: Path, change: Callable[[Nodes], Nodes], said: str) -> None:
    path = written(tmp_path / "car.glb", change(nodes()))
    with pytest.raises(UserError, match=said):
        read_marked(path)


def test_names_serve_as_well_as_numbers(tmp_path: Path) -> None:
    parts = renamed("kp_24", "kp_hood_front_right")(nodes())
    np.testing.assert_allclose(read_marked(written(tmp_path / "car.glb", parts)).points, SEDAN.points, atol=2e-3)


def test_wheels_can_be_named(tmp_path: Path) -> None:
    parts = nodes()
    for corner in WHEEL_CORNERS:
        parts = renamed(f"wheel_{corner}", f"round_{corner}")(parts)
    path = written(tmp_path / "car.glb", parts)
    names = {corner: f"round_{corner}" for corner in WHEEL_CORNERS}
    np.testing.assert_allclose(read_marked(path, wheels=names).points, SEDAN.points, atol=2e-3)
    with pytest.raises(UserError, match="--wheels: no object nothing"):
        read_marked(path, wheels={**names, "front_left": "nothing"})


@pytest.mark.parametrize(
    ("scale", "unit"), [(1000.0, "millimetres: --scale 0.001"), (1 / 0.0254, "inches: --scale 0.0254")]
)
def test_another_unit_is_recognised(tmp_path: Path, scale: float, unit: str) -> None:
    path = written(tmp_path / "car.glb", nodes(), scale=scale)
    with pytest.raises(UserError, match=unit):
        read_marked(path)


def test_axes_are_held_against_the_markers(tmp_path: Path) -> None:
    path = written(tmp_path / "car.glb", nodes())
    assert read_marked(path, up="+y", forward="-z").points.shape == (33, 3)
    with pytest.raises(UserError, match=r"--forward \+z: the markers say -z"):
        read_marked(path, forward="+z")
    with pytest.raises(UserError, match="--up: expected an axis"):
        read_marked(path, up="above")


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("none.glb", None, "no such file"),
        ("car.stl", b"x", r"expected a \.glb"),
        ("car.glb", b"broken", "not a readable model|holds no surfaces"),
        ("car.obj", b"", "not a readable model|holds no surfaces"),
    ],
)
def test_files_that_are_no_models_are_refused(tmp_path: Path, name: str, data: bytes | None, said: str) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(UserError, match=said):
        read_marked(tmp_path / name)


def test_a_material_s_name_makes_a_lamp(tmp_path: Path) -> None:
    """Also of a copy, as Blender numbers it; lamps of the renderer and of the check have the same names."""
    path, scene = tmp_path / "car.glb", trimesh.Scene()
    parts = nodes()
    for x, name in ((2.2, "headlight"), (-2.2, "brake_light.002")):
        lamp = trimesh.creation.box(bounds=[[x - 0.05, 0.5, 0.6], [x + 0.05, 0.7, 0.7]])
        material = trimesh.visual.material.PBRMaterial(name=name, baseColorFactor=(255, 0, 0))
        lamp.visual = trimesh.visual.TextureVisuals(material=material)
        parts[f"box {name}"] = lamp
    for name, part in parts.items():
        part.vertices = part.vertices @ GLTF.T
        scene.add_geometry(part, node_name=name, geom_name=name)
    scene.export(path)
    mesh = read_marked(path).mesh
    assert {"headlight", "brake_light"} == {name for name in mesh.materials if not name.startswith("#")}
    for name, end in (("headlight", 1), ("brake_light", -1)):
        corners = mesh.vertices[mesh.triangles[mesh.material == mesh.materials.index(name)]]
        assert len(corners) == 12
        assert (np.sign(corners[..., 0]) == end).all()
    assert set(LAMP_MATERIALS) == set(vehicle_checks.LAMP_PARTS) <= set(traffic_lights._LAMP_KINDS)
