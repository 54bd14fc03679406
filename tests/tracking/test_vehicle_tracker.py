"""Tracks at any frame rate, of any length: what is followed under one name, how exactly, and in how much memory."""

import itertools
import json
import math
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.dataset import coco
from skope.errors import UserError
from skope.metrics import read_inputs
from skope.pose.keypoint_views import read_scene
from skope.schema import Result
from skope.tracking import kalman, track_footage
from skope.tracking.headings import smoothed_headings
from skope.tracking.tracker_inputs import Detection, PoseMeasurement, detection_from_dict, detection_to_dict
from skope.tracking.tracks import Track
from skope.tracking.vehicle_tracker import TRACKER_LIMITS, track_vehicles
from tests.eval.cli.test_footage import rows_of
from tests.sightings import drive

Path2D = Callable[[float], tuple[float, float, float]]
"""Where a vehicle is and heads at a time: x, y, heading."""


def detection(x: float, y: float, heading: float, *, sigma: float = 0.1, box: float = 0.0, truth: int = 1) -> Detection:
    """A car seen at a place, its box `box` pixels from the left."""
    pose = PoseMeasurement(
        place=np.array([x, y]),
        covariance=sigma**2 * np.eye(2),
        height=0.0,
        heading=heading,
        heading_sigma=math.radians(2),
        size_lwh=np.array([4.5, 1.8, 1.5]),
        kind="sedan",
    )
    return Detection(np.array([box, 100.0, 80.0, 60.0]), 0.99, truth, pose)


def seen(paths: Sequence[Path2D], times: Sequence[float], seed: int = 0) -> Iterator[list[Detection]]:
    """Vehicles as poses of a decimetre and two degrees have them."""
    rng = np.random.default_rng(seed)
    for time in times:
        image = []
        for number, path in enumerate(paths, start=1):
            x, y, heading = path(time)
            dx, dy, turn = rng.normal(0, [0.1, 0.1, math.radians(2)])
            image.append(detection(x + dx, y + dy, heading + turn, box=20 * x, truth=number))
        yield image


def turning(speed: float, radius: float) -> Path2D:
    def path(time: float) -> tuple[float, float, float]:
        angle = speed * time / radius
        return radius * math.cos(angle), radius * math.sin(angle), angle + math.pi / 2

    return path


def straight(speed: float, lane: float, begin: float = 0.0) -> Path2D:
    return lambda time: (begin + speed * time, lane, 0.0)


def names(found: Sequence[Track]) -> list[set[int]]:
    """The true vehicles in each track."""
    return [set(track.truth_ids[track.detected].tolist()) for track in found]


@pytest.mark.parametrize("fps", [25.0, 10.0, 5.0, 2.5, 2.0])
def test_vehicles_of_any_speed_are_followed_at_any_frame_rate(fps: float) -> None:
    paths = [straight(speed, 4.0 * i) for i, speed in enumerate((0.0, 8.0, 14.0, 20.0, 33.0))]
    paths += [straight(14.0, 20.0, -28.0 * i) for i in range(3)]  # one behind the other, two seconds apart
    times = np.arange(0, 6, 1 / fps)
    found = track_vehicles(seen(paths, times.tolist()), times.tolist())
    assert sorted(map(sorted, names(found))) == [[i] for i in range(1, 9)]
    for track in found:
        (vehicle,) = names([track])[0]
        ahead, _, _ = paths[vehicle - 1](1.0)
        begin, _, _ = paths[vehicle - 1](0.0)
        assert np.median(track.speed) == pytest.approx(ahead - begin, abs=0.5)


@pytest.mark.parametrize("fps", [25.0, 5.0, 2.5])
def test_headings_follow_a_turn(fps: float) -> None:
    path = turning(8.0, 12.0)
    times = np.arange(0, 5, 1 / fps)
    (track,) = track_vehicles(seen([path], times.tolist()), times.tolist())
    real = np.array([path(time)[2] for time in times])
    off = np.degrees(np.abs((track.heading - real + math.pi) % (2 * math.pi) - math.pi))
    assert np.median(off) < 1.5
    assert off.max() < 6


