import numpy as np
import pytest

from skope.camera.model import Camera
from skope.gen.labels.raycast import RayCaster, _split_in_patches
from skope.gen.labels.world_keypoints import world_keypoints
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import MODEL_PARTS
from tests.gen.rays import cast, vehicle_triangles
from tests.gen.scenes import standing


@pytest.mark.parametrize(
    "models",
    [
        ("sedan", "van", "suv"),
        ("truck_mixer", "truck_refuse", "truck_platform"),
        ("truck_tanker", "bus_school", "coach_three_axle"),
        ("box_truck_luton", "truck_container", "truck_crane"),
    ],
)
def test_first_hits_are_those_of_every_triangle_of_every_vehicle(models: tuple[str, ...]) -> None:
    camera = Camera.looking([300.0, -190.0, 5.0], yaw=0.7, pitch_down=0.3, size=(640, 360))
    # Lorries are longer than cars: they stand farther apart.
    spread = 1.0 if models[0] == "sedan" else 2.0
    around = ((6.0, 6.0, 0.3), (11.0, 8.0, 1.9), (-10.0, -10.0, 0.0))
    places = [
        (model, 300.0 + spread * x, -190.0 + spread * y, yaw) for model, (x, y, yaw) in zip(models, around, strict=True)
    ]
    moment = standing(camera, places).moment(0)
    triangles = np.concatenate([vehicle_triangles(moment, i) for i in range(3)])
    rng = np.random.default_rng(4)
    points = triangles[rng.integers(len(triangles), size=300)].mean(axis=1) + rng.normal(0, 0.3, (300, 3))
    away = points - camera.position
    expected, _ = cast(camera.position, away / np.linalg.norm(away, axis=1, keepdims=True), triangles)
    hits = RayCaster(moment, world_keypoints(moment, "rigid").vehicles, camera).first_hits(points)
    before = expected < np.linalg.norm(away, axis=1)
    assert 100 < before.sum() < 290
    np.testing.assert_allclose(hits[before], expected[before], atol=1e-6)
    np.testing.assert_array_less(np.linalg.norm(away, axis=1)[~before], hits[~before] + 1e-6)


def test_rays_meet_both_parts_of_an_articulated_vehicle_that_is_bent() -> None:
    camera = Camera.looking([300.0, -190.0, 6.0], yaw=0.7, pitch_down=0.25, size=(640, 360))
    places = [("articulated_curtain", 318.0, -178.0, 1.9), ("sedan", 310.0, -184.0, 0.3)]
    moment = standing(camera, places, bend=np.radians(30)).moment(0)
    triangles = np.concatenate([vehicle_triangles(moment, i) for i in range(2)])
    rng = np.random.default_rng(4)
    points = triangles[rng.integers(len(triangles), size=400)].mean(axis=1) + rng.normal(0, 0.3, (400, 3))
    away = points - camera.position
    length = np.linalg.norm(away, axis=1)
    expected, which = cast(camera.position, away / length[:, None], triangles)
    hits = RayCaster(moment, world_keypoints(moment, "rigid").vehicles, camera).first_hits(points)
    before = expected < length
    np.testing.assert_allclose(hits[before], expected[before], atol=1e-6)
    np.testing.assert_array_less(length[~before], hits[~before] + 1e-6)
    vehicle = fleet()["articulated_curtain"].vehicle
    ends = np.cumsum([len(part.triangles) for part in vehicle.parts])
    part = np.searchsorted(ends, which[before], side="right")
    assert (part == 0).sum() > 20
    assert (part == MODEL_PARTS.trailer_part).sum() > 20


def test_patches_hold_every_triangle_and_lie_close_together() -> None:
    places = np.random.default_rng(5).uniform(0, 1, (1000, 3))
    patches = _split_in_patches(places)
    assert patches.shape == (63, 16)
    assert set(patches.ravel()) == set(range(1000))
    assert np.median(np.ptp(places[patches], axis=1).prod(axis=1)) < 0.03


def test_a_part_of_few_or_no_triangles_has_one_patch_or_none() -> None:
    assert _split_in_patches(np.zeros((3, 3))).tolist() == [[0, 1, 2] * 5 + [0]]
    assert _split_in_patches(np.zeros((0, 3))).shape == (0, 16)
