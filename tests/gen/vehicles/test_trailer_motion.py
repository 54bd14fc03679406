"""Trailers that follow a hinge: against closed forms, and against small steps of the differential equation."""

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from skope.gen.simulation.physics import World, at_rest
from skope.gen.simulation.smooth_paths import Driven, drivable
from skope.gen.towns.town import Town
from skope.gen.traffic.demand import write_types
from skope.gen.traffic.sumo import SUMO_STEPS, Chassis, Snapshot, SumoTrailer, SumoVehicle, Traffic
from skope.gen.vehicles import trailer_motion
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import straight_lwh
from skope.gen.vehicles.trailer_motion import DrivenTrailer, Follower, Hitch

LORRY = fleet()["articulated_curtain"].vehicle
MODELS = [name for name, entry in fleet().items() if entry.vehicle.trailer]
AXLE = 7.7


def hitch(bend_deg: float = 180.0) -> Hitch:
    return Hitch(0.6, AXLE, math.radians(bend_deg))


@pytest.mark.parametrize("step", [0.01, 0.3, 5.0])
def test_behind_a_straight_way_the_angle_decays_exponentially(step: float) -> None:
    follower, start = Follower(hitch(), 0.0, 0.0, math.radians(70)), math.radians(70)
    for k in range(1, round(30 / step) + 1):
        follower.follow(k * step, 0.0, 0.0)
        expected = 2 * math.atan(math.tan(start / 2) * math.exp(-k * step / AXLE))
        assert follower.yaw == pytest.approx(expected, abs=1e-9)
    # For small angles that is the exponential itself.
    before = follower.yaw
    follower.follow(30.0 + AXLE, 0.0, 0.0)
    assert follower.yaw == pytest.approx(before / math.e, rel=0.01)


@pytest.mark.parametrize("side", [-1, 1])
def test_on_a_circle_the_trailer_comes_to_the_angle_of_the_triangle(side: int) -> None:
    """Its axle runs on the circle of radius sqrt(R^2 - L^2) about the same centre: sin(angle) = L / R."""
    radius = 12.5
    follower = Follower(hitch(), radius, 0.0, side * math.pi / 2)
    angle = 0.0
    while angle < 12:
        angle += 0.002
        follower.follow(radius * math.cos(angle), side * radius * math.sin(angle), 0.0)
    course = side * (angle + math.pi / 2)
    assert math.remainder(course - follower.yaw, 2 * math.pi) == pytest.approx(
        side * math.asin(AXLE / radius), abs=1e-3
    )
    place = np.array([radius * math.cos(angle), side * radius * math.sin(angle)])
    axle = place - AXLE * np.array([math.cos(follower.yaw), math.sin(follower.yaw)])
    assert np.linalg.norm(axle) == pytest.approx(math.sqrt(radius**2 - AXLE**2), abs=0.01)


def test_the_axle_rolls_along_its_heading_as_far_as_it_says() -> None:
    """Any way, in small steps: the axle hardly moves sideways, and forwards by what has rolled."""
    follower = Follower(hitch(), 0.0, 0.0, 0.3)
    axles, headings = [], []
    for t in np.linspace(0, 6, 6001):
        follower.follow(8 * t, 3 * math.sin(t), 0.0)
        headings.append(follower.yaw)
        axles.append(
            np.array([8 * t, 3 * math.sin(t)]) - AXLE * np.array([math.cos(headings[-1]), math.sin(headings[-1])])
        )
    moves, middle = np.diff(axles, axis=0), (np.array(headings[1:]) + headings[:-1]) / 2
    along = (moves * np.column_stack([np.cos(middle), np.sin(middle)])).sum(axis=1)
    aside = (moves * np.column_stack([-np.sin(middle), np.cos(middle)])).sum(axis=1)
    assert np.abs(aside).max() < 1e-6
    assert along.sum() == pytest.approx(follower.rolled, abs=1e-4)


def test_it_bends_no_further_than_it_can() -> None:
    follower = Follower(hitch(50.0), 0.0, 0.0, 0.0)
    for angle in np.linspace(0, math.pi, 200):
        follower.follow(2.0 * math.sin(angle), 2.0 - 2.0 * math.cos(angle), float(angle))
        assert abs(math.remainder(follower.yaw - angle, 2 * math.pi)) <= math.radians(50) + 1e-9
    assert math.remainder(follower.yaw - math.pi, 2 * math.pi) == pytest.approx(-math.radians(50))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("slope", [0.0, 0.06])
def test_both_parts_share_the_hinge_and_the_trailer_stands_on_the_road(model: str, slope: float) -> None:
    vehicle = fleet()[model].vehicle
    yaw, bend = 0.7, -0.5
    heading = np.array([math.cos(yaw + bend), math.sin(yaw + bend)])
    ahead = np.array([math.cos(yaw), math.sin(yaw)])

    def height(place: np.ndarray) -> float:
        return slope * float(place @ ahead)

    position = (3.0, 4.0, height(np.array([3.0, 4.0])))
    hinge = np.array([3.0, 4.0]) + vehicle.trailer.hinge[0] * math.cos(math.atan(slope)) * ahead
    axles = hinge - vehicle.trailer.axle * heading
    driven = Driven(position, yaw, math.atan(slope), 0.0, 0, DrivenTrailer(yaw + bend, height(axles), 5.0))
    pose = at_rest(vehicle, driven)
    T, T_trailer = pose.T_world_chassis, pose.T_world_trailer[0]
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(T_trailer[:3, :3] @ T_trailer[:3, :3].T, np.eye(3), atol=1e-12)
    first = T[:3, :3] @ vehicle.trailer.hinge + T[:3, 3]
    second = T_trailer[:3, :3] @ [0, 0, vehicle.trailer.hinge[2]] + T_trailer[:3, 3]
    np.testing.assert_allclose(first, second, atol=1e-12)
    for T_wheel in pose.T_world_trailer[1:]:
        road = height(T_wheel[:2, 3])
        assert T_wheel[2, 3] - road == pytest.approx(vehicle.shape.wheel_radius, abs=0.1 if slope else 1e-9)
    turned = math.atan2(T_trailer[1, 0], T_trailer[0, 0]) - math.atan2(T[1, 0], T[0, 0])
    assert turned == pytest.approx(bend)