def test_a_pose_that_jumps_leaves_the_box_its_track_and_one_that_stays_there_begins_another() -> None:
    times = (np.arange(60) / 10).tolist()

    def image(i: int) -> list[Detection]:
        elsewhere = 20 <= i < 22 or i >= 40
        return [detection(0.8 * i, 30.0 if elsewhere else 0.0, 0.0, box=2.0 * i)]

    before, after = track_vehicles((image(i) for i in range(60)), times)
    assert (before.frames.tolist(), after.frames.tolist()) == (list(range(40)), list(range(40, 60)))
    assert before.detected.all()
    assert after.detected.all()
    assert np.abs(before.position[:, 1]).max() < 1.0  # two frames elsewhere are not believed
    assert np.abs(after.position[:, 1] - 30).max() < 1.0
    for track in (before, after):
        assert track.speed == pytest.approx(8.0, abs=0.5)


def test_boxes_tell_neighbours_apart_whose_poses_do_not() -> None:
    """Two cars in a queue far away, whose poses are 4 m off along the line of sight, all of them for a second."""
    times = (np.arange(60) / 20).tolist()

    def image(i: int) -> list[Detection]:
        off = 9.0 if 20 <= i < 40 else 0.0
        first = detection(100 + off, 0.0, 0.0, sigma=4.0, box=300.0 + i)
        second = detection(109 + off, 0.0, 0.0, sigma=4.0, box=400.0 + i, truth=2)
        return [first, second]

    assert sorted(map(sorted, names(track_vehicles((image(i) for i in range(60)), times)))) == [[1], [2]]


@pytest.mark.parametrize(("jump_px", "same"), [(30.0, True), (400.0, False)])
def test_after_a_gap_a_track_does_not_go_on_with_what_is_elsewhere_in_the_image(jump_px: float, same: bool) -> None:
    """Far away, where poses are off by metres."""
    times = (np.arange(60) / 10).tolist()

    def image(i: int) -> list[Detection]:
        if 20 <= i < 35:
            return []
        late = i >= 35
        x, box = 100 + 0.8 * i + 4.0 * late, 300 + 2.0 * i + jump_px * late
        return [detection(x, 0.0, 0.0, sigma=3.0, box=box, truth=1 + late)]

    found = names(track_vehicles((image(i) for i in range(60)), times))
    assert sorted(map(sorted, found)) == ([[1, 2]] if same else [[1], [2]])


@pytest.mark.parametrize("gap_s", [0.4, 1.0, 2.5])
def test_a_vehicle_that_leaves_does_not_continue_as_one_that_enters(gap_s: float) -> None:
    """At the border of the image, where the other lane begins 3 m beside the last position."""

    def image(time: float) -> list[Detection]:
        if time < 3.0:
            return [detection(5.0 * time, 0.0, 0.0, box=100 * time, truth=1)]
        if time < 3.0 + gap_s:
            return []
        x = 17.0 - 4.0 * (time - 3.0 - gap_s)
        return [detection(x, 3.2, math.pi, box=20 * x, truth=2)]

    times = np.arange(0, 8, 0.2).tolist()
    assert sorted(names(track_vehicles(map(image, times), times))) == [{1}, {2}]


def test_a_pose_with_front_and_rear_exchanged_does_not_end_a_track() -> None:
    times = np.arange(0, 6, 0.2).tolist()

    def image(time: float) -> list[Detection]:
        flipped = 2.9 < time < 3.3
        return [detection(8.0 * time, 0.0, math.pi * flipped, box=160 * time, truth=1)]

    (track,) = track_vehicles(map(image, times), times)
    assert len(track.times_s) == len(times)
    assert np.abs(track.position[:, 0] - 8.0 * np.array(times)).max() < 0.3


@pytest.mark.parametrize("gap_s", [0.2, 1.0])
def test_a_vehicle_that_turns_round_keeps_its_track(gap_s: float) -> None:
    """A U-turn of 6 m radius at 4 m/s, of which the middle is hidden."""

    def path(time: float) -> tuple[float, float, float]:
        angle = np.clip((time - 3.0) * 4.0 / 6.0, 0.0, math.pi)
        if time < 3.0:
            return 4.0 * (time - 3.0), 0.0, 0.0
        beyond = max(0.0, time - 3.0 - math.pi * 6.0 / 4.0)
        return 6.0 * math.sin(angle) - 4.0 * beyond, 6.0 * (1 - math.cos(angle)), float(angle)

    def image(time: float) -> list[Detection]:
        x, y, heading = path(time)
        hidden = abs(time - 5.4) < gap_s / 2
        return [] if hidden else [detection(x, y, heading, box=400 + 20 * x, truth=1)]

    times = np.arange(0, 11, 0.2).tolist()
    assert len(track_vehicles(map(image, times), times)) == 1


