import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.errors import UserError
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import LAMP_BITS, RecordingPlan
from skope.gen.scene.variation import Variation
from skope.gen.scenery.build import bays_of
from skope.gen.simulation.physics import World, at_rest
from skope.gen.simulation.recorder import Recorder, parked_vehicles
from skope.gen.simulation.simulate import _models, simulate
from skope.gen.simulation.smooth_paths import Driven
from skope.gen.towns.land_use import LAND_USE
from skope.gen.towns.sites import site
from skope.gen.towns.town import Town
from skope.gen.traffic.demand import RIDER_CLASSES, Trip, in_town, trips
from skope.gen.traffic.sumo import SUMO_STEPS, Traffic
from skope.gen.vehicles.fleet import FleetEntry, fleet
from tests.gen.scenes import driven

SEDAN = fleet()["sedan"].vehicle


def drive(path: list[Driven]) -> list:
    """Poses of a sedan driven along a path of steps."""
    out = []
    with World(SUMO_STEPS.default_s) as world:
        for state in path:
            world.advance({"car": (SEDAN, state)})
            out.append(world.poses()["car"])
    return out


def straight(speeds: np.ndarray) -> list[Driven]:
    x = np.concatenate([[0], np.cumsum(speeds[:-1]) * SUMO_STEPS.default_s])
    return [Driven((float(a), 2.0, 0.0), 0.0, 0.0, float(v), 0) for a, v in zip(x, speeds, strict=True)]