def lorry_on(places: list[tuple[float, float, float]], speed: float) -> list[Driven]:
    """How a lorry drives whose lane point SUMO has at places (x, y, heading), a step apart; straight at first."""
    chassis, start = Chassis.of(LORRY), places[0][2]
    states = [
        SumoVehicle(chassis, (x, y), speed * k * SUMO_STEPS.default_s, 0.0, yaw, 0.0, speed, 0, SumoTrailer(start, 0.0))
        for k, (x, y, yaw) in enumerate(places)
    ]
    snapshots = (Snapshot(k * SUMO_STEPS.default_s, {"lorry": state}, {}, {}) for k, state in enumerate(states))
    return [driven["lorry"] for _, driven in drivable(snapshots, SUMO_STEPS.default_s)]


def test_a_lorry_in_a_roundabout_has_the_angle_of_its_triangles() -> None:
    """The hinge is ahead of the rear axle, whose circle is that of the lane point less its distance."""
    radius, speed = 25.0, 6.0
    turn = speed * SUMO_STEPS.default_s / radius
    places = [
        (radius * math.sin(k * turn), radius * (1 - math.cos(k * turn)), k * turn)
        for k in range(round(30 / SUMO_STEPS.default_s))
    ]
    state, chassis = lorry_on(places, speed)[-1], Chassis.of(LORRY)
    rear = math.sqrt(radius**2 - chassis.lane_point**2)
    hinge = math.hypot(rear, chassis.hitch.hinge)
    expected = math.atan(chassis.hitch.hinge / rear) - math.asin(chassis.hitch.axle / hinge)
    assert math.remainder(state.trailer.yaw - state.yaw, 2 * math.pi) == pytest.approx(expected, abs=0.003)


def test_the_engine_draws_the_trailer_along() -> None:
    path = lorry_on([(10.0 * k * SUMO_STEPS.default_s, 0.0, 0.0) for k in range(round(6 / SUMO_STEPS.default_s))], 10.0)
    poses = []
    with World(SUMO_STEPS.default_s) as world:
        for state in path:
            world.advance({"lorry": (LORRY, state)})
            poses.append(world.poses()["lorry"])
    T = np.array([pose.T_world_trailer for pose in poses[20:]])
    steps = np.diff(T[:, 0, 0, 3])
    np.testing.assert_allclose(steps, 10.0 * SUMO_STEPS.default_s, atol=0.004)
    spin = np.unwrap(np.arctan2(T[:, 1, 0, 2], T[:, 1, 0, 0]))
    np.testing.assert_allclose(np.diff(spin) * LORRY.shape.wheel_radius, 10.0 * SUMO_STEPS.default_s, atol=0.004)


def test_sumo_knows_the_whole_length(tmp_path: Path) -> None:
    path = tmp_path / "types.xml"
    write_types(path, fleet())
    lengths = {row.get("id"): float(row.get("length", 0)) for row in ElementTree.parse(path).getroot()}
    assert lengths["articulated_curtain.calm"] == pytest.approx(16.5, abs=0.01)
    assert lengths["sedan.calm"] == pytest.approx(fleet()["sedan"].vehicle.size_lwh[0], abs=1e-3)
    for model in MODELS:
        assert lengths[f"{model}.calm"] == pytest.approx(straight_lwh(fleet()[model].vehicle)[0], abs=1e-3)


def test_trailers_follow_before_anybody_watches() -> None:
    """In SUMO's own curves they hang bent from the first step that is reported, towards where the vehicle came from."""
    models = {"articulated_bus": fleet()["articulated_bus"]}
    rng = np.random.default_rng(1)
    begun = False
    with Traffic(
        Town("town01").network, models, vehicles_per_hour=1500, duration=60, rng=rng, watched=lambda x, y: begun
    ) as traffic:
        traffic.warm_up(round(45 / SUMO_STEPS.default_s))
        begun = True
        first = {}
        for snapshot in traffic.steps(round(15 / SUMO_STEPS.default_s)):
            for name, state in snapshot.vehicles.items():
                first.setdefault(name, state)
    bends = [math.remainder(state.trailer.yaw - state.yaw, 2 * math.pi) for state in first.values()]
    assert len(bends) > 5
    assert max(map(abs, bends)) > math.radians(10)
    assert min(map(abs, bends)) < math.radians(1)


def test_what_has_no_trailer_has_poses_of_none() -> None:
    sedan = fleet()["sedan"].vehicle
    assert trailer_motion.trailer_poses(sedan, None, np.eye(4)) is trailer_motion.NO_TRAILER
    assert Hitch.of(sedan) is None