def test_sigmas_say_how_far_off_places_and_speeds_are() -> None:
    """Of vehicles that drive as the model of motion has it, measured with the noise that is stated, now and then."""
    rng, times = np.random.default_rng(0), (np.arange(120) / 10).tolist()
    places, speeds = [], []
    for _ in range(40):
        acceleration, v, x = 0.0, 12.0, 0.0
        real = []
        for _ in times:
            real.append((x, v))
            x, v = x + 0.1 * v, v + 0.1 * acceleration
            acceleration += -acceleration * 0.1 / 1.5 + rng.normal(0, math.sqrt(0.1))
        seen_at = [rng.normal(place, 0.1) if i % 5 == 0 else None for i, (place, _) in enumerate(real)]
        images = [[] if at is None else [detection(at, rng.normal(0, 0.1), 0.0, box=20 * at)] for at in seen_at]
        (found,) = track_vehicles(images, times)
        assert found.located.tolist() == [at is not None for at in seen_at[: len(found.frames)]]
        truth = np.array(real)[found.frames]
        places += ((found.position[:, 0] - truth[:, 0]) / found.position_sigma)[::5].tolist()
        speeds += ((found.speed - truth[:, 1]) / found.speed_sigma)[::5].tolist()
    for z in (places, speeds):
        assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.35)


def test_two_vehicles_that_pass_each_other_keep_their_names() -> None:
    times = (np.arange(40) / 5).tolist()
    paths = [straight(10.0, 0.0), lambda time: (80 - 10.0 * time, 3.5, math.pi)]
    assert sorted(map(sorted, names(track_vehicles(seen(paths, times), times)))) == [[1], [2]]


@pytest.mark.parametrize("fps", [25.0, 5.0])
@pytest.mark.parametrize("twin_from_s", [0.0, 2.0])
def test_a_vehicle_that_is_detected_twice_is_followed_once(fps: float, twin_from_s: float) -> None:
    """A second box on a car, 0.7 m beside, now and then in place of the first, as detectors have it."""
    times, rng = np.arange(0, 8, 1 / fps), np.random.default_rng(4)

    def image(time: float) -> list[Detection]:
        own, twin = detection(4.0 * time, 0.0, 0.0), detection(4.0 * time + 0.3, 0.7, 0.1, box=30.0)
        if time < twin_from_s:
            return [own]
        return [[own], [twin], [own, twin]][rng.integers(3)]

    (track,) = track_vehicles(map(image, times.tolist()), times.tolist())
    assert track.detected.mean() > 0.95
    assert np.abs(track.position[:, 1]).max() < 1.0


def test_two_tracks_that_come_together_are_one_vehicle() -> None:
    """The second box is 3 m off at first, as a wrong type's pose is: a track of its own, until it comes in."""
    times = (np.arange(80) / 10).tolist()

    def image(i: int) -> list[Detection]:
        return [detection(0.5 * i, 0.0, 0.0), detection(0.5 * i, max(3.0 - 0.1 * i, 0.4), 0.0, box=300.0, truth=2)]

    found = track_vehicles((image(i) for i in range(80)), times)
    longest, *others = sorted(found, key=lambda track: -len(track.frames))
    assert len(longest.frames) == 80
    assert longest.detected.all()
    assert len(others) <= 1
    assert all(len(track.frames) < 40 for track in others)


def test_neighbours_in_a_car_park_are_each_followed() -> None:
    """2.6 m apart, their poses half a metre uncertain."""
    times, rng = (np.arange(60) / 10).tolist(), np.random.default_rng(3)
    image = [
        [
            detection(
                float(rng.normal(0, 0.3)),
                2.6 * lane + float(rng.normal(0, 0.3)),
                0.0,
                sigma=0.5,
                truth=lane + 1,
                box=90.0 * lane,
            )
            for lane in range(6)
        ]
        for _ in times
    ]
    assert sorted(map(sorted, names(track_vehicles(image, times)))) == [[i] for i in range(1, 7)]


def parked(time: float) -> tuple[float, float, float]:
    return 5.0, 5.0, 0.3


def test_memory_grows_with_the_frames_and_not_with_their_square() -> None:
    times = (np.arange(3000) / 25).tolist()
    tracemalloc.start()
    (track,) = track_vehicles(seen([parked], times), times)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(track.frames) == 3000
    assert peak < 3000 * 1500  # of 1000 frames that can still change, and 150 bytes of each that cannot
    assert np.abs(track.position[:, :2] - 5).max() < 0.1
    assert np.degrees(np.abs(track.heading - 0.3)).max() < 1


