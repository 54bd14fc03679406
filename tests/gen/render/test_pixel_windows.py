import numpy as np
import pytest

from skope.camera.model import Camera
from skope.gen.bystanders import bystander
from skope.gen.bystanders.people import Look
from skope.gen.render.pixel_windows import hull_of, may_be_seen, window_of
from skope.gen.vehicles import trailer_motion
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import Body, Vehicle
from skope.gen.vehicles.trailer_motion import DrivenTrailer
from tests.gen.scenes import pose

CAMERA = Camera.looking([0, 0, 7], yaw=0, pitch_down=0.3, size=(320, 180))


@pytest.mark.parametrize("model", sorted(fleet()))
def test_no_part_sticks_out_of_a_vehicle_so_far_that_it_is_missed(model: str) -> None:
    vehicle = fleet()[model].vehicle
    check_extent(vehicle)
    rng = np.random.default_rng(2)
    for x, y, yaw in rng.uniform([-20, -40, 0], [60, 40, 6.3], (200, 3)):
        T = parts(vehicle, x, y, yaw, rng.uniform(-0.7, 0.7))
        if window_of(hull_of(vehicle, T, CAMERA), CAMERA) is not None:
            assert may_be_seen(vehicle, T, CAMERA)


@pytest.mark.parametrize("kind", ["pedestrian", "cyclist", "motorcyclist"])
def test_nor_does_any_of_a_bystander(kind: str) -> None:
    check_extent(bystander.build_bystander(kind, Look.drawn(np.random.default_rng(1)).to_dict()))


def test_what_is_far_from_the_image_is_not_seen() -> None:
    vehicle = fleet()["sedan"].vehicle
    assert may_be_seen(vehicle, parts(vehicle, 20, 0, 1), CAMERA)
    assert not may_be_seen(vehicle, parts(vehicle, -20, 0, 1), CAMERA)
    assert not may_be_seen(vehicle, parts(vehicle, 20, 60, 1), CAMERA)


def test_of_an_articulated_vehicle_the_trailer_alone_may_be_seen() -> None:
    vehicle = fleet()["articulated_curtain"].vehicle
    ahead = parts(vehicle, -4.0, 0.0, np.pi)  # past the camera, its trailer before it
    assert may_be_seen(vehicle, ahead, CAMERA)
    assert window_of(hull_of(vehicle, ahead, CAMERA), CAMERA) is not None
    assert not may_be_seen(fleet()["sedan"].vehicle, ahead, CAMERA)


def parts(vehicle: Vehicle, x: float, y: float, yaw: float, bend: float = 0.0) -> np.ndarray:
    """(8, 4, 4) poses of a standing vehicle's parts."""
    T = pose(x, y, yaw)
    return np.concatenate(
        [np.tile(T, (5, 1, 1)), trailer_motion.trailer_poses(vehicle, DrivenTrailer(yaw + bend, 0.0, 0.0), T)]
    )


def check_extent(body: Body) -> None:
    """Everything lies within 0.9 m around the box of the dimensions."""
    if body.trailer:
        assert (body.trailer.extent[0] > body.trailer.corners[0] - 0.9).all()
        assert (body.trailer.extent[1][1:] < body.trailer.corners[1][1:] + 0.9).all()
    length, width, height = body.size_lwh
    low, high = body.extent
    # Bellows reach over the hinge into the box of the other part.
    over = body.shape.hinge_gap if body.trailer else 0.0
    assert (low > np.array([-length / 2 - over, -width / 2, 0]) - 0.9).all()
    assert (high < np.array([length / 2, width / 2, height]) + 0.9).all()