def test_a_standing_car_stands_on_the_road() -> None:
    pose = drive(straight(np.zeros(80)))[-1]
    np.testing.assert_allclose(
        pose.T_world_chassis, [[1, 0, 0, 0], [0, 1, 0, 2], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-6
    )
    expected = SEDAN.shape.wheel_centers() + np.array([0, 2, 0])
    np.testing.assert_allclose(pose.T_world_wheels[:, :3, 3], expected, atol=1e-6)


def test_wheels_roll_without_slip() -> None:
    poses = drive(straight(np.full(120, 8.0)))
    turned = np.unwrap([math.atan2(p.T_world_wheels[2, 0, 2], p.T_world_wheels[2, 0, 0]) for p in poses])
    rolled = (turned[-1] - turned[20]) * SEDAN.shape.wheel_radius
    distance = poses[-1].T_world_chassis[0, 3] - poses[20].T_world_chassis[0, 3]
    assert rolled == pytest.approx(distance, rel=0.02)


def test_a_newcomer_has_its_velocity_from_the_first_step() -> None:
    velocities = [pose.velocity for pose in drive(straight(np.full(3, 8.0)))]
    np.testing.assert_allclose(velocities, [[8, 0, 0]] * 3, atol=1e-9)


def test_each_wheel_rolls_what_its_own_place_travels() -> None:
    speed, radius = 5.0, 12.0
    angle = np.arange(200) * SUMO_STEPS.default_s * speed / radius
    # The middle of the rear axle is on the circle.
    middle = -SEDAN.shape.rear_axle_x
    path = [
        Driven(
            (radius * math.sin(a) + middle * math.cos(a), -radius * math.cos(a) + middle * math.sin(a), 0.0),
            *(float(a), 0.0, speed, 0),
        )
        for a in angle
    ]
    poses = drive(path)
    for wheel, (x, y) in enumerate(SEDAN.shape.wheel_centers()[:, :2]):
        own = math.hypot(radius - y, x - SEDAN.shape.rear_axle_x)
        rolled = []
        for pose in poses[100:]:
            chassis, T = pose.T_world_chassis, pose.T_world_wheels[wheel]
            axle = T[:3, 1]
            up = np.array([0.0, 0.0, 1.0]) - axle[2] * axle
            ahead = np.cross(axle, up / np.linalg.norm(up))
            rolled.append(math.atan2(-(T[:3, 0] @ up), T[:3, 0] @ ahead))
            assert chassis[2, 2] > 0.99
        travelled = (np.unwrap(rolled)[-1] - np.unwrap(rolled)[0]) * SEDAN.shape.wheel_radius
        assert abs(travelled) == pytest.approx(own * (angle[-1] - angle[100]), rel=0.02)


def test_braking_dips_the_nose_and_accelerating_lifts_it() -> None:
    braking = drive(straight(np.concatenate([np.full(80, 15.0), np.linspace(15, 5, 100)])))  # 4 m/s^2
    nose = [math.degrees(math.asin(p.T_world_chassis[2, 0])) for p in braking]
    assert nose[70] == pytest.approx(0, abs=0.01)
    assert -1.2 < nose[-1] < -0.5  # 2 degrees per g
    lifting = drive(straight(np.linspace(0, 6, 120)))[-1]
    assert lifting.T_world_chassis[2, 0] > 0


def test_a_left_turn_leans_the_body_to_the_right_and_steers_left() -> None:
    speed, radius = 8.0, 20.0
    angle = np.arange(160) * SUMO_STEPS.default_s * speed / radius
    path = [Driven((radius * math.sin(a), radius * (1 - math.cos(a)), 0.0), float(a), 0.0, speed, 0) for a in angle]
    pose = drive(path)[-1]
    left_side_up = pose.T_world_chassis[2, 1]
    assert math.radians(1) < math.asin(left_side_up) < math.radians(3)  # 5 degrees per g at 0.33 g
    heading = math.atan2(pose.T_world_chassis[1, 0], pose.T_world_chassis[0, 0])
    for wheel, side in ((0, -1), (1, 1)):
        axle = pose.T_world_wheels[wheel, :3, 1]
        steer = math.remainder(math.atan2(-axle[0], axle[1]) - heading, 2 * math.pi)
        expected = math.atan(SEDAN.shape.wheelbase / (radius - side * SEDAN.shape.track / 2))
        assert steer == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("kick", [0.02, 0.1, -0.3])
def test_a_vehicle_that_is_turned_within_a_step_leans_no_further_than_tyres_hold(kick: float) -> None:
    """As SUMO turns them where lanes meet a junction."""
    path = straight(np.full(240, 14.0))
    for i in range(100, 120):
        yaw = kick * (i - 99) / 4 if i < 104 else kick
        path[i] = Driven(path[i].position, yaw, 0.0, 14.0, 0)
    leans = [math.degrees(math.asin(p.T_world_chassis[2, 1])) for p in drive(path)]
    assert 0.1 < max(map(abs, leans)) < 6


def test_the_body_follows_its_path() -> None:
    recording = driven()
    for frame in range(len(recording)):
        moment = recording.moment(frame).labelled()
        drives = np.array([not vehicle.parked for vehicle in moment.vehicles])
        assert np.abs(moment.T_world_chassis[drives, 2, 3]).max() < 0.05  # heave
        tilt = np.degrees(np.arccos(np.clip(moment.T_world_chassis[:, 2, 2], -1, 1)))
        assert tilt.max() < 8
        radii = [vehicle.shape["wheel_radius"] for vehicle in moment.vehicles if not vehicle.parked]
        heights = moment.T_world_wheels[drives, :, 2, 3]
        np.testing.assert_allclose(heights, np.tile(np.array(radii)[:, None], (1, 4)), atol=0.02)


def test_sumo_front_bumper_and_compass_are_converted() -> None:
    """Vehicles that drive east on Main Street: SUMO's own numbers against ours."""
    import libsumo

    rng = np.random.default_rng(0)
    with Traffic(Town("town01").network, fleet(), vehicles_per_hour=3000, duration=40, rng=rng) as traffic:
        for _ in range(round(30 / SUMO_STEPS.default_s)):
            snapshot = traffic.step()
        checked = 0
        for name, state in snapshot.vehicles.items():
            if libsumo.vehicle.getRoadID(name) == "main_west_in" and libsumo.vehicle.getDistance(name) > 20:
                front = np.array(libsumo.vehicle.getPosition(name))
                # East is 90 degrees of the compass; within a lane vehicles also move sideways.
                assert libsumo.vehicle.getAngle(name) == pytest.approx(90, abs=5)
                assert state.yaw == pytest.approx(math.radians(90 - libsumo.vehicle.getAngle(name)), abs=1e-9)
                shape = fleet()[traffic.trips[name].model].vehicle.shape
                back = shape.front_overhang + (1 - math.sqrt(0.5)) * shape.wheelbase
                assert state.lane_point[0] == pytest.approx(front[0] - back, abs=0.01)
                assert state.lane_point[1] == pytest.approx(front[1], abs=0.5)
                checked += 1
        assert checked > 1


def test_one_seed_one_recording(tmp_path: Path) -> None:
    plan = RecordingPlan(
        site=site("t01_mill_corner"), index=0, frames=4, interval=0.5, size=(640, 360), fov_deg=110, seed=3
    )
    recordings.save(tmp_path / "a.npz", simulate(plan))
    recordings.save(tmp_path / "b.npz", driven())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_another_seed_is_another_recording() -> None:
    other = driven(seed=4)
    assert len(other.frame) != len(driven().frame) or not np.allclose(other.T_world_chassis, driven().T_world_chassis)


def test_recordings_survive_the_disk(tmp_path: Path) -> None:
    recording = driven()
    recordings.save(tmp_path / "r.npz", recording)
    again = recordings.load(tmp_path / "r.npz")
    np.testing.assert_array_equal(again.T_world_wheels, recording.T_world_wheels)
    assert again.vehicles == recording.vehicles
    assert again.signals == recording.signals
    assert again.moment(2).time_s == 1.0
    np.testing.assert_array_equal(again.camera.T_camera_world, recording.camera.T_camera_world)


def test_vehicles_have_tracks_colours_and_lamps() -> None:
    recording = driven("t01_mill_south", frames=6)
    tracks = [vehicle.track_id for vehicle in recording.vehicles]
    assert tracks == sorted(set(tracks))
    assert len({vehicle.model for vehicle in recording.vehicles}) >= 3
    assert len({vehicle.color for vehicle in recording.vehicles}) >= 3
    moments = [recording.moment(f) for f in range(len(recording))]
    speeds = np.concatenate([np.linalg.norm(m.velocity, axis=1) for m in moments])
    lamps = np.concatenate([m.lamps for m in moments])
    assert (speeds < 0.1).any()
    assert (speeds > 5).any()
    assert (lamps & LAMP_BITS["brake"]).any()
    assert not (lamps & LAMP_BITS["brake"]).all()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not really", b"hello"])
def test_broken_recordings_are_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "broken.npz").write_bytes(content)
    with pytest.raises(UserError, match=r"broken\.npz"):
        recordings.load(tmp_path / "broken.npz")