def test_what_was_seen_long_ago_is_as_if_all_were_smoothed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    times = (np.arange(500) / 5).tolist()
    paths = [turning(6.0, 40.0), straight(0.3, 60.0)]
    in_parts = track_vehicles(seen(paths, times), times)
    monkeypatch.setattr("skope.tracking.vehicle_tracker.TRACKER_LIMITS", replace(TRACKER_LIMITS, lag_s=1e9))
    at_once = track_vehicles(seen(paths, times), times)
    for one, other in zip(in_parts, at_once, strict=True):
        for name in ("position", "velocity", "acceleration", "heading"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-4)


def test_a_sight_is_the_same_after_it_was_written_down() -> None:
    for one in (detection(1 / 3, 2 / 7, 0.1), replace(detection(1, 2, 3), pose=None, truth_id=None)):
        told = detection_to_dict(one)
        assert detection_to_dict(detection_from_dict(json.loads(json.dumps(told)))) == told


def test_a_killed_run_goes_on_after_the_poses_it_has(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    coco.write(Path("road.json"), drive(2, 10, speeds=(12.0, 5.0)))
    call = ("eval", "track", "--annotations", "road.json", "--noise", 1, "-q")
    assert skope(*call, "--out", "whole")[0] == 0
    located: list[int] = []
    locate_views = track_footage.locate_views

    def noted(views: Any, scene: Any) -> Any:
        for view in locate_views(views, scene):
            located.append(view.view.image.id)
            yield view

    def dies(views: Any, scene: Any) -> Any:
        yield from itertools.islice(noted(views, scene), 8)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(track_footage, "locate_views", dies)
        assert skope(*call, "--out", "parts")[0] == 130
    assert located == list(range(1, 9))
    located.clear()
    monkeypatch.setattr(track_footage, "locate_views", noted)
    assert skope(*call, "--out", "parts")[0] == 0
    assert located == list(range(9, 21))
    for name in ("tracks.csv", "mot.txt", "fcd.xml"):
        assert Path("parts", name).read_bytes() == Path("whole", name).read_bytes()


def test_interpolated_vehicles_keep_their_track_and_measure_nothing(skope: Any) -> None:
    """Their keypoints are shifted here: a track that took them for measurements would be elsewhere."""
    file = drive(3, 10, speeds=(9.0,))
    rows = []
    for a in file.annotations:
        points = np.column_stack([a.keypoints[:, :2], a.keypoints[:, 2] == 2]).astype(float)
        between = a.image_id % 4 != 3
        points[:, 0] += 25.0 * between
        rows.append(Result(image_id=a.image_id, score=0.9, bbox=a.bbox, keypoints=points, interpolated=between))
    coco.write(Path("road.json"), file)
    coco.write_results(Path("p.json"), rows)
    call = ("eval", "track", "--annotations", "road.json", "--predictions", "p.json", "-q", "--out", "t")
    assert skope(*call)[0] == 0
    told = rows_of(Path("t/tracks.csv"))
    assert len({row["track"] for row in told}) == 1
    assert [float(row["speed"]) for row in told] == pytest.approx([9.0] * len(told), abs=0.5)
    assert len(told) == len(file.images) == 30, "from two frames before the first key frame to three after the last"
    assert [row["located"] for row in told] == ["1" if k % 4 == 2 else "0" for k in range(30)]
    truth = [a.box_3d.center[0] for a in file.annotations if a.box_3d]
    assert [float(row["x"]) for row in told] == pytest.approx(truth, abs=0.5)
    boxes = Path("t/mot.txt").read_text().splitlines()
    assert len(boxes) == len(told), "also of frames between"


def test_boxes_without_a_pose_are_a_vehicles_for_half_a_second_before_and_after() -> None:
    times = (np.arange(40) / 10).tolist()
    path = straight(10.0, 0.0)
    images = list(seen([path], times))
    for k in (*range(12), *range(28, 40)):
        images[k] = [replace(one, pose=None) for one in images[k]]
    (track,) = track_vehicles(images, times)
    assert track.frames.tolist() == list(range(7, 33))
    assert track.located.tolist() == [12 <= k < 28 for k in range(7, 33)]
    assert track.position[:, :2] == pytest.approx(np.array([path(time)[:2] for time in times[7:33]]), abs=0.3)
    assert (np.diff(track.position_sigma[:6]) < 0).all()
    assert (np.diff(track.position_sigma[-6:]) > 0).all()
    images[10] = []
    (track,) = track_vehicles(images, times)
    assert track.frames[0] == 11, "no box leads from one to the next"


def test_variances_that_rounding_took_below_zero_are_zero() -> None:
    means = np.array([[0.0, 0, 3, 4, 0, 0], [0.0, 0, 0, 0, 0, 0]])
    position, speed = kalman.position_and_speed_errors(means, np.stack([-1e-18 * np.eye(6)] * 2))
    assert not position.any()
    assert speed.tolist() == [0, 0]


def test_frames_that_could_not_be_read_take_their_time(skope: Any) -> None:
    file = drive(3, 10, speeds=(9.0,))
    kept = tuple(replace(image, time_s=None) for image in file.images if image.id % 3)
    ids = {image.id for image in kept}
    own = tuple(a for a in file.annotations if a.image_id in ids)
    coco.write(Path("road.json"), replace(file, images=kept, annotations=own))
    assert skope("eval", "track", "--annotations", "road.json", "--noise", 1, "--fps", 10, "--out", "t", "-q")[0] == 0
    speeds = [float(row["speed"]) for row in rows_of(Path("t/tracks.csv"))]
    assert np.median(speeds) == pytest.approx(9.0, abs=0.4)


# -------------------------------------------------------------------------------------------------------------- results


def results_of(count: int) -> list[Result]:
    rng = np.random.default_rng(0)
    return [
        Result(
            image_id=1 + i // 2,
            score=0.9,
            bbox=np.round(rng.uniform(0, 50, 4), 2),
            keypoints=np.round(rng.uniform(0, 50, (33, 3)), 2),
        )
        for i in range(count)
    ]


def test_results_in_order_are_read_one_by_one(tmp_path: Path) -> None:
    file = replace(drive(1, 10, speeds=()), annotations=())
    coco.write_results(tmp_path / "r.json", results_of(12))
    streamed = read_inputs.stream_results(tmp_path / "r.json", file)
    assert isinstance(streamed, read_inputs.ResultsFile)
    for _ in range(2):
        read = list(streamed)
        assert [coco.result_to_dict(r) for r in read] == [coco.result_to_dict(r) for r in results_of(12)]
    coco.write_results(tmp_path / "mixed.json", results_of(12)[::-1])
    assert isinstance(read_inputs.stream_results(tmp_path / "mixed.json", file), tuple)

    coco.write(tmp_path / "frames.json", file)
    views = [
        read_scene(None, tmp_path / "frames.json", tmp_path / name, None, 0.0).views()
        for name in ("r.json", "mixed.json")
    ]
    for ordered, mixed in zip(*views, strict=True):
        assert sorted(map(tuple, ordered.boxes)) == sorted(map(tuple, mixed.boxes))


def lines(rows: Sequence[bytes], begin: bytes = b"[\n", between: bytes = b",\n", end: bytes = b"\n]\n") -> bytes:
    return begin + between.join(rows) + end


@pytest.mark.parametrize(
    ("shape", "good"),
    [
        (lines, True),
        (lambda rows: lines(rows, b"[", b",", b"]"), True),
        (lambda rows: lines(rows, b"[\n", b",\n", b"]"), True),
        (lambda rows: lines([rows[0], b",\n".join(rows[1:]).replace(b",", b",\n")]), True),
        (lambda rows: lines(rows[:0]), True),
        (lambda rows: lines(rows, between=b"\n"), False),
        (lambda rows: lines(rows, end=b",\n]\n"), False),
        (lambda rows: lines(rows, end=b"\n"), False),
        (lambda rows: lines(rows) + b"more", False),
        (lambda rows: lines(rows)[:-40], False),
    ],
)
def test_results_of_any_layout_are_read_or_refused(shape: Callable[..., bytes], good: bool, tmp_path: Path) -> None:
    coco.write_results(tmp_path / "r.json", results_of(4))
    rows = (tmp_path / "r.json").read_bytes().strip(b"[]\n").split(b",\n")
    (tmp_path / "other.json").write_bytes(shape(rows))
    if good:
        assert len(coco.read_results(tmp_path / "other.json")) in (0, 4)
    else:
        with pytest.raises(UserError, match=r"other\.json: not valid JSON"):
            coco.read_results(tmp_path / "other.json")


def test_headings_reach_back_before_the_first_one_that_is_measured() -> None:
    """As on a track whose box was followed before its first pose: it is no reason to know none of its headings."""
    times = np.arange(30) * 0.1
    truth = 0.3 + 0.2 * times
    measured = np.where(np.arange(30) % 5 == 3, truth, np.nan)
    velocity = 10 * np.stack([np.cos(truth), np.sin(truth)], axis=1)
    found = smoothed_headings(times, measured, np.full(30, 0.02), velocity)
    assert found == pytest.approx(truth, abs=0.06)
