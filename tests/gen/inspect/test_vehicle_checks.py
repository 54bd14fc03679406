"""Models broken on purpose, one way at a time: the check must name each."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skope import keypoints
from skope.gen.inspect.vehicle_models import distance_to_surface, findings
from skope.gen.mesh import Mesh
from skope.gen.vehicles.fleet import build_vehicle, fleet, jittered
from skope.gen.vehicles.model import Sidecar, Vehicle
from tests.gen.rays import distance_to_triangles
from tests.gen.thirds import a_third


class Broken:
    """A vehicle with some of its attributes replaced."""

    def __init__(self, vehicle: Vehicle, **changed: Any) -> None:
        self._vehicle, self._changed = vehicle, changed

    def __getattr__(self, name: str) -> Any:
        return self._changed[name] if name in self._changed else getattr(self._vehicle, name)


SEDAN = fleet()["sedan"].vehicle
K = keypoints.INDEX


def moved(name: str, offset: tuple[float, float, float]) -> np.ndarray:
    points = SEDAN.points.copy()
    points[K[name]] += offset
    return points


def swapped(a: str, b: str) -> np.ndarray:
    points = SEDAN.points.copy()
    points[[K[a], K[b]]] = points[[K[b], K[a]]]
    return points


def turned(mesh: Mesh) -> Mesh:
    return replace(mesh, triangles=mesh.triangles[:, ::-1])


def without(mesh: Mesh, material: str) -> Mesh:
    number = mesh.materials.index(material)
    return mesh.taken(mesh.material != number)


@pytest.mark.parametrize("model", a_third(sorted(fleet())))
def test_every_model_passes(model: str) -> None:
    vehicle = fleet()[model].vehicle
    assert list(map(str, findings(vehicle))) == []


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"points": moved("hood_front_left", (0, 0, 0.03))}, "hood_front_left is 2."),
        ({"points": moved("front_logo", (0.5, 0, 0))}, "front_logo is inf cm off the surface"),
        ({"points": moved("mirror_left", (0, 0.006, 0))}, "is 0.6 cm off the mirror image of its twin"),
        (
            {"points": moved("bumper_front_left", (-0.05, -0.15, 0))},
            "bumper_front_left lies 14 cm inside the bumper's",
        ),
        ({"points": swapped("mirror_left", "mirror_right")}, "mirror_right is on the left"),
        ({"points": moved("wheel_front_left", (0.02, 0, 0))}, "wheel_front_left is not the centre of its wheel"),
        ({"mesh": turned(SEDAN.mesh)}, "rays from outside meet the back of a triangle"),
        ({"mesh": without(SEDAN.mesh, "brake_light")}, "no brake lamps"),
        ({"mesh": without(SEDAN.mesh, "indicator_left")}, "no left indicators"),
        ({"wheel": replace(SEDAN.wheel, vertices=SEDAN.wheel.vertices * 1.1)}, "wheel: mesh radius"),
        ({"shape": replace(SEDAN.shape, height=SEDAN.shape.height + 1)}, "shape.height: 2."),
        ({"size_lwh": (*SEDAN.size_lwh[:2], SEDAN.size_lwh[2] + 0.05)}, "mesh: height"),
        ({"shape": replace(SEDAN.shape, wheel_radius=SEDAN.shape.wheel_radius + 0.02)}, "wheel: mesh radius"),
        ({"sidecar": Sidecar(SEDAN.sidecar.distances, -SEDAN.sidecar.side)}, "sidecar: trilateration puts"),
        ({"sidecar": Sidecar(SEDAN.sidecar.distances + 0.01, SEDAN.sidecar.side)}, "sidecar: trilateration puts"),
    ],
)
def test_a_broken_model_is_found(changed: dict[str, Any], said: str) -> None:
    found = list(map(str, findings(Broken(SEDAN, **changed))))  # type: ignore[arg-type]
    assert any(said in finding for finding in found), found


def test_distances_to_surfaces_agree_with_another_way_of_working_them_out() -> None:
    rng = np.random.default_rng(1)
    triangles = SEDAN.mesh.vertices[SEDAN.mesh.triangles]
    for _ in range(40):
        point = triangles[rng.integers(len(triangles))].mean(axis=0) + rng.normal(0, 0.02, 3)
        assert distance_to_surface(point, triangles) == pytest.approx(distance_to_triangles(point, triangles), abs=1e-9)


@pytest.mark.parametrize(("model", "seed"), [("van", 9), ("suv", 9)])
def test_rod_antennas_do_not_count_in_a_height(model: str, seed: int) -> None:
    vehicle = build_vehicle(model, jittered(model, np.random.default_rng(seed)))
    assert vehicle.mesh.vertices[:, 2].max() > vehicle.size_lwh[2] + 0.1
    assert not list(findings(vehicle))


@pytest.mark.slow
@pytest.mark.parametrize("vehicle_type", sorted({entry.vehicle.vehicle_type for entry in fleet().values()}))
def test_200_shapes_of_each_type_are_without_findings(vehicle_type: str) -> None:
    models = [name for name, entry in fleet().items() if entry.vehicle.vehicle_type == vehicle_type]
    drawn = [(models[i % len(models)], i) for i in range(200)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(mp_context=context) as pool:
        found = dict(zip(drawn, pool.map(_findings_of_a_shape, drawn, chunksize=10), strict=True))
    assert {which: texts for which, texts in found.items() if texts} == {}


def _findings_of_a_shape(drawn: tuple[str, int]) -> list[str]:
    model, seed = drawn
    return [str(finding) for finding in findings(build_vehicle(model, jittered(model, np.random.default_rng(seed))))]
