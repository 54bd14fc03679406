"""What tracks are distrusted for, and their classes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skope.camera.model import Camera
from skope.schema import VEHICLE_TYPES
from skope.tracking.track_flags import box_never_moved, flagged
from skope.tracking.tracks import VEHICLE_CLASS_NAMES, vehicle_class
from skope.tracks.track import Track
from skope.traffic.observation import Observation
from tests.samples import within


def track(number: int, xy: Any, *, seconds: float = 6.0, poses: int | None = None) -> Track:
    """A track along points (M, 2), evenly in time."""
    places = np.asarray(xy, dtype=float)
    count = len(places)
    times = np.linspace(0, seconds, count)
    velocity = np.gradient(places, times, axis=0)
    located = np.ones(count, dtype=bool)
    if poses is not None:
        located[:] = False
        located[np.linspace(0, count - 1, poses).astype(int)] = True
    return Track(
        number=number,
        body_type="suv",
        class_name="car",
        class_confidence=0.9,
        length=4.5,
        width=1.8,
        height=1.6,
        frames=np.arange(count),
        times_s=times,
        position=np.column_stack([places, np.zeros(count)]),
        velocity=velocity,
        acceleration=np.gradient(velocity, times, axis=0),
        heading=np.arctan2(velocity[:, 1], velocity[:, 0]),
        covariance=np.tile(0.01 * np.eye(2), (count, 1, 1)),
        speed_sigma=np.full(count, 0.2),
        located=located,
        boxes=np.zeros((count, 4)),
        scores=np.ones(count),
        truth_ids=np.full(count, -1, dtype=np.int64),
    )


def along(y: float, speed: float, count: int = 60) -> np.ndarray:
    return np.column_stack([np.linspace(0, 6 * speed, count), np.full(count, y)])


def flags(*tracks: Track) -> list[tuple[str, ...]]:
    return [one.flags for one in flagged(tracks)]


def test_plain_tracks_have_no_flags() -> None:
    turn = np.linspace(0, np.pi / 2, 60)
    corner = np.column_stack([20 * np.sin(turn), 20 - 20 * np.cos(turn)])
    assert flags(track(1, along(0, 12)), track(2, along(3.5, -12)), track(3, corner)) == [(), (), ()]


def test_two_poses_and_standing_still_are_told() -> None:
    rng = np.random.default_rng(0)
    sign = [5.0, 3.0] + rng.normal(0, 0.1, (60, 2))
    queue = np.concatenate([np.zeros((50, 2)), along(0, 5, 10) * 0.3])
    assert flags(track(1, along(0, 12), poses=2), track(2, sign), track(3, queue)) == [
        ("two_poses",),
        ("never_moved",),
        (),
    ]


def boxes_at(middles: np.ndarray, size: float = 20.0, jitter_px: float = 0.8) -> np.ndarray:
    """(M, 4) upright boxes around (M, 2) middles; position and size jitter as a detector's do."""
    rng = np.random.default_rng(1)
    edges = np.array([0.7, 1.4]) * size + rng.normal(0, jitter_px, (len(middles), 2))
    return np.hstack([middles - edges / 2 + rng.normal(0, jitter_px, (len(middles), 2)), edges])


def test_a_box_that_stays_in_its_place_never_moved() -> None:
    """A traffic drum that is taken for a bicycle, with an outlier now and then; with few frames it may be a queue."""
    drum = np.tile([300.0, 200.0], (255, 1))
    drum[40:250:60] += 15
    times = np.arange(255) * 0.1
    assert box_never_moved(boxes_at(drum), times)
    assert not box_never_moved(boxes_at(drum[:40]), times[:40])
    assert not box_never_moved(np.zeros((0, 4)), np.zeros(0))


@pytest.mark.parametrize("goes", ["comes", "leaves"])
def test_a_cyclist_who_waits_at_a_light_moves(goes: str) -> None:
    """For 90 s in one place; riding is 2% of the track."""
    rides = np.column_stack([np.linspace(4, 45, 18) ** 1.1, np.zeros(18)])
    waits = np.zeros((900, 2))
    middles = np.concatenate([rides[::-1], waits] if goes == "comes" else [waits, rides])
    assert not box_never_moved(boxes_at(middles + 300), np.arange(918) * 0.1)


def test_a_box_that_grows_in_its_place_moved() -> None:
    """It comes along the line of sight, at the vanishing point."""
    grown = np.hstack([boxes_at(np.full((60, 2), 300.0), size) for size in (10.0, 20.0)]).reshape(60, 2, 4)
    share = np.linspace(0, 1, 60)[:, None]
    assert not box_never_moved(grown[:, 0] * (1 - share) + grown[:, 1] * share, np.arange(60) * 0.1)


