"""Vehicles by length: how sure each is in its bin, how many there were, and what is said where that is not known."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from skope.errors import UserError
from skope.site.site_file import parse_site
from skope.site.traffic_settings import TRAFFIC_CLASSES, TrafficSettings
from skope.tracks.track import Track
from skope.traffic.length_bins import WHY_NOT, LengthCount, bin_probabilities, length_bin, length_sigma_m
from skope.traffic.measure import measure
from skope.traffic.otc_classes import OTC_CLASSES
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.write_report import write_traffic_report
from tests.traffic.drives import straight, watched
from tests.traffic.test_missed_crossings import SITE

LIMITS = TrafficSettings().length_bins_m


def of_length(length: float, class_name: str = "lorry", number: int = 1, begin_s: float = 0.0) -> Track:
    return straight(number, (-30, 0), (10, 0), 6.0, begin_s=begin_s, class_name=class_name, length=length)


def report_of(lengths: list[tuple[float, str]], limits: tuple[float, float] = LIMITS) -> TrafficReport:
    """Vehicles that cross the gate one after the other, and somebody on foot."""
    tracks = [of_length(m, name, k + 1, 5.0 * k) for k, (m, name) in enumerate(lengths)]
    walker = {"category": "pedestrian", "class_name": "pedestrian", "length": None, "width": None}
    tracks.append(straight(999, (-4, 1), (1.2, 0), 7.0, **walker))
    site = replace(SITE, traffic=replace(SITE.traffic, length_bins_m=limits))
    return measure(tracks, watched(5.0 * len(lengths) + 10), site)


def total(report: TrafficReport, name: str) -> LengthCount:
    (found,) = (one for one in report.lengths_total if (one.direction, one.bin_name) == ("west", name))
    return found


@pytest.mark.parametrize("length", [3.0, 6.4, 6.55, 7.0, 12.0, 14.5, 18.0])
def test_probabilities_are_those_of_the_errors(length: float) -> None:
    """Half of the lengths are right to 3%, nearly half to 9%, and four in a hundred may be any from 3 to 13 m."""
    z = np.array(LIMITS) / length - 1
    short, not_long = 0.5 * norm.cdf(z / 0.03) + 0.46 * norm.cdf(z / 0.09) + 0.04 * np.array([0.355, 1.0])
    told = bin_probabilities(of_length(length), LIMITS, 0.0)
    assert told == pytest.approx([short, not_long - short, 1 - not_long], abs=1e-9)
    assert told.sum() == pytest.approx(1)


def test_how_far_a_length_may_be_off_agrees_with_draws() -> None:
    rng = np.random.default_rng(0)
    for common in (None, 0.1):
        true = np.concatenate(
            [
                9 * (1 + rng.normal(0, np.hypot(0.03, common or 0), 50_000)),
                9 * (1 + rng.normal(0, np.hypot(0.09, common or 0), 46_000)),
                rng.uniform(3, 13, 4_000),
            ]
        )
        sigma = length_sigma_m(of_length(9.0), common)
        assert sigma == pytest.approx(math.sqrt(np.mean((true - 9) ** 2)), rel=0.03)
        chances = bin_probabilities(of_length(9.0), LIMITS, common)
        assert chances == pytest.approx(np.diff([0, np.mean(true < LIMITS[0]), np.mean(true < LIMITS[1]), 1]), abs=0.01)


def test_a_car_is_no_lorry_however_its_length_is_off() -> None:
    assert length_bin(of_length(6.1, "car"), LIMITS, None)[0] == "short"
    assert length_bin(of_length(6.4, "lorry"), LIMITS, None)[0] == "unknown"
    assert length_bin(of_length(9.0, "car"), LIMITS, None)[0] == "short", "a wrong length, or a wrong class"
    for length in (4.0, 6.19, 6.21, 9.0):
        told = bin_probabilities(of_length(length, "car"), LIMITS, 0.02)
        assert (told >= 0).all()
        assert told.sum() == pytest.approx(1)


def test_counts_by_length_and_who_is_in_none() -> None:
    lengths = [*[(4.4, "car")] * 30, *[(9.0, "lorry")] * 6, (6.5, "lorry"), (18.0, "lorry")]
    report = report_of(lengths)
    counted = {name: total(report, name) for name in ("short", "medium", "long", "unknown")}
    assert [one.count for one in counted.values()] == [30, 6, 1, 1]
    short, medium, long, unknown = (one.confidence_interval for one in counted.values())
    assert short
    assert short.low <= 30 <= short.high
    assert medium
    assert medium.low <= 6
    assert medium.high >= 7, "the one that is in none may be of them"
    assert (long, unknown) == (None, None)
    # Who is counted at the gate is in one of them, and nobody on foot is.
    vehicles = sum(one.count or 0 for one in report.counts_total if one.class_name == "vehicle")
    assert vehicles == sum(one.count or 0 for one in report.lengths_total) == len(lengths)


def test_intervals_hold_the_truth_of_draws() -> None:
    """True lengths drawn from what is told of them: of medium vehicles there are as many as is said, in 90%."""
    rng = np.random.default_rng(4)
    told = [(m, "lorry") for m in rng.uniform(5.5, 8.0, 40)]
    report = report_of(told)
    medium = total(report, "medium").confidence_interval
    assert medium
    chances = [bin_probabilities(of_length(m), LIMITS, 0.0)[1] for m, _ in told]
    drawn = (rng.random((4000, 40)) < chances).sum(axis=1) + rng.binomial(2, 0.3, 4000)
    assert np.mean((medium.low <= drawn) & (drawn <= medium.high)) > 0.9


def test_the_files_say_it(tmp_path: Path) -> None:
    report = report_of([(4.4, "car"), (9.0, "bus"), (16.0, "lorry")])
    write_traffic_report(tmp_path, report, tracks="t", revision=None)
    with (tmp_path / "lengths.csv").open(encoding="utf-8-sig", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["direction"] == "west"]
    assert [(row["length_bin"], row["from_m"], row["to_m"], row["count"]) for row in rows] == [
        ("short", "0.000", "6.550", "1"),
        ("medium", "6.550", "14.940", "1"),
        ("long", "14.940", "", "1"),
        ("unknown", "", "", "0"),
    ]
    assert [row["remark"] for row in rows] == ["", "", WHY_NOT, ""]
    assert [bool(row["count_low_90"]) for row in rows] == [True, True, False, False]
    with (tmp_path / "events.csv").open(encoding="utf-8-sig", newline="") as file:
        events = {row["track"]: row for row in csv.DictReader(file) if row["event"] == "gate"}
    assert [events[k]["otc_class"] for k in ("1", "2", "3", "999")] == ["car", "bus", "truck", "pedestrian"]
    assert [events[k]["length_bin"] for k in ("1", "2", "3", "999")] == ["short", "medium", "long", ""]
    assert float(events["1"]["length_bin_probability"]) > 0.99
    assert (events["1"]["length_m"], events["999"]["length_m"]) == ("4.400", "")
    with (tmp_path / "counts.csv").open(encoding="utf-8-sig", newline="") as file:
        names = {row["class"]: row["otc_class"] for row in csv.DictReader(file)}
    assert names == {**OTC_CLASSES, "all": "", "vehicle": ""}
    assert set(OTC_CLASSES) == set(TRAFFIC_CLASSES)


def test_nothing_observed_is_no_count_and_no_vehicles_no_rows() -> None:
    empty = measure([], watched(0), SITE)
    assert all(one.count is None and one.confidence_interval is None for one in empty.lengths_total)
    on_foot = replace(SITE, traffic=replace(SITE.traffic, classes=("pedestrian",)))
    assert measure([], watched(10), on_foot).lengths == ()


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ("[14, 6]", "expected two lengths that rise, from 5 to 30 m, got 14 and 6"),
        ("[4.0, 6]", "expected two lengths that rise, from 5 to 30 m, got 4 and 6"),
        ("[6, 6]", "expected two lengths that rise"),
        ("[6, 40]", "expected two lengths that rise"),
        ("[6]", "expected 2 numbers"),
        ('["6", 9]', "expected a number"),
    ],
)
def test_limits_that_are_wrong_get_one_line(limits: str, said: str) -> None:
    with pytest.raises(UserError) as error:
        parse_site(Path("site.toml"), f"[traffic]\nlength_bins_m = {limits}\n".encode())
    assert str(error.value).startswith("site.toml: traffic.length_bins_m: ")
    assert said in str(error.value)
    site = parse_site(Path("site.toml"), b"[traffic]\nlength_bins_m = [5.2, 11.6]\n")
    assert site.traffic.length_bins_m == (5.2, 11.6)
