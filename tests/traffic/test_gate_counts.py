"""Counts on the clock, how sure they are, and movements that add up to them."""

import itertools
from dataclasses import replace
from datetime import datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.counting_intervals import clock_intervals
from skope.traffic.event_probability import usual_step
from skope.traffic.gate_counts import ALL_CLASSES, interval_counts
from skope.traffic.gates import gate_crossings
from skope.traffic.lanes import LaneMap
from skope.traffic.missed_crossings import MissedCrossings
from skope.traffic.observation import Observation
from skope.traffic.turning_movements import NO_GATE, movements, turning_counts
from tests.traffic.drives import GATE, drive, straight, watched

BERLIN = ZoneInfo("Europe/Berlin")
NO_LANES = LaneMap(())


def test_days_with_a_change_of_the_clock() -> None:
    """23 and 25 hours, the hour that comes twice twice, none longer than it says; checked second by second."""
    for day, hours in ((datetime(2026, 3, 29), 23), (datetime(2026, 10, 25), 25), (datetime(2026, 6, 1), 24)):
        start = day.replace(tzinfo=BERLIN)
        found = clock_intervals(start, 0.0, hours * 3600.0, 15)
        assert len(found) == 4 * hours
        assert found[0].begin == start
        assert found[-1].end == start + timedelta(days=1)
        assert {one.end_s - one.begin_s for one in found} == {900.0}
        assert len({one.begin.isoformat() for one in found if one.begin}) == len(found)
        for before, after in itertools.pairwise(found):
            assert before.end_s == after.begin_s
        hourly = clock_intervals(start, 0.0, hours * 3600.0, 60)
        assert len(hourly) == hours
        half_days = [one.end_s - one.begin_s for one in clock_intervals(start, 0.0, hours * 3600.0, 720)]
        assert sum(half_days) == hours * 3600.0
        assert max(half_days) <= 12 * 3600.0


def test_intervals_begin_on_the_clock_whenever_the_footage_does() -> None:
    start = datetime(2026, 11, 26, 10, 7, 31, tzinfo=BERLIN)
    found = clock_intervals(start, 0.0, 1200.0, 15)
    assert [f"{one.begin:%H:%M}" for one in found if one.begin] == ["10:00", "10:15"]
    assert [one.begin_s for one in found] == [-451.0, 449.0]
    lord_howe = datetime(2026, 4, 5, 0, 0, tzinfo=ZoneInfo("Australia/Lord_Howe"))  # clocks go back half an hour
    assert sum(one.end_s - one.begin_s for one in clock_intervals(lord_howe, 0, 24.5 * 3600, 60)) == 24.5 * 3600
    assert [one.begin_s for one in clock_intervals(None, 10.0, 1900.0, 15)] == [0.0, 900.0, 1800.0]


def test_nothing_counted_and_nothing_observed_are_told_apart() -> None:
    """Footage with an hour's gap: a count of 0 before it, none in it, a part after it."""
    times = np.concatenate([np.arange(0, 900), np.arange(4500, 4800)]).astype(float)
    seen = Observation(times_s=times)
    start = datetime(2026, 11, 26, 10, 0, tzinfo=BERLIN)
    found = gate_crossings([straight(1, (-30, 0), (10, 0), 6, begin_s=4600)], [GATE], NO_LANES, TrafficSettings())
    rows = interval_counts(
        found, [GATE], [], clock_intervals(start, 0, 4800, 15), seen, TrafficSettings(), MissedCrossings()
    )
    west = [(one.observed, one.count) for one in rows if (one.direction, one.class_name) == ("west", ALL_CLASSES)]
    assert west == [("full", 0), *[("none", None)] * 4, ("partial", 1)]
    assert all((one.confidence_interval is None) == (one.count is None) for one in rows if one.class_name != "unknown")
    assert seen.together(10.0, 890.0)
    assert not seen.together(890.0, 4600.0)


