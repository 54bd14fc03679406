"""Intervals of counts: against all outcomes, against draws, and never without the count."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import betabinom, betanbinom

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.traffic.count_uncertainty import (
    CountDistribution,
    CountErrors,
    CountInterval,
    count_interval,
    hull,
    missed_pmf,
    poisson_binomial,
)
from skope.traffic.measure import measure
from tests.traffic.drives import drive, watched
from tests.traffic.test_missed_crossings import SITE


def test_poisson_binomial_equals_counting_all_outcomes() -> None:
    chances = [0.1, 0.5, 0.9, 0.99, 0.3, 0.0, 1.0]
    expected = np.zeros(len(chances) + 1)
    for outcome in itertools.product((0, 1), repeat=len(chances)):
        expected[sum(outcome)] += np.prod([p if one else 1 - p for p, one in zip(chances, outcome, strict=True)])
    assert poisson_binomial(chances) == pytest.approx(expected)
    assert poisson_binomial([]) == pytest.approx([1.0])


@pytest.mark.parametrize(
    ("counted", "missed"), [(0, (0.3, 8.0)), (24, (0.3, 8.0)), (300, (2.0, 40.0)), (5, (0.05, 1.5))]
)
def test_what_nothing_saw_is_beta_negative_binomial(counted: int, missed: tuple[float, float]) -> None:
    pmf = missed_pmf(counted, missed)
    expected = betanbinom.pmf(np.arange(len(pmf) - 1), counted + 1, missed[1], missed[0])
    assert pmf[:-1] == pytest.approx(expected, abs=1e-9)
    assert pmf.sum() == pytest.approx(1.0, abs=2e-4)
    assert missed_pmf(counted, (0.0, 1.0)).tolist() == [1.0], "nothing is ever missed"


def test_bounds_are_the_quantiles_of_what_is_false_and_of_what_is_lacking() -> None:
    errors = CountErrors([0.3] * 10, [0.4, 0.2], possible=3, came=(0.5, 0.5))
    interval = CountDistribution(10, [errors]).interval()
    false = poisson_binomial([0.3] * 10).cumsum()
    lost = betabinom.pmf(np.arange(4), 3, 0.5, 0.5)
    added = np.convolve(poisson_binomial([0.4, 0.2]), lost).cumsum()
    assert interval.low == 10 - int((false < 0.95).sum())
    assert interval.high == 10 + int((added < 0.95).sum())


def test_groups_add_up_and_a_hull_holds_both() -> None:
    one, other = CountErrors([0.2] * 8), CountErrors([0.5] * 4, [0.5] * 3)
    both = CountDistribution(12, [one, other])
    first, pmf = both.number_pmf()
    assert pmf.sum() == pytest.approx(1.0)
    mean = float((first + np.arange(len(pmf))) @ pmf)
    assert mean == pytest.approx(12 - 0.2 * 8 - 0.5 * 4 + 0.5 * 3)
    assert hull([CountInterval(3, 7), CountInterval(1, 4)]) == CountInterval(1, 7)


def test_the_cameras_error_shifts_a_surveyed_gates_count_once() -> None:
    """Of twenty cameras one would have counted two more, and four three fewer."""
    shifts = [2, *([-3] * 4), *([0] * 15)]
    assert CountDistribution(9, [CountErrors()], shifts).interval() == CountInterval(6, 9)
    assert CountDistribution(9, [CountErrors()], [4, *shifts]).interval() == CountInterval(6, 11)
    assert CountDistribution(2, [CountErrors()], [-2, -2]).interval() == CountInterval(0, 2)


@pytest.mark.parametrize("missed", [(0.3, 8.0), (1.2, 3.0)])
def test_intervals_hold_the_truth_at_least_as_often_as_they_say(missed: tuple[float, float]) -> None:
    """The truth is drawn, then what is seen of it, and what is counted in error."""
    rng = np.random.default_rng(0)
    held, sides = 0, [0, 0]
    for _ in range(1500):
        true = int(rng.integers(0, 80))
        seen = rng.binomial(true, 1 - rng.beta(*missed))
        chances = rng.uniform(0.85, 1.0, 200)
        happened = np.cumsum(rng.random(200) < chances)
        number = int(np.searchsorted(happened, seen)) if seen else 0
        found = count_interval(chances[:number].tolist(), missed)
        held += found.low <= true <= found.high
        sides[0] += true < found.low
        sides[1] += true > found.high
    assert held / 1500 >= 0.90
    assert max(sides) / 1500 < 0.075, "each end errs in about one of twenty"


@pytest.mark.parametrize("seed", range(25))
def test_no_count_lies_outside_its_interval(seed: int) -> None:
    """Whatever the tracks are: vague, broken, flagged, too short, of any class, with gates that cross each other."""
    rng = np.random.default_rng(seed)
    gates = tuple(
        Gate(name=f"g{k}", line=tuple(map(tuple, rng.uniform(-25, 25, (2, 2)).tolist()))) for k in range(4)
    )  # fmt: skip
    names = ["car", "van", "lorry", "bus", "unknown", "bicycle", "motorcycle", "pedestrian"]
    tracks = []
    for number in range(40):
        count = int(rng.integers(3, 60))
        name = str(rng.choice(names))
        walk = np.cumsum(rng.normal(rng.normal(0, 1, 2), 0.8, (count, 2)), axis=0) + rng.uniform(-20, 20, 2)
        times = rng.uniform(0, 50) + np.cumsum(rng.choice([0.1, 0.5, 2.0], count, p=[0.8, 0.15, 0.05]))
        category = name if name in ("bicycle", "motorcycle", "pedestrian") else "vehicle"
        track = drive(
            number, walk, times, sigma=float(rng.choice([0.05, 0.5, 3.0])), class_name=name, category=category
        )
        located: NDArray[np.bool_] = rng.random(count) < rng.uniform(0.1, 1)
        located[0] = True
        flags = tuple(rng.choice(["two_poses", "impossible_motion"], int(rng.integers(0, 2))).tolist())
        error = np.tile(rng.normal(0, 0.5, 2), (count, 1))
        tracks.append(
            replace(track, located=located, flags=flags, body_error=error, class_confidence=float(rng.uniform(0.3, 1)))
        )
    report = measure(tracks, watched(150.0), replace(SITE, gates=gates, traffic=TrafficSettings(interval_minutes=1)))
    rows = [*report.counts, *report.counts_total, *report.turning, *report.turning_total, *report.lengths]
    known = [one for one in rows if one.confidence_interval is not None and one.count is not None]
    assert len(known) > 100
    assert sum(one.count for one in known) > 10
    for one in known:
        assert one.confidence_interval is not None
        assert one.confidence_interval.low <= one.count <= one.confidence_interval.high, one
    assert not math.isnan(sum(one.confidence_interval.high for one in known if one.confidence_interval))