def test_a_vehicle_far_away_stands_where_the_engine_would_have_it() -> None:
    for pitch in (0.0, 0.08):
        state = Driven((3.0, 4.0, 1.0), 0.7, pitch, 0.0, 0)
        with World(SUMO_STEPS.default_s) as world:
            for _ in range(120):
                world.advance({"car": (SEDAN, state)})
            engine = world.poses()["car"]
        resting = at_rest(SEDAN, state)
        np.testing.assert_allclose(resting.T_world_wheels[..., 3], engine.T_world_wheels[..., 3], atol=0.005)
        np.testing.assert_allclose(resting.T_world_chassis, engine.T_world_chassis, atol=0.01)


def test_vehicles_that_are_not_watched_yet_come_into_view_as_if_they_had_been_watched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = RecordingPlan(
        site=site("t05_park_third"), index=0, frames=20, interval=0.5, size=(640, 360), fov_deg=60, seed=0
    )
    followed = []
    from_afar = Traffic._vehicle_state
    monkeypatch.setattr(Traffic, "_vehicle_state", lambda self, name: followed.append(name) or from_afar(self, name))
    usual, asked = simulate(plan), len(followed)
    monkeypatch.setattr(Recorder, "watches", lambda *_: True)
    everyone = simulate(plan)
    assert 0 < asked < len(followed) - asked
    np.testing.assert_array_equal(usual.frame, everyone.frame)
    assert usual.vehicles == everyone.vehicles
    np.testing.assert_allclose(usual.T_world_chassis, everyone.T_world_chassis, atol=0.01)
    np.testing.assert_allclose(usual.velocity, everyone.velocity, atol=0.05)


