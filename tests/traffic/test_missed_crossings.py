"""Who crosses a gate and is not counted: lost before it, found behind it, or hardly followed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from skope.camera.model import Camera
from skope.site.site_file import SiteParts
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import crossing_doubts, crossing_probability, usual_step
from skope.traffic.measure import measure
from skope.traffic.traffic_report import TrafficReport
from tests.traffic.drives import GATE, straight, watched

ALWAYS = ClockInterval(begin_s=0.0, end_s=100.0, begin=None, end=None)
SITE = SiteParts(
    calibration=None,
    gates=(GATE,),
    zones=(),
    lanes=(),
    time_zone=None,
    start=None,
    world=None,
    plan=None,
    traffic=TrafficSettings(),
    unknown=(),
)


def told(*tracks: Track) -> TrafficReport:
    return measure(tracks, watched(60.0), SITE)


def between(report: TrafficReport, direction: str, who: str = "vehicle") -> tuple[int, int] | None:
    (one,) = (one for one in report.counts_total if (one.direction, one.class_name) == (direction, who))
    return None if one.confidence_interval is None else (one.confidence_interval.low, one.confidence_interval.high)


@pytest.mark.parametrize(
    ("start", "velocity", "direction", "begins"),
    [
        ((-45, 0), (10, 0), 0, False),  # ends 5 m before, half a second away
        ((5, 0), (10, 0), 0, True),
        ((45, 0), (-10, 0), 1, False),
        ((-5, 0), (-10, 0), 1, True),
    ],
)
def test_who_is_lost_before_a_gate_or_found_behind_it_may_have_crossed(
    start: tuple[float, float], velocity: tuple[float, float], direction: int, begins: bool
) -> None:
    report = told(straight(1, start, velocity, 4.0, begin_s=10.0))
    (one,) = report.unseen.vanished
    assert (one.direction, one.begins) == (direction, begins)
    assert one.time_s == pytest.approx(9.5 if begins else 14.5)
    names = ("west", "east")
    assert not report.crossings
    low, high = between(report, names[direction]) or (None, None)
    assert (low, high) == (0, 1)
    assert between(report, names[1 - direction]) == (0, 0)
    assert (between(report, names[1 - direction], "all") or (0, 0))[1] > 0, "two-wheelers and people are missed often"


def test_who_ends_elsewhere_has_crossed_nothing() -> None:
    observed = watched(60.0)
    tracks = {
        "ends with the footage": straight(1, (-45, 0), (10, 0), 4.0, begin_s=56.0),
        "far away": straight(2, (-90, 0), (10, 0), 4.0, begin_s=10.0),
        "drives away": straight(3, (-5, 0), (-10, 0), 2.0, begin_s=0.0),
        "beside the gate": straight(4, (-45, 8), (10, 0), 4.0, begin_s=10.0),
        "along the gate": straight(5, (-2, -20), (0, 8), 4.0, begin_s=10.0),
        "crosses": straight(6, (-20, 0), (10, 0), 4.0, begin_s=10.0),
    }
    for why, track in tracks.items():
        assert not measure([track], observed, SITE).unseen.vanished, why


def test_classes_that_do_not_count_are_not_missed_either() -> None:
    track = straight(1, (-45, 0), (10, 0), 4.0, begin_s=10.0)
    buses = replace(SITE, traffic=TrafficSettings(classes=("bus",)))
    assert told(track).unseen.vanished
    assert not measure([track], watched(60.0), buses).unseen.vanished


def test_many_who_are_lost_before_a_gate_make_its_count_as_uncertain_as_they_are_many() -> None:
    lost = [straight(k, (-45, 0), (10, 0), 4.0, begin_s=2.0 + k) for k in range(20)]
    through = [straight(k, (-45, 0), (10, 0), 9.0, begin_s=2.2 + k) for k in range(20, 45)]
    report = told(*lost, *through)
    low, high = between(report, "west") or (None, 0)
    assert 22 <= (low or 0) <= 25
    assert 43 <= high <= 50, "nearly none of them, or nearly all"
    assert report.unseen.most("g", 0, ALWAYS, ["car"]) == 20
    assert report.unseen.most("g", 0, ALWAYS, ["van"]) == 0


def test_a_gate_that_loses_more_vehicles_than_cross_it_says_nothing_of_their_number() -> None:
    lost = [straight(k, (-45, 0), (10, 0), 4.0, begin_s=2.0 + k) for k in range(20)]
    report = told(*lost, straight(20, (-45, 0), (10, 0), 9.0, begin_s=30.0))
    assert [between(report, "west", who) for who in ("all", "vehicle")] == [None, None]
    assert between(report, "east") == (0, 0)
    (line,) = (line for line in report.notes if "lost before it" in line)
    assert line.startswith("gate 'g' (west): no interval: more vehicles are lost before it, or found behind it, than")


@pytest.mark.parametrize(("focal_px", "known"), [(1500.0, True), (700.0, True), (400.0, False), (None, True)])
def test_where_people_are_too_small_to_be_seen_vehicles_alone_are_known(focal_px: float | None, known: bool) -> None:
    """At 40 m somebody is 64, 30 and 17 pixels high."""
    camera = None
    if focal_px is not None:
        fov = 2 * math.atan(640 / focal_px)
        camera = Camera.looking((0.0, -39.0, 8.9), yaw=1.57, pitch_down=0.2, size=(1280, 720), fov=fov)
    observed = replace(watched(60.0), camera=camera)
    report = measure([straight(k, (-30, 0), (10, 0), 6.0, begin_s=5.0 * k) for k in range(8)], observed, SITE)
    assert between(report, "west") is not None
    assert (between(report, "west", "all") is not None) == known
    assert any("too small in the image" in line for line in report.notes) != known


def test_where_vehicles_are_too_small_to_be_seen_no_count_is_known() -> None:
    """At 90 m and 600 px of focal length a car is 10 pixels high."""
    camera = Camera.looking((0.0, -90.0, 8.9), yaw=1.57, pitch_down=0.1, size=(1280, 720), fov=2 * math.atan(640 / 600))
    report = measure([straight(1, (-30, 0), (10, 0), 6.0)], replace(watched(60.0), camera=camera), SITE)
    assert [between(report, "west", who) for who in ("all", "vehicle")] == [None, None]
    (line,) = (line for line in report.notes if "gate 'g' (west)" in line)
    assert "no interval: vehicles are too small in the image there, and few are detected" in line


def test_a_gate_that_nobody_was_ever_seen_near_has_no_count_that_is_known() -> None:
    report = told(straight(1, (-90, 40), (5, 0), 6.0, begin_s=10.0))
    assert between(report, "west") is None
    assert any("gate 'g': no road user was ever detected near it" in line for line in report.notes)
    assert all(one.confidence_interval is None for one in report.counts)


def seldom(every: int) -> Track:
    """A vehicle that crosses at 16 s, located in every n-th of its moments."""
    track = straight(1, (-60, 0), (10, 0), 12.0, begin_s=10.0)
    return replace(track, located=np.arange(len(track.times_s)) % every == 0)


def test_a_crossing_is_in_doubt_where_its_track_is_short_on_one_side_or_has_a_gap() -> None:
    whole = seldom(1)
    short = whole.during(whole.times_s <= 16.3)
    gap = replace(whole, located=np.abs(whole.times_s - 16.0) > 0.5)
    both = gap.during(gap.times_s <= 16.7)
    assert [crossing_doubts(one, 16.0, 0.1) for one in (whole, short, gap, both)] == [0, 1, 1, 1]
    edge = replace(short, located=(short.times_s < 15.0) | (short.times_s > 16.2))
    assert crossing_doubts(edge, 16.0, 0.1) == 2
    chances = [crossing_probability(one, 16.0, 0.1) for one in (whole, short, edge)]
    assert chances[0] > chances[1] >= chances[2]
    assert chances[0] > 0.95
    flagged = replace(whole, flags=("two_poses",))
    assert crossing_probability(flagged, 16.0, 0.1) == pytest.approx(0.75 * chances[0])


def test_who_is_seen_in_key_frames_alone_is_not_less_sure_for_that() -> None:
    keys = [seldom(5), replace(seldom(5), number=2)]
    assert usual_step(keys) == pytest.approx(0.5)
    assert crossing_doubts(keys[0], 16.0, usual_step(keys)) == 0
    assert crossing_probability(keys[0], 16.0, usual_step(keys)) == crossing_probability(seldom(1), 16.0, 0.1)


def test_a_track_that_leaves_the_image_behind_the_gate_has_no_gap() -> None:
    """The second after it has left is no time without a position."""
    whole = seldom(1)
    leaves = whole.during(whole.times_s <= 16.8)
    assert crossing_doubts(leaves, 16.0, 0.1) == 0
    assert crossing_probability(leaves, 16.0, 0.1) == crossing_probability(whole, 16.0, 0.1)


def test_a_crossing_that_is_more_probably_none_is_not_counted() -> None:
    others = [straight(k, (-30, 3), (10, 0), 6.0, begin_s=3.0 * k) for k in range(2, 12)]
    report = told(*others, replace(seldom(1), stitch_probability=0.4))
    assert [one.trajectory.number for one in report.unseen.doubtful] == [1]
    assert between(report, "west") is not None
    (total,) = (one for one in report.counts_total if (one.direction, one.class_name) == ("west", "vehicle"))
    assert total.count == 10
    assert (total.confidence_interval.high if total.confidence_interval else 0) >= 11, "it may have been one"
