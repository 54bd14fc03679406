"""Times to collision, encroachment and the deceleration that avoids a crash, against closed forms."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from shapely import Polygon

from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.conflicts import Conflict, conflicts
from skope.traffic.event_probability import event_probability
from skope.traffic.footprints import FootprintPath, Footprints, meeting, meeting_within, overlap
from skope.traffic.post_encroachment_time import by_area, by_places
from skope.traffic.stitch_broken_tracks import stitch_tracks
from skope.traffic.time_to_collision import deceleration_to_avoid, times_to_collision
from skope.types import Array
from tests.traffic.drives import drive, straight, then


def found(*tracks: Track, **settings: float) -> Sequence[Conflict]:
    return conflicts(tracks, TrafficSettings(**settings), np.random.default_rng(0)).conflicts


def scattered(rng: np.random.Generator, size: tuple[float, float], count: int = 400) -> Footprints:
    turn = rng.uniform(0, 7, count)
    return Footprints(rng.uniform(-5, 5, (count, 2)), np.stack([np.cos(turn), np.sin(turn)], axis=1), size)


def intersecting(first: Footprints, second: Footprints) -> Array:
    """Return whether footprints intersect, according to shapely."""
    return np.array([Polygon(a).intersects(Polygon(b)) for a, b in zip(first.corners, second.corners, strict=True)])


def moved(footprints: Footprints, velocity: Array, time_s: Array | float) -> Footprints:
    return Footprints(footprints.centre + velocity * np.reshape(time_s, (-1, 1)), footprints.facing, footprints.size)


def test_rectangles_meet_when_shapely_says_so() -> None:
    rng = np.random.default_rng(0)
    first, second, velocity = scattered(rng, (4.0, 2.0)), scattered(rng, (12.0, 2.5)), rng.normal(0, 3, (2, 400, 2))
    assert overlap(first, second).tolist() == intersecting(first, second).tolist()
    begin, end = meeting(first, second, velocity[1] - velocity[0])
    met = begin <= end
    assert 100 < met.sum() < 400
    for times_s, wanted in ((begin - 1e-3, False), ((begin + end) / 2, True), (end + 1e-3, False)):
        pair = [
            moved(footprints, speed, times_s)[met] for footprints, speed in zip((first, second), velocity, strict=True)
        ]
        assert (intersecting(*pair) == wanted).all()


def test_the_corners_of_a_footprint() -> None:
    facing = Footprints(np.array([[10.0, 5.0]]), np.array([[0.0, 1.0]]), (4.0, 2.0))
    assert facing.corners[0].tolist() == [[9, 7], [11, 7], [11, 3], [9, 3]]
    assert facing.radius == math.sqrt(5)
    assert facing.scaled(0.5).corners[0].tolist() == [[9.5, 6], [10.5, 6], [10.5, 4], [9.5, 4]]


def test_footprints_meet_within_a_time_when_they_do_at_one_of_its_moments() -> None:
    rng = np.random.default_rng(1)
    first, second, velocity = scattered(rng, (4.0, 2.0)), scattered(rng, (12.0, 2.5)), rng.normal(0, 4, (2, 400, 2))
    begin, end = meeting_within(first, second, velocity[1] - velocity[0], 0.5)
    wanted = np.zeros(400, dtype=bool)
    for time_s in np.linspace(0, 0.5, 101):
        meets = intersecting(moved(first, velocity[0], time_s), moved(second, velocity[1], time_s))
        wanted |= meets
        assert (meets <= (begin <= time_s + 1e-9)).all()
        assert (meets <= (time_s - 1e-9 <= end)).all()
        # Rounding may decide otherwise only at the ends of a period.
        inside = (begin + 1e-9 < time_s) & (time_s < end - 1e-9)
        assert (inside <= meets).all()
    assert 100 < wanted.sum() < 350
    assert (np.isfinite(begin) & ~wanted).sum() <= 5, "an overlap between two of the 101 times"
    assert (begin[np.isfinite(begin)] >= 0).all()
    assert (end[np.isfinite(end)] <= 0.5).all()
    every, _ = meeting_within(first[:, None], second[None], velocity[1][None] - velocity[0][:, None], 0.5)
    assert np.diagonal(every) == pytest.approx(begin)


def test_one_behind_the_other() -> None:
    """15 m/s behind 5 m/s, bumpers 20 m apart at first: TTC = gap / 10, DRAC = 10^2 / (2 gap)."""
    slow, fast = straight(1, (24, 0), (5, 0), 1.5), straight(2, (0, 0), (15, 0), 1.5)
    paths = FootprintPath(fast, 0.1), FootprintPath(slow, 0.1)
    rows = np.arange(15), np.arange(15)
    gap = 20 - 10 * 0.1 * np.arange(15)
    seconds = times_to_collision(*paths, rows, 3.0)
    assert seconds == pytest.approx(gap / 10)
    assert deceleration_to_avoid(*paths, rows, seconds) == pytest.approx(100 / (2 * gap))
    slow, fast = then(slow, (5, 0)), then(fast, (5, 0))  # it brakes then
    (one,) = found(slow, fast)
    assert (one.first.number, one.second.number, one.kind) == (1, 2, "rear end")
    assert one.ttc_s == pytest.approx((20 - 15) / 10)
    assert one.drac_ms2 == pytest.approx(100 / (2 * 5), rel=0.02)
    assert one.drac_low_ms2 < one.drac_ms2 < one.drac_high_ms2 < 1.2 * one.drac_ms2
    assert math.isnan(one.pet_area_s), "on one way there is no area that both cross"
    # The gap is known to 0.05 m on either side, the speeds to 0.1 m/s: the time to sigma of about 0.01 s.
    assert one.ttc_low_s < one.ttc_s < one.ttc_high_s
    assert one.ttc_high_s - one.ttc_low_s == pytest.approx(2 * 1.645 * math.hypot(0.1, 0.5 * math.sqrt(2) * 0.2 / 2)
                                                           / 10, rel=0.5)  # fmt: skip
    assert one.probability == pytest.approx(event_probability(slow) * event_probability(fast))


def crossing(late_s: float) -> tuple[Track, Track]:
    """10 m/s along x and 8 m/s along y, both 4 m by 2 m: the first's rear leaves the other's way `late_s` before the
    other's front reaches its way."""
    first = straight(1, (-30, 0), (10, 0), 8)
    leaves = (30 + 1 + 2) / 10  # its rear is 1 m beyond the middle of the other's way
    enters = leaves + late_s  # the other's front is 1 m before the middle of its way
    return first, straight(2, (0, -1 - 2 - 8 * enters), (0, 8), 12)