@pytest.mark.parametrize(("share", "expected"), [(0.2, 0.2), (0.75, 0.75), (1.0, 1.0)])
def test_models_that_were_asked_for_make_their_share_of_the_traffic(share: float, expected: float) -> None:
    """Counted among the vehicles that set out in ten hours."""
    names = ("suv", "bus")
    plan = RecordingPlan(
        site=site("t01_mill_corner"),
        index=0,
        frames=1,
        interval=0.5,
        size=(640, 360),
        fov_deg=60,
        seed=0,
        vehicles=names,
        vehicle_share=share,
    )
    rng = np.random.default_rng(1)
    models = _models(plan)
    drawn = [
        trip.model
        for trip in trips(plan.site.town.network, models, vehicles_per_hour=600.0, duration=36000.0, rng=rng)
        if trip.model in models
    ]
    for name in names:
        assert drawn.count(name) / len(drawn) == pytest.approx(expected / 2, abs=0.02)
    usual = _models(replace(plan, vehicles=(), vehicle_share=None))
    if share < 1:  # what the others are to each other stays as it was
        assert models["van"].share / models["sedan"].share == usual["van"].share / usual["sedan"].share


FURTHER = Variation(further_models=True)


def planned(**changes: Any) -> RecordingPlan:
    values = {"index": 0, "frames": 1, "interval": 0.5, "size": (640, 360), "fov_deg": 60.0, "seed": 0}
    return RecordingPlan(**{"site": site("t01_main_west"), **values, **changes})


def test_further_models_drive_only_where_they_are_asked_for() -> None:
    plain, more = _models(planned()), _models(planned(variation=FURTHER))
    assert plain == in_town(fleet(further=False), "town01")
    assert plain.keys() < more.keys() == fleet().keys()
    for models in (plain, more):
        # What a type has of the traffic does not depend on how many models it has.
        total = sum(entry.share for entry in models.values())
        trucks = sum(entry.share for entry in models.values() if entry.vehicle.vehicle_type == "truck")
        assert trucks / total == pytest.approx(0.02, abs=0.001)


def test_further_models_that_are_held_out_never_drive_past_sites_for_training() -> None:
    train, test = (
        _models(planned(site=site(name), variation=FURTHER)) for name in ("t01_mill_corner", "t01_main_west")
    )
    held_out = {name for name, entry in fleet().items() if entry.held_out}
    assert not train.keys() & held_out
    assert test.keys() - train.keys() == held_out
    assert train.keys() & {name for name, entry in fleet().items() if entry.further}


def test_traffic_without_further_models_sets_out_as_before_there_were_any() -> None:
    """The trips that are drawn from the fleet's first part, with one seed."""
    plan = planned()

    def drawn(models: Mapping[str, FleetEntry]) -> list[Trip]:
        rng = np.random.default_rng(4)
        return list(trips(plan.site.town.network, models, vehicles_per_hour=600.0, duration=3600.0, rng=rng))

    assert drawn(_models(plan)) == drawn(in_town(fleet(further=False), "town01"))
    more = drawn(_models(replace(plan, variation=FURTHER)))
    assert {trip.model for trip in more} - set(RIDER_CLASSES) - fleet(further=False).keys()


def test_a_further_model_can_be_asked_for_where_others_do_not_drive() -> None:
    models = _models(planned(vehicles=("truck_mixer",), vehicle_share=0.25))
    assert models.keys() - fleet(further=False).keys() == {"truck_mixer"}
    assert models["truck_mixer"].share / sum(entry.share for entry in models.values()) == pytest.approx(0.25)


def test_some_further_models_park() -> None:
    town = Town("town01")
    models = {name: entry for name, entry in fleet().items() if entry.further}
    standing = {
        one.model for one in parked_vehicles(town, bays_of(town) * 3, models, np.random.default_rng(0), most=200)
    }
    assert standing
    assert all(models[name].vehicle.size_lwh[0] < LAND_USE.bay_m[0] + 0.2 for name in standing)


def test_models_that_drive_when_asked_for_drive_then_alone() -> None:
    plan = RecordingPlan(
        site=site("t01_mill_corner"), index=0, frames=1, interval=0.5, size=(640, 360), fov_deg=60, seed=0
    )
    further = {name for name, entry in fleet().items() if entry.further}
    assert further
    assert not further & _models(plan).keys()
    asked = _models(replace(plan, vehicles=("articulated_bus",)))
    assert further & asked.keys() == {"articulated_bus"}
    others = sum(entry.share for name, entry in asked.items() if name not in further)
    assert asked["articulated_bus"].share == pytest.approx(0.1 * others)


def test_where_all_vehicles_are_too_long_for_a_bay_none_is_parked() -> None:
    town, bus = Town("town01"), {"bus": fleet()["bus"]}
    assert parked_vehicles(town, bays_of(town)[:20], bus, np.random.default_rng(0)) == []