def test_one_class_for_each_track_and_classes_add_up() -> None:
    rng = np.random.default_rng(2)
    names = rng.choice(["car", "van", "lorry", "unknown", "pedestrian"], 40)
    tracks = [
        straight(k, (-20, 0), (10, 0), 4, begin_s=5.0 * k, class_name=str(name), class_confidence=0.8)
        for k, name in enumerate(names)
    ]
    settings = TrafficSettings()
    found = gate_crossings(tracks, [GATE], NO_LANES, settings)
    rows = interval_counts(
        found, [GATE], [], clock_intervals(None, 0, 200, 15), watched(200), settings, MissedCrossings()
    )
    by_class = {one.class_name: one for one in rows if one.direction == "west"}
    assert by_class.pop(ALL_CLASSES).count == 40
    assert by_class.pop("vehicle").count == int((names != "pedestrian").sum())
    assert sum(one.count or 0 for one in by_class.values()) == 40
    assert {name: one.count for name, one in by_class.items() if one.count} == {
        str(name): int((names == name).sum()) for name in set(names)
    }
    # A van may be a car that was taken for one: the interval of cars goes beyond their count.
    cars = by_class["car"]
    assert cars.confidence_interval is not None
    assert cars.count is not None
    assert cars.confidence_interval.high > cars.count + 3


# --------------------------------------------------------------------------------------------------------- movements

ARMS = tuple(
    Gate(name=name, line=line, directions=("in", "out"))
    for name, line in (
        ("north", ((-5.0, 10.0), (5.0, 10.0))),
        ("east", ((10.0, 5.0), (10.0, -5.0))),
        ("south", ((5.0, -10.0), (-5.0, -10.0))),
        ("west", ((-10.0, -5.0), (-10.0, 5.0))),
    )
)
"""A gate across each arm of a junction; "in" is towards its middle."""
FAR = {"north": (0, 20), "east": (20, 0), "south": (0, -20), "west": (-20, 0)}


def turn(number: int, origin: str, destination: str, begin_s: float, *, until: float = 1.0) -> Track:
    """From one arm to another, or as far as `until` of the way."""
    corners = [FAR[origin], (0.0, 0.0), FAR[destination]]
    t = np.linspace(0, 2 * until, round(80 * until))
    places = np.stack([np.interp(t, [0, 1, 2], [corner[k] for corner in corners]) for k in (0, 1)], axis=1)
    return drive(number, places + [1.0, 1.0], begin_s + 0.1 * np.arange(len(t)))


def test_movements_with_u_turns_add_up_to_the_gates_counts() -> None:
    rng = np.random.default_rng(3)
    names = list(FAR)
    tracks = [
        turn(k, str(rng.choice(names)), str(rng.choice(names)), 3.0 * k, until=float(rng.choice([0.2, 0.6, 1.0])))
        for k in range(150)
    ]
    tracks += [turn(200 + k, name, name, 470.0 + 10 * k) for k, name in enumerate(names)]
    settings = TrafficSettings()
    found = gate_crossings(tracks, ARMS, NO_LANES, settings)
    moved = movements(found, settings)
    intervals = clock_intervals(None, 0, 520, 1)
    every = turning_counts(moved, ARMS, intervals, watched(520), settings, MissedCrossings())
    rows, vehicles = ([one for one in every if one.class_name == name] for name in (ALL_CLASSES, "vehicle"))
    assert [one.count for one in vehicles] == [one.count for one in rows]  # there is nobody else
    per_gate = interval_counts(found, ARMS, [], intervals, watched(520), settings, MissedCrossings())
    for arm, direction in itertools.product(names, ("in", "out")):
        side = arm, direction
        total = sum(one.gate == arm and one.direction_name == direction for one in found)
        assert sum(one.count or 0 for one in rows if one.origin == side) == total
        assert sum(one.count or 0 for one in rows if one.destination == side) == total
        for interval in intervals:  # and interval by interval, where somebody comes from
            told = [one.count for one in per_gate if (one.gate, one.direction, one.class_name) == (*side, ALL_CLASSES)
                    and one.interval == interval]  # fmt: skip
            assert told == [sum(one.count or 0 for one in rows if (one.origin, one.interval) == (side, interval))]
    whole = [track for track in tracks if len(track.times_s) == 80]
    for origin, destination in itertools.product(names, repeat=2):
        wanted = sum(
            np.allclose(one.xy[0], np.add(FAR[origin], 1)) and np.allclose(one.xy[-1], np.add(FAR[destination], 1))
            for one in whole
        )
        pair = (origin, "in"), (destination, "out")
        assert sum(one.count or 0 for one in rows if (one.origin, one.destination) == pair) == wanted
        assert wanted or origin != destination, "W to W as well"
    lost = [one for one in rows if one.destination == NO_GATE and one.origin[1] == "in"]
    assert sum(one.count or 0 for one in lost) > 20
    assert all(one.confidence_interval is None for one in lost)