@pytest.mark.parametrize("late_s", [0.3, 1.37, 3.0, 4.9])
def test_encroachment_of_crossing_ways(late_s: float) -> None:
    """At a right angle and constant speeds both definitions agree."""
    for tracks in (crossing(late_s), crossing(late_s)[::-1]):
        (one,) = found(*tracks)
        assert (one.first.number, one.second.number, one.kind) == (1, 2, "crossing")
        assert one.pet_ssam_s == pytest.approx(late_s, abs=0.03)
        assert one.pet_area_s == pytest.approx(late_s, abs=0.03)
        assert one.angle_deg == pytest.approx(90)
        assert one.pet_sigma_s == pytest.approx(math.hypot(math.hypot(0.05, 0.15) / 10, math.hypot(0.05, 0.15) / 8))
    assert not found(*crossing(5.3))


def test_collision_course_of_crossing_ways() -> None:
    """Both would be in the middle at once; a second before they stop."""
    one, other = straight(1, (-30, 0), (10, 0), 2.0), straight(2, (0, -30), (0, 10), 2.0)
    (conflict,) = found(then(one, (0, 0)), then(other, (0, 0)))
    # From 10 m before: fronts meet when each of them has 1 m of half width and 2 m of half length to go.
    assert conflict.ttc_s == pytest.approx((10 - 2 - 1) / 10, abs=1e-6)
    assert conflict.kind == "crossing"
    assert math.isnan(conflict.pet_ssam_s)
    # Each could let the other one pass, who has gone when its rear is 1 m beyond the middle: in 1.3 s. The one that
    # has 7 m to go until then brakes by 2 (v - d / t) / t, if it does not stop before: by v^2 / (2 d).
    passing = 2 * (10 - 7 / 1.3) / 1.3
    assert conflict.drac_ms2 == pytest.approx(passing if 10 - passing * 1.3 > 0 else 100 / 14)


def test_the_two_definitions_of_encroachment_differ_behind_one_another() -> None:
    """At 10 m/s, 6 m behind: 0.6 s until the second one's front is where the first one's rear was, but both are on the
    way that both drive along at once. What SSAM says, and what is usually said, of the same tracks."""
    paths = [FootprintPath(straight(k, (-10 * k, 0), (10, 0), 6), 0.1) for k in (1, 2)]
    by_ssam, usual = by_places(*paths, 5.0), by_area(*paths, 3.0)
    assert by_ssam is not None
    assert usual is not None
    assert (by_ssam.seconds, usual.seconds) == (pytest.approx(0.6, abs=0.02), 0.0)
    assert not by_ssam.swapped


