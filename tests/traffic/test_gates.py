"""Gates: one event for a crossing, in the direction that the user has named, whatever the vehicle does on the line.

Most cases are what other programs have got wrong, as their users tell.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skope.camera.ground_plane import Ground, intersect_ground
from skope.camera.model import Camera
from skope.site.gates_zones_lanes import Gate, Lane
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.gate_counts import Count
from skope.traffic.gates import GateCrossing, gate_crossings, gates_of_drawn_cameras
from skope.traffic.lanes import LaneMap, lane_changes
from skope.traffic.measure import measure
from skope.traffic.observation import Observation
from skope.traffic.stitch_broken_tracks import stitch_tracks
from tests.samples import within
from tests.traffic.drives import GATE, along_x, drive, straight, then, watched
from tests.traffic.test_missed_crossings import SITE

NO_LANES = LaneMap(())


def crossed(*trajectories: Track, gates: tuple[Gate, ...] = (GATE,), **settings: Any) -> list[GateCrossing]:
    return [one for one in gate_crossings(trajectories, gates, NO_LANES, TrafficSettings(**settings)) if one.is_counted]


def directions(x: Any, **settings: Any) -> list[str]:
    return [one.direction_name for one in crossed(along_x(1, x), **settings)]


@pytest.mark.parametrize(
    ("x", "expected"),
    [
        (np.linspace(-3, 3, 25), ["west"]),
        (np.linspace(3, -3, 25), ["east"]),
        (np.arange(-3.0, 4.0), ["west"]),  # one point lies exactly on the gate
        (np.arange(3.0, -4.0, -1), ["east"]),
        ([-3, -2, -1, 0, 0, 0, 0, 1, 2, 3], ["west"]),  # stops exactly on it
        ([-3, -2, -1, 0, 0, -1, -2, -3], []),  # comes to it and goes back
        ([-3, -2, -1, -0.1, 0.1, -0.2, 0.3, -0.1, 0.2, 1, 2], ["west"]),  # jitters on it
        ([-3, -2, -1, *([0.2, -0.2] * 15), 1, 2, 3], ["west"]),  # for seconds
        ([-3, -2, -1, -0.5, 0], ["west"]),  # ends on it
        ([3, 2, 1, 0.5, 0], ["east"]),
        ([-3, -2, -1, -0.1, 0.1, -0.1], ["west"]),  # ends jittering on it
        ([0, 0.5, 1, 2, 3], []),  # begins on it: whoever came there has crossed it
        ([0, -0.5, -1, -2, -3], []),
        ([-3, -2.8, -2.6, 2.5, -2.4, -2.2, -2], []),  # a flicker of one frame
        ([-3, -2, -1, 1, 2, -1, -1, -1, 3, 4, 5], ["west"]),  # jumps back for three frames
        ([-3, -2.9, -2.8, 2, 2.1, 2.2, -2.2, -2.1, -2.0], []),  # and forth
        ([-2, -1, 0.2, -1, -2, -3], []),  # not as far as the hysteresis
        (3 - np.abs(np.linspace(-6, 6, 40)), ["west", "east"]),  # turns round beyond it
        ([-0.3, -0.1, 0.1, 0.3], []),  # less than the least travel
        ([-2.0, -2.0], []),
        ([-2.0], []),
    ],
)
def test_each_crossing_is_one_event(x: Any, expected: list[str]) -> None:
    assert directions(x) == expected


def test_a_track_that_breaks_on_the_gate_is_counted_once() -> None:
    """Wherever it breaks, with a place on the gate and without."""
    for shift in (0.0, 0.03, -0.1):
        x = np.linspace(-6, 6, 61) + shift
        for k in range(3, 58):
            parts = [along_x(1, x[:k]), along_x(2, x[k:], np.arange(k, 61) * 0.1)]
            assert len(crossed(*stitch_tracks(parts))) == 1, (shift, k)


def test_what_is_in_doubt_says_so() -> None:
    (sure,) = crossed(along_x(1, np.linspace(-3, 3, 25)))
    (ends,) = crossed(along_x(1, [-3, -2, -1, -0.5, 0.02]))
    assert (sure.uncertainty_flags, ends.uncertainty_flags) == ("", "ends")
    assert ends.probability < 0.75 * sure.probability


@pytest.mark.parametrize("degrees", range(0, 360, 11))
def test_directions_never_swap_their_meaning(degrees: int) -> None:
    """Others decide by whether a line is more across or more upright: from 44 to 46 degrees IN becomes OUT."""
    for turn in (math.radians(degrees), math.radians(44), math.radians(46)):
        along, across = np.array([math.cos(turn), math.sin(turn)]), np.array([math.sin(turn), -math.cos(turn)])
        gate = Gate(name="g", line=(tuple(-5 * along), tuple(5 * along)), directions=("in", "out"))
        there = drive(1, np.linspace(-4, 4, 30)[:, None] * across + along)
        back = drive(2, np.linspace(4, -4, 30)[:, None] * across - along)
        assert [one.direction_name for one in crossed(there, gates=(gate,))] == ["in"]
        assert [one.direction_name for one in crossed(back, gates=(gate,))] == ["out"]


def test_who_stands_far_away_jitters_more() -> None:
    """Places that are off by 0.6 m one after the other would pass a hysteresis of half a metre many times."""
    rng = np.random.default_rng(7)
    for _ in range(20):
        wander = np.convolve(rng.normal(0, 0.6 / np.sqrt(5), 400), np.ones(5), "same")
        x = np.interp(np.arange(400), [0, 60, 340, 400], [-30, 0, 0, 30]) + wander
        assert [one.direction_name for one in crossed(along_x(1, x, sigma=0.6))] == ["west"]


def test_a_gate_ends_where_it_ends() -> None:
    """And of two gates with an end in common, one counts who passes there."""
    for y, expected in ((4.9, 1), (5.1, 0), (-5.1, 0)):
        assert len(crossed(straight(1, (-5, y), (10, 0), 1))) == expected
    other = Gate(name="h", line=((0.0, 5.0), (0.0, 9.0)))
    found = crossed(straight(1, (-5, 5.0), (10, 0), 1), gates=(GATE, other))
    assert [(one.gate, one.direction_name) for one in found] == [("h", "1")]


def test_gates_close_together_all_count() -> None:
    gates = tuple(Gate(name=str(k), line=((0.3 * k, -5.0), (0.3 * k, 5.0))) for k in range(4))
    assert [one.gate for one in crossed(straight(1, (-9, 0), (13, 0), 2), gates=gates)] == ["0", "1", "2", "3"]


def test_the_time_is_that_of_the_frames() -> None:
    """Frames that last differently long, and vehicles that pass within a whole second."""
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.02, 0.3, 60))
    for speed in (8.0, 33.0):
        (found,) = crossed(along_x(1, speed * (times - 4.321), times))
        assert found.time_s == pytest.approx(4.321, abs=1e-6)
        assert found.front_s == pytest.approx(4.321 - 2 / speed, abs=1e-6)
        assert found.rear_s == pytest.approx(4.321 + 2 / speed, abs=1e-6)
        assert found.speed == pytest.approx(speed)
        assert found.sigma_s == pytest.approx(0.05 / speed, rel=1e-3)


def test_the_stated_error_of_the_time_holds() -> None:
    rng = np.random.default_rng(1)
    within = 0
    for _ in range(300):
        clean = straight(1, (-20, 0), (9, 1), 4, sigma=0.3)
        # A filter's errors change slowly: this one is shared by all places of a track.
        moved = drive(1, clean.xy + rng.normal(0, 0.3, 2), sigma=0.3)
        (found,) = crossed(moved)
        within += abs(found.time_s - 20 / 9) < 1.645 * found.sigma_s
    assert 0.85 < within / 300 < 0.95


def test_who_goes_past_the_end_of_a_gate_is_in_doubt() -> None:
    """As on a pavement that a gate ends on: half of them are counted, and all of them are in the interval."""

    def at(y: float) -> GateCrossing | None:
        track = straight(1, (-6.0, y), (1.5, 0.0), 8.0, sigma=0.4, category="pedestrian", class_name="pedestrian")
        return next(iter(gate_crossings([track], [GATE], NO_LANES, TrafficSettings())), None)

    inside, outside, far, middle = at(4.8), at(5.2), at(6.0), at(0.0)
    assert inside
    assert outside
    assert middle
    assert far is None
    assert (inside.is_counted, inside.uncertainty_flags) == (True, "beside")
    assert (outside.is_counted, outside.uncertainty_flags) == (False, "beside")
    assert (middle.is_counted, middle.uncertainty_flags) == (True, "")
    # Both together are one crossing of one who is as far from the end on either side.
    assert inside.probability + outside.probability == pytest.approx(middle.probability)


@pytest.mark.parametrize(("name", "off_m"), [("car", 0.0), ("bus", 0.6), ("bicycle", 0.6)])
def test_times_of_bodies_whose_middle_is_off_are_less_certain(name: str, off_m: float) -> None:
    (one,) = crossed(straight(1, (-20, 0), (8, 0), 5, sigma=0.1, class_name=name))
    assert one.sigma_s == pytest.approx(math.hypot(0.1, off_m) / 8)


def test_nobody_walks_that_fast() -> None:
    walker = {"category": "pedestrian", "class_name": "pedestrian"}
    walks, runs, flies = (
        gate_crossings([straight(1, (-4 * v, 0), (v, 0), 8, **walker)], [GATE], NO_LANES, TrafficSettings())
        for v in (1.5, 5.0, 9.0)
    )
    assert [one.is_counted for one in (*walks, *runs, *flies)] == [True, True, False]


def test_unconfirmed_and_parked_are_not_counted() -> None:
    x = np.linspace(-3, 3, 25)
    assert not crossed(along_x(1, x, confirmed=False), along_x(2, x, flags=("never_moved",)))
    assert not crossed(along_x(1, x, class_name="bus"), classes=("car",))


def test_lanes_and_their_changes() -> None:
    lanes = LaneMap([Lane(name=str(k), line=((-100.0, y), (100.0, y)), width=3.5) for k, y in enumerate((-2.0, 1.5))])
    t = np.arange(0, 10, 0.1)
    y = -2 + 3.5 / (1 + np.exp(-2 * (t - 6)))
    over = drive(1, np.stack([10 * t - 30, y], axis=1))
    (found,) = gate_crossings([over], [GATE], lanes, TrafficSettings())
    assert found.lane == "0"
    assert found.lane_probability > 0.99
    (change,) = lane_changes([over], lanes, 0.3)
    assert (change.from_lane, change.to_lane) == ("0", "1")
    assert change.time_s == pytest.approx(6, abs=0.3)
    weaving = drive(2, np.stack([10 * t - 30, -0.25 + 0.2 * np.sin(9 * t)], axis=1))
    assert not lane_changes([weaving], lanes, 0.3)
    assert lanes.lane_at(np.array([0.0, 20.0]), np.eye(2))[0] == ""


# --------------------------------------------------------------------------------------------- the camera's error

CAMERA = Camera.looking((0.0, 0.0, 8.0), yaw=0.0, pitch_down=0.25, size=(1280, 720), fov=math.radians(60))
"""Looks along x, 8 m over the road."""


def seen_by(camera: Camera, share: float | None, seconds: float = 60.0) -> Observation:
    """Footage of a camera whose distances are off by a common share, one standard deviation; None: not known."""
    known = None if share is None else within(camera, share)
    return replace(watched(seconds, common=share), camera=camera, uncertainty=known, ground=Ground())


def drawn_across(camera: Camera, x: float) -> tuple[tuple[float, float], ...]:
    """Pixels of a line across the road at x; the camera looks from its left to its right."""
    pixels, _, _ = camera.project([[x, -6.0, 0.0], [x, 6.0, 0.0]])
    return tuple((float(u), float(v)) for u, v in pixels)


def counted(tracks: list[Track], gate: Gate, observation: Observation) -> Count:
    report = measure(tracks, observation, replace(SITE, gates=(gate,)))
    (one,) = (c for c in report.counts_total if c.class_name == "vehicle" and c.direction == "away")
    return one


@pytest.mark.parametrize("share", [None, 0.0, 0.02, 0.12])
def test_the_cameras_error_decides_no_crossing_of_a_gate_that_was_drawn(share: float | None) -> None:
    """Slow vehicles 40 m away, of which a third stop 1 m before the gate, a third 1 m behind it."""
    ends = [39.0] * 5 + [41.0] * 5 + [70.0] * 5
    tracks = [
        straight(k, (20.0, -2.0), (4.0, 0.0), (end - 20) / 4, begin_s=2.0 * k) for k, end in enumerate(ends, start=1)
    ]
    pixels = drawn_across(CAMERA, 40.0)
    gate = Gate(name="drawn", pixels=pixels, size=(1280, 720), directions=("away", "back"))
    one = counted(tracks, gate, seen_by(CAMERA, share))
    assert one.count == 10
    assert one.confidence_interval == counted(tracks, gate, seen_by(CAMERA, None)).confidence_interval
    # The line in the site file is that of another calibration: pixels win, at any size of the image.
    stale = replace(gate, line=((55.0, -6.0), (55.0, 6.0)), size=(2560, 1440),
                    pixels=tuple((2 * u, 2 * v) for u, v in pixels))  # fmt: skip
    assert counted(tracks, stale, seen_by(CAMERA, share)).count == 10


def test_a_gate_whose_pixels_and_line_are_apart_is_reported() -> None:
    """The camera was turned by 5 degrees after the gate had been drawn."""
    turned = Camera.looking(
        (0.0, 0.0, 8.0), yaw=math.radians(5), pitch_down=0.25, size=(1280, 720), fov=math.radians(60)
    )
    gate = Gate(name="g", pixels=drawn_across(CAMERA, 40.0), size=(1280, 720), line=((40.0, -6.0), (40.0, 6.0)))
    half = replace(gate, size=(640, 360), pixels=tuple((u / 2, v / 2) for u, v in gate.pixels))
    drawn_only, surveyed = replace(gate, line=()), replace(gate, pixels=())
    far = 1280 / 2 / math.tan(math.radians(30)) * math.tan(math.radians(5))
    for camera, one, apart in (
        (CAMERA, gate, None), (CAMERA, half, None), (turned, drawn_only, None), (turned, surveyed, None),
        (turned, gate, far), (turned, half, far),
    ):  # fmt: skip
        report = measure([straight(1, (20, 0), (10, 0), 6.0)], seen_by(camera, None), replace(SITE, gates=(one,)))
        found = [line for line in report.notes if "px from its line" in line]
        assert len(found) == (apart is not None)
        on_a_slope = replace(seen_by(camera, None), ground=Ground(slope=(0.06, 0.0)))
        report = measure([straight(1, (20, 0), (10, 0), 6.0)], on_a_slope, replace(SITE, gates=(one,)))
        assert any("px from its line" in line for line in report.notes) == (apart is not None)
        if apart is not None:
            assert float(found[0].split(" px from")[0].rsplit(" ", 1)[1]) == pytest.approx(apart, rel=0.1)


def test_metre_gates_and_image_gates_count_alike_under_any_camera() -> None:
    """The same pixels of tracks and gate, taken for metres by cameras that are wrong by up to a quarter."""
    rng = np.random.default_rng(5)
    true = [straight(k, (15.0, rng.uniform(-5, 5)), (rng.uniform(3, 9), 0.0), 4.0, begin_s=2.5 * k) for k in range(20)]
    pixels = drawn_across(CAMERA, 36.0)
    gate = Gate(name="g", pixels=pixels, size=(1280, 720), directions=("away", "back"))
    expected = sum(one.xy[-1, 0] > 36.0 for one in true)
    assert 5 < expected < 20
    for height, pitch in ((8.0, 0.25), (6.0, 0.25), (10.0, 0.25), (8.0, 0.22), (7.0, 0.29)):
        wrong = Camera.looking((0.0, 0.0, height), yaw=0.1, pitch_down=pitch, size=(1280, 720), fov=math.radians(63))
        moved = []
        for one in true:
            seen, _, _ = CAMERA.project(one.position)
            moved.append(drive(one.number, intersect_ground(wrong, seen)[:, :2], one.times_s))
        assert counted(moved, gate, seen_by(wrong, 0.2)).count == expected, (height, pitch)


def test_the_cameras_error_is_one_for_all_at_a_surveyed_gate() -> None:
    """Ten vehicles stop 1 m before the gate, 50 m away: under some of the cameras all have crossed, else none."""
    drives = [straight(k, (20.0, -2.0), (4.0, 0.0), 29 / 4, begin_s=4.0 * k) for k in range(10)]
    tracks = [then(one, (0.0, 0.0), 5.0) for one in drives]
    gate = Gate(name="surveyed", line=((50.0, -6.0), (50.0, 6.0)), directions=("away", "back"))
    sure, unsure = (counted(tracks, gate, seen_by(CAMERA, share)) for share in (0.0, 0.05))
    assert (sure.count, unsure.count) == (0, 0)
    assert sure.confidence_interval is not None
    assert unsure.confidence_interval is not None
    assert sure.confidence_interval.high <= 2
    assert unsure.confidence_interval.high >= 10, "all may have crossed, and not by chance one or two of them"
    far = [straight(k, (20.0, -2.0), (8.0, 0.0), 7.0, begin_s=5.0 * k) for k in range(10)]
    told = counted(far, gate, seen_by(CAMERA, 0.03)).confidence_interval
    assert told == counted(far, gate, seen_by(CAMERA, 0.0)).confidence_interval, (
        "who drives on crosses under any camera"
    )


def test_a_surveyed_gate_lies_elsewhere_among_the_tracks_of_a_wrong_camera() -> None:
    """A camera taken to hang 10% too high puts everything 10% farther away: so must the gate be, under the true one."""
    known = within(CAMERA, 0.1)
    gate = Gate(name="g", line=((40.0, 6.0), (40.0, -6.0)))
    draws = gates_of_drawn_cameras((gate,), seen_by(CAMERA, 0.1))
    assert len(draws) == 24
    ratios = np.array([one.line[0][0] / 40.0 for (one,) in draws])
    assert ratios.std() == pytest.approx(0.1, rel=0.35)
    for (one,) in draws:
        (ax, ay), (bx, by) = one.line
        assert ay / ax == pytest.approx(6 / 40, abs=1e-6), "along the rays from the camera's foot"
        assert (bx, by) == pytest.approx((ax, -ay), abs=1e-6)
    assert gates_of_drawn_cameras((replace(gate, pixels=((1.0, 2.0), (3.0, 4.0))),), seen_by(CAMERA, 0.1)) == []
    assert gates_of_drawn_cameras((gate,), seen_by(CAMERA, None)) == []
    assert known.covariance.any()


def test_a_gate_whose_pixels_do_not_lie_on_the_road_is_named_and_not_counted_elsewhere() -> None:
    """Its old line, of another calibration, does not take their place."""
    above = Gate(name="sky", pixels=((100.0, 20.0), (900.0, 20.0)), line=((40.0, -6.0), (40.0, 6.0)))
    wide = Gate(name="wide", pixels=drawn_across(CAMERA, 40.0), size=(640, 480), line=above.line)
    report = measure([straight(1, (20, 0), (10, 0), 6.0)], seen_by(CAMERA, None), replace(SITE, gates=(above, wide)))
    assert not report.counts
    named = [line for line in report.notes if "not counted: its pixels do not lie on the road" in line]
    assert [line.split(":")[0] for line in named] == ["gate 'sky'", "gate 'wide'"]
