import numpy as np
import pytest

from skope.camera.model import Camera
from skope.gen.bystanders import bystander
from skope.gen.bystanders.people import Look
from skope.gen.render.pixel_windows import hull_of, may_be_seen, window_of
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import Body
from tests.gen.scenes import pose

CAMERA = Camera.looking([0, 0, 7], yaw=0, pitch_down=0.3, size=(320, 180))


@pytest.mark.parametrize("model", sorted(fleet()))
def test_no_part_sticks_out_of_a_vehicle_so_far_that_it_is_missed(model: str) -> None:
    vehicle = fleet()[model].vehicle
    check_extent(vehicle)
    rng = np.random.default_rng(2)
    for x, y, yaw in rng.uniform([-20, -40, 0], [60, 40, 6.3], (200, 3)):
        T = pose(x, y, yaw)
        if window_of(hull_of(vehicle, T, CAMERA), CAMERA) is not None:
            assert may_be_seen(vehicle, T, CAMERA)


@pytest.mark.parametrize("kind", ["pedestrian", "cyclist", "motorcyclist"])
def test_nor_does_any_of_a_bystander(kind: str) -> None:
    check_extent(bystander.build(kind, Look.drawn(np.random.default_rng(1)).to_dict()))


def test_what_is_far_from_the_image_is_not_seen() -> None:
    vehicle = fleet()["sedan"].vehicle
    assert may_be_seen(vehicle, pose(20, 0, 1), CAMERA)
    assert not may_be_seen(vehicle, pose(-20, 0, 1), CAMERA)
    assert not may_be_seen(vehicle, pose(20, 60, 1), CAMERA)


def check_extent(body: Body) -> None:
    """Everything lies within 0.9 m around the box of the dimensions."""
    length, width, height = body.size_lwh
    low, high = body.extent
    assert (low > np.array([-length / 2, -width / 2, 0]) - 0.9).all()
    assert (high < np.array([length / 2, width / 2, height]) + 0.9).all()