def test_no_conflict() -> None:
    beside = straight(1, (0, 0), (15, 0), 4), straight(2, (-20, 3.2), (18, 0), 4)
    behind = straight(1, (30, 0), (10, 0), 4), straight(2, (0, 0), (10.2, 0), 4)
    oncoming = straight(1, (0, 0), (15, 0), 4), straight(2, (60, 3.5), (-15, 0), 4)
    assert not found(*beside)
    assert not found(*behind)
    assert not found(*oncoming)
    bend = np.arange(0, 6, 0.1)  # two that turn, one behind the other by two seconds
    ways = [np.stack([20 * np.sin(s), 20 - 20 * np.cos(s)], axis=1) for s in (bend / 4,)]
    assert not found(drive(1, ways[0]), drive(2, ways[0], bend + 2.0))
    walkers = [straight(k, (0, 0.3 * k), (1, 0), 4, category="pedestrian", class_name="pedestrian") for k in (1, 2)]
    assert not found(*walkers)


def test_two_tracks_of_one_vehicle_are_no_conflict() -> None:
    search = conflicts(
        [straight(1, (0, 0), (10, 0), 4), straight(2, (0.8, 0.3), (10, 0), 4)],
        TrafficSettings(),
        np.random.default_rng(0),
    )
    assert (len(search.conflicts), search.overlapping) == (0, 1)


def test_an_implausible_speed_is_in_no_conflict() -> None:
    first, second = crossing(1.0)
    assert found(first, second)
    assert not found(first, replace(second, flags=("implausible_speed",)))


@pytest.mark.parametrize("wrong", ["gap", "end", "few", "vague"])
def test_who_is_hardly_followed_is_in_no_conflict(wrong: str) -> None:
    first, second = crossing(1.0)
    assert not conflicts((first, second), TrafficSettings(), np.random.default_rng(0)).poorly_tracked_pairs
    there = np.abs(second.times_s - 4.3) < 0.4
    worse = {
        "gap": replace(second, located=~there),
        "end": second.during(second.times_s < 4.5),
        "few": replace(second, located=np.arange(len(second.times_s)) % 14 == 0),
        "vague": replace(second, covariance=np.where(there[:, None, None], np.eye(2), second.covariance)),
    }[wrong]
    search = conflicts((first, worse), TrafficSettings(), np.random.default_rng(0))
    assert (search.conflicts, search.poorly_tracked_pairs) == ((), 1)


# ----------------------------------------------------------------------------------------------------------- joining


def hidden(number: int, begin_s: float, end_s: float, *, y: float = 0.0, speed: float = 12.0, **others: float) -> Track:
    """A part of a drive along x that begins at 0 at second 0."""
    return straight(number, (speed * begin_s, y), (speed, 0), end_s - begin_s, begin_s=begin_s, **others)


def test_broken_tracks_are_joined_and_say_so() -> None:
    """Hidden for 1.5 s; a third part, hidden for half a second; and one that goes on while the next one has begun."""
    parts = [hidden(1, 0, 4), hidden(2, 5.5, 8), hidden(3, 8.5, 11), hidden(4, 10.7, 14)]
    (whole,) = stitch_tracks(parts[::-1])
    assert (whole.number, whole.joined) == (1, (2, 3, 4))
    assert 0.9 < whole.stitch_probability < 1
    assert (np.diff(whole.times_s) > 0).all()
    assert whole.at(whole.xy, 4.75) == pytest.approx([57.0, 0.0], abs=0.01)


def test_others_are_not_joined() -> None:
    first = hidden(1, 0, 4)
    for other in (
        hidden(2, 5.5, 8, y=3.5),  # the next lane
        hidden(2, 5.5, 8, length=12.0),  # a lorry
        hidden(2, 4.5, 8, speed=25.0),  # elsewhere
        straight(2, (66, 0), (-12, 0), 3, begin_s=5.5),  # the other way
        hidden(2, 5.5, 8, category="bicycle"),  # type: ignore[arg-type]
        hidden(2, 20, 24),  # after too long
    ):
        assert len(stitch_tracks([first, other])) == 2
    # Two who may both be meant: neither is.
    assert len(stitch_tracks([first, hidden(2, 5.5, 8, y=0.4), hidden(3, 5.5, 8, y=-0.4)])) == 3


def test_a_parked_car_stays_parked_when_its_tracks_are_joined() -> None:
    """And one that waits and then drives has moved."""
    parked = [straight(k, (5, 5), (0, 0), 6, begin_s=7.0 * k, flags=("never_moved",)) for k in range(2)]
    assert [one.flags for one in stitch_tracks(parked)] == [("never_moved",)]
    drums = [replace(one, category="bicycle", class_name="bicycle") for one in parked]
    assert len(stitch_tracks(drums)) == 2, "of another category it is an object, which is joined to nobody"
    leaves = drive(3, [(5 + 0.02 * max(0, k - 5) ** 2, 5) for k in range(60)], 13.2 + 0.1 * np.arange(60))
    assert [one.flags for one in stitch_tracks([parked[1], leaves])] == [()]
