"""Speeds, headways, gaps, occupancy, queues, stops and delays, against what was driven."""

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from scipy.stats import binom

from skope.site.gates_zones_lanes import Gate, Lane, Zone
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.count_uncertainty import count_interval
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import event_probability, queue_miss_rate
from skope.traffic.gates import gate_crossings
from skope.traffic.headways import headways, occupancies
from skope.traffic.lanes import LaneMap
from skope.traffic.observation import Observation
from skope.traffic.queues import delays, queues
from skope.traffic.speeds import order_ranks, section_passes, speed_groups, speed_percentiles, way
from skope.traffic.time_to_collision import hard_brakings
from skope.traffic.turning_movements import movements
from skope.traffic.zones import visits
from tests.traffic.drives import GATE, along_x, drive, straight, watched

NO_LANES = LaneMap(())
MISSED = queue_miss_rate()
SETTINGS = TrafficSettings()
FAR_GATE = Gate(name="far", line=((60.0, -5.0), (60.0, 5.0)))
WHOLE = ClockInterval(begin_s=0.0, end_s=900.0, begin=None, end=None)


def test_ranks_of_a_quantile_hold_by_the_binomial_distribution() -> None:
    for n, share in ((19, 0.85), (40, 0.85), (200, 0.15), (7, 0.5)):
        ranks = order_ranks(n, share)
        assert ranks is not None
        low, high = ranks
        # Of so many values below the quantile, low + 1 up to high: then it lies between the two.
        inside = [sum(binom.pmf(k, n, share) for k in range(a + 1, b + 1)) for a, b in ((low, high), (low + 1, high))]
        assert inside[0] >= 0.9
        assert sum(binom.pmf(k, n, share) for k in range(low + 1)) <= 0.05 < binom.cdf(low + 1, n, share)
    assert order_ranks(18, 0.85) is None


@pytest.mark.parametrize(("noise", "common"), [(0.0, 0.0), (1.0, 0.0), (0.6, 0.03)])
def test_the_interval_of_v85_holds_it_in_nine_of_ten(noise: float, common: float) -> None:
    """Noise of half the spread makes the raw v85 8% too high above the median; all share the camera's error."""
    rng = np.random.default_rng(4)
    truth, held, values = 14 + 2 * NormalDist().inv_cdf(0.85), 0, []
    for _ in range(300):
        speeds = (rng.normal(14, 2, 100) + rng.normal(0, noise, 100)) * (1 + rng.normal(0, common))
        found = speed_percentiles(speeds.tolist(), [noise] * 100, common)["v85"]
        assert found.value is not None
        assert found.low is not None
        assert found.high is not None
        held += found.low <= truth <= found.high
        values.append(found.value)
    assert 0.86 < held / 300 < 0.98
    assert np.mean(values) == pytest.approx(truth, abs=0.06)


def test_percentiles_that_cannot_be_told_are_refused_with_the_reason() -> None:
    few = speed_percentiles([10.0, 11.0, 12.0, 13.0, 14.0], [0.1] * 5, None)
    assert few["v50"].value == 12.0
    assert (few["v85"].value, few["v85"].unavailable_reason) == (None, "5 vehicles: an interval needs 19")
    noisy = speed_percentiles(np.random.default_rng(0).normal(10, 1, 50).tolist(), [1.0] * 50, None)
    assert noisy["v85"].unavailable_reason == "the spread of the speeds is too small compared with their errors"
    assert speed_percentiles([], [], None)["v50"].value is None


def test_section_speed_is_the_way_over_the_time() -> None:
    """Round a quarter circle of 40 m radius, and with a stop that jitters."""
    t = np.arange(0, 12, 0.1)
    bend = drive(1, np.stack([40 * np.sin(t / 6), 40 - 40 * np.cos(t / 6)], axis=1))
    assert way(bend, 1.0, 9.0) == pytest.approx(40 * 8 / 6, rel=1e-3)
    x = np.interp(np.arange(0, 30, 0.1), [0, 5, 20, 30], [-10, 30, 30, 80])
    stopped = along_x(2, x + 0.02 * np.random.default_rng(0).normal(size=len(x)))
    (one,) = section_passes(movements(gate_crossings([stopped], [GATE, FAR_GATE], NO_LANES, SETTINGS), SETTINGS))
    assert one.length_m == pytest.approx(60, abs=0.3)
    assert one.seconds == pytest.approx(1.25 * 3 + 15 + 6 - 0.0, abs=0.1)
    assert one.speed == pytest.approx(one.length_m / one.seconds)
    (late,) = delays([one], [], TrafficSettings(free_flow_kmh=36))
    assert (late.stops, late.stopped_s) == (1, pytest.approx(15, abs=0.3))
    assert late.delay_s == pytest.approx(one.seconds - 6, abs=0.1)
    assert math.isnan(delays([one], [], SETTINGS)[0].delay_s), "no speed of free flow, no delay"