def test_a_track_that_nothing_was_seen_of_for_long_is_no_movement_and_stays_in_the_gates_counts() -> None:
    settings = TrafficSettings()
    seen = turn(1, "west", "east", 0)
    sides = [seen, *(replace(seen, number=k, located=hidden(seen, around_s)) for k, around_s in ((2, 0.5), (3, 1.5)))]
    step_s = usual_step(sides)
    found = movements(gate_crossings(sides, ARMS, NO_LANES, settings), settings, step_s)
    way = (("west", "in"), ("east", "out"))
    assert [one.trajectory.number for one in found if one.sides == way] == [1, 2]
    third = [one.sides for one in found if one.trajectory.number == 3]
    for k in (0, 1):
        assert [sides[k] for sides in third].count(way[k]) == 1, "each crossing is in one row and in one column"
    same = {one.trajectory.number: one.same for one in found if one.sides == way}
    assert same[1] > 0.99
    assert 0.7 < same[2] < 0.97
    unbroken = movements(gate_crossings(sides, ARMS, NO_LANES, settings), settings)
    assert [one.sides for one in unbroken].count(way) == 3, "a simulation's tracks are whole"


def hidden(track: Track, around_s: float) -> NDArray[np.bool_]:
    """Nothing is seen of it for so long before and after its middle."""
    middle = track.times_s.mean()
    return np.asarray(np.abs(track.times_s - middle) > around_s)


def test_who_walks_beside_others_makes_no_movement() -> None:
    settings = TrafficSettings()
    walkers = [
        replace(turn(k, "west", "east", 0), category="pedestrian", class_name="pedestrian", covariance=covariance)
        for k, sigma in ((1, 0.2), (2, 0.8))
        for covariance in [np.tile(sigma**2 * np.eye(2), (80, 1, 1))]
    ]
    found = movements(gate_crossings(walkers, ARMS, NO_LANES, settings), settings, 0.1)
    between = [one.trajectory.number for one in found if NO_GATE not in one.sides]
    assert between == [1]


def test_where_people_walk_movements_are_known_of_vehicles_alone() -> None:
    settings = TrafficSettings()
    walker = replace(turn(9, "south", "east", 40), category="pedestrian", class_name="pedestrian")
    tracks = [*(turn(k, "west", "east", 5.0 * k) for k in range(3)), turn(3, "west", "north", 30.0), walker]
    found = movements(gate_crossings(tracks, ARMS, NO_LANES, settings), settings, 0.1)
    told = {
        (one.destination[0], one.class_name): one.confidence_interval
        for one in turning_counts(
            found, ARMS, clock_intervals(None, 0, 60, 1), watched(60), settings, MissedCrossings()
        )
        if one.origin == ("west", "in")
    }
    assert told["east", ALL_CLASSES] is None, "one of those who walk may have come from there"
    assert told["east", "vehicle"] is not None
    assert told["north", ALL_CLASSES] is not None


def test_movements_count_between_the_gates_that_are_named() -> None:
    settings = TrafficSettings(turning=("north", "south"))
    tracks = [turn(1, "north", "east", 0), turn(2, "north", "south", 5), turn(3, "west", "south", 9)]
    found = movements(gate_crossings(tracks, ARMS, NO_LANES, settings), settings)
    assert [one.sides for one in found if NO_GATE not in one.sides] == [(("north", "in"), ("south", "out"))]
