"""Ways that vehicles can drive: against closed forms, and over sites against the velocities that are recorded."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from skope.gen.scene.recording import RecordingPlan
from skope.gen.simulation.simulate import simulate
from skope.gen.simulation.smooth_paths import PATH_SMOOTHING, Driven, drivable, reach
from skope.gen.towns.sites import site
from skope.gen.traffic.sumo import SUMO_STEPS, Chassis, Snapshot, SumoVehicle
from skope.gen.vehicles.fleet import fleet

CHASSIS = Chassis.of(fleet()["sedan"].vehicle)


def driven(place: Callable[[float], tuple[float, float, float, float]], seconds: float) -> list[Driven]:
    """How a sedan drives whose lane point is at (x, y) with a heading and a speed at each time."""
    out = []
    for _, states in drivable(
        (snapshot(place, k) for k in range(round(seconds / SUMO_STEPS.default_s))), SUMO_STEPS.default_s
    ):
        out.append(states["car"])
    return out


def snapshot(place: Callable[[float], tuple[float, float, float, float]], k: int) -> Snapshot:
    x, y, yaw, speed = place(k * SUMO_STEPS.default_s)
    return Snapshot(
        k * SUMO_STEPS.default_s,
        {"car": SumoVehicle(CHASSIS, (x, y), speed * k * SUMO_STEPS.default_s, 0.0, yaw, 0.0, speed, 0)},
        {},
        {},
    )


def rear(state: Driven) -> np.ndarray:
    return np.array(state.position[:2]) - CHASSIS.middle * np.array([math.cos(state.yaw), math.sin(state.yaw)])


def test_an_even_drive_stays_as_it_is() -> None:
    states = driven(lambda t: (12 * t, 3.0, 0.0, 12.0), 6)
    assert len(states) == round(6 / SUMO_STEPS.default_s) - 2 * reach(SUMO_STEPS.default_s)
    for k, state in enumerate(states, start=reach(SUMO_STEPS.default_s)):
        x = 12 * k * SUMO_STEPS.default_s - CHASSIS.lane_point + CHASSIS.middle
        assert state.position == pytest.approx((x, 3.0, 0.0), abs=1e-9)
        assert (state.yaw, state.speed) == pytest.approx((0.0, 12.0), abs=1e-9)


def test_on_a_circle_the_rear_axle_runs_inside_and_moves_along_the_heading() -> None:
    """The lane point's circle shrinks by what the bell takes; the rear axle's is the leg of a right-angled triangle."""
    radius, speed = 15.0, 6.0
    turn = speed / radius
    states = driven(lambda t: (radius * math.sin(turn * t), -radius * math.cos(turn * t), turn * t, speed), 40)
    shrunk = radius * math.exp(-0.5 * (turn * PATH_SMOOTHING.sigmas_s[0]) ** 2)
    inner = math.sqrt(shrunk**2 - CHASSIS.lane_point**2)
    for a, b in itertools.pairwise(states[-100:]):
        assert np.hypot(*rear(a)) == pytest.approx(inner, rel=1e-3)
        assert b.speed == pytest.approx(turn * inner, rel=2e-3)
        moved = rear(b) - rear(a)
        middle = (a.yaw + b.yaw) / 2
        aside = moved @ [-math.sin(middle), math.cos(middle)]
        assert abs(aside) < 0.003 * np.hypot(*moved) + 1e-4
        assert (b.yaw - a.yaw) / SUMO_STEPS.default_s == pytest.approx(turn, rel=1e-3)


def test_a_shift_within_a_step_is_driven_within_a_second() -> None:
    """As SUMO shifts vehicles to another line of a lane: no jump, no slip, and in the end it is there."""
    states = driven(lambda t: (10 * t, 0.0 if t < 3 else 0.16, 0.0, 10.0), 8)
    aside = np.array([rear(s)[1] for s in states])
    yaw = np.degrees([s.yaw for s in states])
    assert aside[-1] == pytest.approx(0.16, abs=0.002)
    assert np.abs(np.diff(aside)).max() < 0.01
    assert np.abs(np.diff(yaw)).max() < 0.3
    assert np.abs(yaw).max() < 3


def test_a_vehicle_that_stands_does_not_turn() -> None:
    states = driven(lambda t: (0.0, 0.0 if t < 3 else 0.16, 0.0, 0.0), 8)
    assert {(*s.position, s.yaw) for s in states} == {(*states[0].position, states[0].yaw)}


def test_no_vehicle_turns_sharper_than_the_wheels_can_be_steered() -> None:
    """Round a corner of 90 degrees that no car can take: it comes out wide, and back to its line."""
    speed = 5.0
    states = driven(
        lambda t: (speed * t, 0.0, 0.0, speed) if speed * t < 20 else (20.0, speed * t - 20, math.pi / 2, speed), 12
    )
    for a, b in itertools.pairwise(states):
        travel = np.hypot(*(rear(b) - rear(a)))
        assert abs(b.yaw - a.yaw) <= travel * math.tan(PATH_SMOOTHING.lock_rad) / CHASSIS.wheelbase + 1e-9
    assert rear(states[-1])[0] == pytest.approx(20.0, abs=0.05)
    assert states[-1].yaw == pytest.approx(math.pi / 2, abs=0.01)


def test_what_comes_later_changes_nothing() -> None:
    """Recordings with more frames begin like shorter ones."""

    def weaving(t: float) -> tuple[float, float, float, float]:
        return 9 * t, math.sin(t), math.atan2(math.cos(t), 9), 9.0

    short, long = driven(weaving, 9.0), driven(weaving, 23.3)
    assert len(long) > len(short) > 200
    assert long[: len(short)] == short


def test_vehicles_come_and_go() -> None:
    """One that SUMO has for half a second only drives on evenly outside of it, and is there for half a second."""
    shots = [snapshot(lambda t: (10 * t, 0.0, 0.0, 10.0), k) for k in range(200)]
    shots = [one if 90 <= k < 110 else replace(one, vehicles={}) for k, one in enumerate(shots)]
    seen = [
        (k, states["car"])
        for k, (_, states) in enumerate(drivable(shots, SUMO_STEPS.default_s), start=reach(SUMO_STEPS.default_s))
        if states
    ]
    assert [k for k, _ in seen] == list(range(90, 110))
    for k, state in seen:
        assert state.position[0] == pytest.approx(
            10 * k * SUMO_STEPS.default_s - CHASSIS.lane_point + CHASSIS.middle, abs=1e-9
        )
        assert state.speed == pytest.approx(10.0)


@pytest.mark.parametrize(
    "name",
    [
        "t03_crown_mast",
        "t04_exit_gantry",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("t02_linden_pole", "t05_park_third")),
    ],
)
def test_recorded_velocities_are_how_bodies_move(name: str) -> None:
    """Every step of ten seconds: velocity against a central difference over 0.2 s, slip of the rear axle, yaw, roll."""
    plan = RecordingPlan(
        site=site(name), index=0, frames=400, interval=SUMO_STEPS.default_s, size=(640, 360), fov_deg=110, seed=0
    )
    recording, checked = simulate(plan), 0
    for i, vehicle in enumerate(recording.vehicles):
        rows = np.flatnonzero(recording.vehicle == i)
        place = recording.T_world_chassis[rows][:, :3, 3]
        near = np.hypot(*(place - recording.camera.position)[:, :2].T).max() < 100
        if vehicle.parked or not vehicle.labelled or not near or len(rows) < 20:
            continue
        T, velocity = recording.T_world_chassis[rows], recording.velocity[rows]
        moved = (place[8:] - place[:-8]) / (8 * SUMO_STEPS.default_s)
        assert np.linalg.norm((moved - velocity[4:-4])[:, :2], axis=1).max() < 1.0
        assert (velocity * T[:, :3, 0]).sum(1).min() > -0.05
        axle = (
            place
            + (vehicle.shape["length"] / 2 - vehicle.shape["front_overhang"] - vehicle.shape["wheelbase"])
            * (T[:, :3, 0])
        )
        left = (T[:-1, :3, 1] + T[1:, :3, 1]) / 2
        assert np.abs((np.diff(axle, axis=0) * left).sum(1)).max() < 0.01
        yaw = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
        assert np.degrees(np.abs(np.diff(yaw))).max() < 3
        assert np.degrees(np.arcsin(np.abs(T[:, 2, 1]))).max() < 6
        checked += 1
    assert checked >= 4