def test_a_stop_that_speeds_leave_open_is_one_perhaps() -> None:
    """Down to 0.7 m/s (2.5 km/h) for three seconds: a stop, or none where speeds are half a metre a second higher."""
    speed = np.interp(np.arange(0, 30, 0.1), [0, 5, 8, 11, 14], [10, 10, 0.7, 0.7, 10])
    slow = along_x(1, -10 + 0.1 * np.cumsum(speed))
    told = []
    for sigma in (0.01, 0.3):
        track = replace(slow, speed_sigma=np.full(300, sigma))
        (one,) = section_passes(movements(gate_crossings([track], [GATE, FAR_GATE], NO_LANES, SETTINGS), SETTINGS))
        (late,) = delays([one], [], SETTINGS)
        told.append((late.stops, late.stops_bounds.low, late.stops_bounds.high))
    assert told == [(1, 1, 1), (1, 0, 1)]


def test_free_flow_is_the_sections_own_85th_percentile() -> None:
    speeds = np.random.default_rng(5).normal(15, 2, 60)
    tracks = [straight(k, (-20, 0), (v, 0), 100 / v, begin_s=10.0 * k) for k, v in enumerate(speeds)]
    found = gate_crossings(tracks, [GATE, FAR_GATE], NO_LANES, SETTINGS)
    sections = section_passes(movements(found, SETTINGS))
    groups = speed_groups(found, sections, [], watched(700))
    v85 = next(one for one in groups if one.kind == "section" and one.class_name == "motor").percentiles["v85"].value
    assert v85 == pytest.approx(np.quantile(speeds, 0.85), rel=0.01)
    late = delays(sections, groups, SETTINGS)
    assert [one.delay_s for one in late] == pytest.approx(60 / speeds - 60 / v85, abs=0.02)


def test_an_implausible_speed_is_in_no_percentile_and_no_braking_but_counts() -> None:
    plain = [straight(k, (-20, 0), (15.0 + 0.1 * k, 0), 6, begin_s=10.0 * k) for k in range(5)]
    odd = replace(straight(9, (-20, 0), (4.0, 0), 25, begin_s=60.0), flags=("implausible_speed",))
    crossed = gate_crossings([*plain, odd], [GATE, FAR_GATE], NO_LANES, SETTINGS)
    assert sum(one.is_counted for one in crossed) == 12
    groups = speed_groups(crossed, section_passes(movements(crossed, SETTINGS)), [], watched(100))
    assert {(one.kind, one.number) for one in groups if one.class_name == "motor"} == {("spot", 5), ("section", 5)}
    x = np.cumsum(np.clip(15 - 6 * np.clip(np.arange(0, 6, 0.1) - 2, 0, None), 0, None)) * 0.1
    assert len(hard_brakings([along_x(1, x)], SETTINGS)) == 1
    assert not hard_brakings([along_x(1, x, flags=("implausible_speed",))], SETTINGS)


def test_headways_and_gaps_are_those_that_were_driven() -> None:
    """Five cars of 4 m at 12 m/s, 24 m apart; the fourth one passes while nothing is observed before it."""
    cars = [straight(k, (-30 - 24 * k, 0), (12, 0), 20) for k in range(5)]
    found = gate_crossings(cars, [GATE], NO_LANES, SETTINGS)
    every = headways(found, watched(20))
    assert [(one.leader.trajectory.number, one.follower.trajectory.number) for one in every] == [
        (k, k + 1) for k in range(4)
    ]
    assert [one.headway_s for one in every] == pytest.approx([2.0] * 4)
    assert [one.gap_s for one in every] == pytest.approx([2.0 - 4 / 12] * 4)
    assert [one.sigma_s for one in every] == pytest.approx([math.hypot(0.05, 0.15) / 12 * math.sqrt(2)] * 4, rel=1e-3)
    gap = Observation(times_s=np.concatenate([np.arange(0, 7.2, 0.1), np.arange(8.4, 20, 0.1)]))
    assert len(headways(found, gap)) == 3
    (one,) = occupancies(found, [WHOLE], watched(20))
    assert one.occupied_s == pytest.approx(5 * 4 / 12)
    assert one.observed_s == pytest.approx(20.1)