def test_a_vehicle_that_waits_for_long_and_then_drives_off_moved() -> None:
    queue = np.concatenate([np.zeros((960, 2)), along(0, 5, 40) * 0.5])
    assert flags(track(1, queue, seconds=100.0)) == [()]


def test_who_turns_round_on_the_spot_is_two_vehicles() -> None:
    times = np.linspace(0, 6, 60)
    x = np.cumsum(np.clip(24 * (3 - times), -20, 20)) * 0.1
    whole = track(1, np.column_stack([x, np.zeros(60)]))
    there, back = flagged([whole])
    assert [there.number, back.number] == [1, 2]
    assert there.flags == back.flags == ("impossible_motion",)
    assert (there.velocity[:, 0] > 0).all()
    assert (back.velocity[:, 0] < 0).all()
    assert there.times_s[-1] < 3 < back.times_s[0]
    for part in (there, back):
        assert part.position == pytest.approx(whole.position[part.frames])
        assert (np.linalg.norm(part.acceleration, axis=1) < 9).all()


def test_what_is_nowhere_possible_is_kept_whole_and_told() -> None:
    times = np.linspace(0, 6, 60)
    shaken = track(1, np.column_stack([0.5 * np.abs((times * 2) % 2 - 1) * 30, 0 * times]), poses=3)
    wild = replace(shaken, acceleration=np.full((60, 2), 20.0))
    assert [(len(one.frames), one.flags) for one in flagged([wild])] == [(60, ("impossible_motion",))]


@pytest.mark.parametrize(("others", "told"), [(6, True), (3, False)])
def test_one_against_all_others_is_told(others: int, told: bool) -> None:
    lane = [track(k + 2, along(0.2 * k, 14)[::-1]) for k in range(others)]
    assert ("against_traffic" in flags(track(1, along(0.3, 12)), *lane)[0]) == told


def test_where_others_drive_along_too_nobody_is_against_traffic() -> None:
    lane = [track(k + 2, along(0.2 * k, 14)[::-1]) for k in range(6)]
    assert flags(track(1, along(0.3, 12)), track(20, along(0.5, 9)), *lane)[0] == ()


def test_who_drives_against_the_traffic_is_as_looking_at_all_pairs_says() -> None:
    """90 vehicles in four lanes that lie apart; three go the wrong way, and in one lane two, which are along then."""
    rng = np.random.default_rng(5)
    tracks = []
    for k in range(90):
        way = along(6.0 * (k % 4) + 0.2 * rng.normal(), float(rng.uniform(8, 14)), 30)
        tracks.append(track(k + 1, way[::-1] if (k in (5, 18, 40, 3, 7)) != (k % 2 == 1) else way))
    told = {k for k, one in enumerate(flags(*tracks)) if "against_traffic" in one}
    rows = [(k, p, v) for k, one in enumerate(tracks) for p, v in zip(one.position[:, :2], one.velocity, strict=True)]
    owner, places = np.array([k for k, _, _ in rows]), np.array([p for _, p, _ in rows])
    turns = np.array([np.arctan2(v[1], v[0]) for _, _, v in rows])
    cells = np.floor(places / 1.5)
    alone = np.zeros(len(rows), dtype=bool)
    for i in range(len(rows)):
        near = (np.abs(cells - cells[i]).max(axis=1) <= 1) & (owner != owner[i])
        away = np.cos(turns[near] - turns[i])
        opposite = len(set(owner[near][away < np.cos(np.radians(150))].tolist()))
        alone[i] = opposite >= 5 and not (away > 0).any()
    assert told == {k for k in range(90) if alone[owner == k].mean() > 0.5}
    assert {5, 18, 40} <= told


def later(one: Track, begin_s: float) -> Track:
    """The track, begun at another time."""
    return replace(one, times_s=one.times_s + begin_s)


def lane(speed: float, number: int, *, every_s: float = 3.0, first: int = 100, y: float = 0.0) -> list[Track]:
    """Tracks that follow each other along x with speeds within 5% of `speed`, m/s."""
    rng = np.random.default_rng(3)
    speeds = speed * rng.uniform(0.95, 1.05, number)
    offsets = y + rng.normal(0, 0.3, number)
    made = zip(speeds.tolist(), offsets.tolist(), strict=True)
    return [later(track(first + k, along(side, v)), every_s * k) for k, (v, side) in enumerate(made)]