def test_lanes_have_their_own_headways() -> None:
    lanes = LaneMap([Lane(name=str(k), line=((-90.0, y), (90.0, y)), width=4.0) for k, y in enumerate((-2.0, 2.0))])
    cars = [straight(k, (-30 - 12 * k, 2 if k % 2 else -2), (12, 0), 20) for k in range(6)]
    found = headways(gate_crossings(cars, [GATE], lanes, SETTINGS), watched(20))
    assert [one.headway_s for one in found] == pytest.approx([2.0] * 4)
    assert {(one.leader.lane, one.follower.lane) for one in found} == {("0", "0"), ("1", "1")}


def waiting() -> list[Track]:
    """Four cars that stop 7 m apart behind x = 0 from t = 10 on, and a fifth 60 m behind them."""
    out = []
    for k, stop in enumerate((-2.0, -9.0, -16.0, -23.0, -90.0)):
        x = np.interp(np.arange(0, 40, 0.1), [0, 10, 30, 40], [stop - 80, stop, stop, stop + 90])
        out.append(along_x(k, x))
    return out


def test_a_queue_reaches_from_the_first_front_to_the_last_rear() -> None:
    lanes = LaneMap([Lane(name="in", line=((-200.0, 0.0), (0.0, 0.0)), width=3.5)])
    (queue,) = queues(waiting(), lanes, [WHOLE], watched(40), SETTINGS)
    assert (queue.longest_m, queue.vehicles) == (pytest.approx(21 + 4), 4)
    assert queue.sigma_m == pytest.approx(0.05 * math.sqrt(2))
    assert 10 <= queue.longest_at_s <= 30
    assert queue.mean_vehicles == pytest.approx(4 * 20 / 40, rel=0.1)
    chances = [round(event_probability(one), 2) for one in waiting()[:4]]
    assert queue.vehicles_expected == count_interval(chances, MISSED)
    assert 3 <= queue.vehicles_expected.low <= 4 <= queue.vehicles_expected.high <= 6
    assert queue.mean_between == pytest.approx((queue.mean_vehicles * 3 / 4, queue.mean_vehicles * 6 / 4))
    (far,) = queues(waiting(), lanes, [WHOLE], watched(40), TrafficSettings(queue_gap_m=100))
    assert far.vehicles == 5


def test_zones_are_entered_and_left_once() -> None:
    zone = Zone(name="box", polygon=((0, -5), (10, -5), (10, 5), (0, 5)))
    through = straight(1, (-20, 0), (8, 0), 5)
    inside = straight(2, (5, 0), (8, 0), 3)
    corner = drive(3, np.stack([np.linspace(-3, 3, 30), np.linspace(1.8, 7.8, 30)], axis=1))  # 0.15 m deep
    found = visits([through, inside, corner], [zone], SETTINGS)
    assert [one.trajectory.number for one in found] == [2, 1]
    assert found[1].dwell_s == pytest.approx(10 / 8)
    assert math.isnan(found[0].enter_s)
    assert found[0].leave_s == pytest.approx(5 / 8)


def test_hard_braking_is_that_of_the_speeds() -> None:
    t = np.arange(0, 6, 0.1)
    for rate, expected in ((6.0, 1), (4.4, 1), (3.5, 0)):
        speed = np.clip(15 - rate * np.clip(t - 2, 0, None), 0, None)
        x = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
        found = hard_brakings([along_x(1, x)], SETTINGS)
        assert len(found) == expected
        if found:
            assert found[0].deceleration == pytest.approx(rate, rel=0.05)
            assert found[0].sigma == pytest.approx(0.1 * math.sqrt(2))