def implausible(*tracks: Track) -> list[int]:
    """Numbers of those with the flag; all begin at different times and are numbered by their order here."""
    ordered = [replace(one, frames=one.frames + 1000 * k) for k, one in enumerate(tracks)]
    return [k for k, one in enumerate(flagged(ordered)) if "implausible_speed" in one.flags]


@pytest.mark.parametrize(("speed", "told"), [(12.0, True), (1.0, True), (18.0, False), (46.0, True), (30.0, False)])
def test_a_speed_that_the_flow_around_contradicts_is_implausible(speed: float, told: bool) -> None:
    odd = later(track(1, along(0.5, speed)), 10.0)
    assert implausible(odd, *lane(25, 12)) == ([0] if told else [])


def test_a_slow_track_is_compared_whatever_its_direction() -> None:
    """A jumping pose has no direction: here it creeps back against a fast lane."""
    assert implausible(later(track(1, along(0.0, 1.5)[::-1] + [40.0, 0.0]), 10.0), *lane(25, 12)) == [0]


@pytest.mark.parametrize(
    "others",
    [
        lane(25, 4),  # too few
        [later(one, 200.0) for one in lane(25, 12)],  # at another time
        lane(25, 12, y=7.0),  # in another lane
        [replace(one, position=one.position[::-1], velocity=-one.velocity) for one in lane(25, 12)],  # the other way
    ],
)
def test_a_speed_without_a_flow_around_is_plausible(others: list[Track]) -> None:
    assert implausible(later(track(1, along(0.0, 8)), 10.0), *others) == []


def test_a_queue_is_no_implausible_speed() -> None:
    """A platoon at 5 m/s within a flow at 20 m/s: the tracks nearest in time are slow too."""
    before, queue, after = lane(20, 12, first=1), lane(5, 12, first=50), lane(20, 12, first=150)
    tracks = [*before, *(later(one, 38.0) for one in queue), *(later(one, 80.0) for one in after)]
    assert implausible(*tracks) == []


def test_one_that_waits_at_a_light_is_plausible() -> None:
    """It brakes from 14 m/s at 2 m/s^2, stands for 20 s and drives on; all others pass at green."""
    t = np.linspace(0, 40, 400)
    speed = np.clip(np.maximum(14 - 2 * np.maximum(t - 2, 0), 2 * (t - 29)), 0, 14)
    waits = track(1, np.column_stack([np.cumsum(speed) * 0.1, np.zeros(400)]), seconds=40.0)
    assert implausible(later(waits, 5.0), *lane(14, 14, every_s=4.0)) == []


def test_the_cameras_error_widens_what_a_track_says() -> None:
    """All distances from the camera's foot off by 5%, as where its height is."""
    one = track(1, along(0, 12, count=40))
    camera = Camera.looking([-10.0, 0.0, 8.0], yaw=0.0, pitch_down=0.3)
    known = within(camera, 0.05)
    observed = Observation(
        times_s=one.times_s, camera=camera, uncertainty=known, common_scale_sigma=known.distance_sigma()
    )
    wide = observed.with_camera_error(one)
    assert wide.speed_sigma == pytest.approx(np.hypot(0.2, 0.05 * one.speed))
    away = np.linalg.norm(one.position[:, :2] - [-10, 0], axis=1)
    assert wide.position_sigma == pytest.approx(np.hypot(0.1, 0.05 * away))


def test_classes_are_coarse_and_say_how_sure_they_are() -> None:
    assert vehicle_class({"hatchback": 20, "city_car": 15, "suv": 3}) == ("car", pytest.approx(5.5 / 6))
    assert vehicle_class({"truck": 8, "box_truck": 7, "bus": 1})[0] == "lorry"
    assert vehicle_class({"van": 30, "suv": 28})[0] == "unknown"


@pytest.mark.parametrize("body_type", VEHICLE_TYPES)
def test_no_heavy_vehicle_counts_as_a_car(body_type: str) -> None:
    heavy = {"truck": "lorry", "bus": "bus"}.get(body_type.rpartition("_")[2])
    assert vehicle_class({body_type: 9})[0] == (heavy or ("van" if body_type == "van" else "car"))
    few, many = vehicle_class({"bus": 2}), vehicle_class({"bus": 40})
    assert few[0] == many[0] == "bus"
    assert few[1] < many[1] < 1
    assert {name for name, _ in (few, many)} < set(VEHICLE_CLASS_NAMES)
