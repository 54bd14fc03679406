"""Counts by hand: what is refused, and what intervals learn from them, against draws of everything."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from skope.errors import UserError
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.traffic.count_uncertainty import CountDistribution, CountErrors, CountInterval
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import MissRateGroup
from skope.traffic.manual_count_checks import (
    CountEvidence,
    counts_adjusted_by_manual_counts,
    hand_lines,
    learnt_miss_rates,
    manual_count_checks,
)
from skope.traffic.manual_count_file import ManualCount, read_manual_counts
from skope.traffic.measure import measure
from skope.traffic.missed_crossings import MissedCrossings
from skope.traffic.observation import Observation
from skope.traffic.traffic_report import TrafficReport
from tests.traffic.drives import GATE, straight, watched
from tests.traffic.test_missed_crossings import SITE

VEHICLES = MissRateGroup(frozenset({"car", "van", "lorry", "bus", "unknown"}), missed=(0.26, 9.84), came=(0.04, 0.33))
TWO_WHEELERS = MissRateGroup(frozenset({"bicycle", "motorcycle"}), missed=(1.15, 2.61), came=(0.12, 9.0))
WALKERS = MissRateGroup(frozenset({"pedestrian"}), missed=(1.15, 2.61), came=(0.12, 9.0))
"""3% and 31% are missed in the mean."""
HEAD = "gate,direction,class,begin,end,count\n"
OTHER = Gate(name="h", line=((60.0, -5.0), (60.0, 5.0)), directions=("west", "east"))
LORD_HOWE = ZoneInfo("Australia/Lord_Howe")


# -------------------------------------------------------------------------------------------------- what is learnt


def errors_of(kind: MissRateGroup, chances: Sequence[float]) -> CountErrors:
    return CountErrors([1 - kind.real * p for p in chances], missed=kind.missed, came=kind.came)


def interval_of(kind: MissRateGroup, chances: Sequence[float]) -> CountInterval:
    return CountDistribution(len(chances), [errors_of(kind, chances)]).interval()


def drawn_gate(kind: MissRateGroup, per_minute: float, rng: np.random.Generator) -> list[tuple[int, list[float]]]:
    """Of ten minutes and of the hour after them, how many crossed and how probable the crossings are that were seen."""
    missed, out = rng.beta(*kind.missed), []
    for minutes in (10, 60):
        true = int(rng.poisson(per_minute * minutes))
        seen = rng.binomial(true, 1 - missed)
        chances = rng.uniform(0.93, 1.0, 4 * true + 100)
        happened = np.cumsum(rng.random(len(chances)) < chances)
        out.append((true, chances[: int(np.searchsorted(happened, seen))].tolist() if seen else []))
    return out


@pytest.mark.parametrize(("kind", "narrower"), [(VEHICLES, 0.9), (TWO_WHEELERS, 0.6)])
def test_ten_minutes_by_hand_make_the_next_hours_intervals_narrower_and_right(
    kind: MissRateGroup, narrower: float
) -> None:
    rng = np.random.default_rng(11)
    held, widths = 0, []
    for _ in range(200):
        (manual_count, seen), (true, later) = drawn_gate(kind, 4.0, rng)
        evidence = CountEvidence(side=("g", 0), errors={0: errors_of(kind, seen)}, number=manual_count)
        ((learnt,),) = learnt_miss_rates([evidence], {("g", 0): [kind]}).values()
        before, after = (interval_of(one, later) for one in (kind, learnt))
        held += after.low <= true <= after.high
        widths.append((before.high - before.low, after.high - after.low))
    assert held >= 0.88 * 200
    without, learning = np.mean(widths, axis=0)
    assert learning < narrower * without


def test_a_manual_count_says_most_of_its_own_gate_and_least_of_others() -> None:
    """At 40 certain crossings, 70 by hand: four of ten are missed there."""
    evidence = CountEvidence(side=("g", 0), errors={0: errors_of(TWO_WHEELERS, [1.0] * 40)}, number=70)
    sides = {"later": ("g", 0), "back": ("g", 1), "other gate": ("h", 0)}
    learnt = learnt_miss_rates([evidence], {side: [TWO_WHEELERS] for side in sides.values()})
    means = {name: learnt[side][0].mean_missed for name, side in sides.items()}
    prior = TWO_WHEELERS.mean_missed
    assert 30 / 70 > means["later"] > means["back"] > means["other gate"] > prior
    assert means["later"] == pytest.approx((1.15 + 0.9 * 30) / (1.15 + 2.61 + 0.9 * 70), abs=1e-6)


def test_kinds_that_were_counted_together_share_what_is_missing() -> None:
    """100 vehicles and 20 walkers were seen and 132 counted: nearly all who lack are of those who are missed often."""
    groups = {0: errors_of(VEHICLES, [1.0] * 100), 1: errors_of(WALKERS, [1.0] * 20)}
    kinds = [VEHICLES, WALKERS]
    evidence = CountEvidence(side=("g", 0), errors=groups, number=132)
    ((cars, walkers),) = learnt_miss_rates([evidence], {("g", 0): kinds}).values()
    assert cars.mean_missed < 0.06
    assert 0.2 < walkers.mean_missed < 0.4
    alone = CountEvidence(side=("g", 0), errors={0: groups[0]}, number=132)
    ((cars, untold),) = learnt_miss_rates([alone], {("g", 0): kinds}).values()
    assert cars.mean_missed > 0.1
    assert untold == WALKERS, "nobody counted them"


def test_a_gate_where_much_is_counted_wrongly_is_learnt_from_too() -> None:
    evidence = CountEvidence(side=("g", 0), errors={0: errors_of(WALKERS, [0.9] * 60)}, number=15)
    ((learnt,),) = learnt_miss_rates([evidence], {("g", 0): [WALKERS]}).values()
    before, after = (interval_of(one, [0.9] * 60) for one in (WALKERS, learnt))
    assert after.low < before.low / 1.5
    assert after.high < before.high


def test_many_manual_counts_are_worth_no_more_than_a_rate_that_drifts() -> None:
    one = CountEvidence(side=("g", 0), errors={0: errors_of(VEHICLES, [1.0] * 900)}, number=900)
    ((learnt,),) = learnt_miss_rates([one] * 20, {("g", 0): [VEHICLES]}).values()
    assert sum(learnt.missed) == pytest.approx(sum(VEHICLES.missed) + 150)


# --------------------------------------------------------------------------------------------- from counts to report


def manual_count(number: int, begin_s: float = 0.0, end_s: float = 60.0, **others: str) -> ManualCount:
    values = {"gate": "g", "class_name": "all", **others}
    interval = ClockInterval(begin_s=begin_s, end_s=end_s, begin=None, end=None)
    return ManualCount(direction=0, direction_name="west", interval=interval, number=number, **values)


def report_of(*hands: ManualCount) -> TrafficReport:
    site = replace(SITE, gates=(GATE, OTHER))
    cars = [straight(k, (-30, 0), (10, 0), 12.0, begin_s=6.0 * k) for k in range(100)]
    return measure(cars, watched(620.0), site, manual_counts=hands)


def between(report: TrafficReport, gate: str, direction: str) -> CountInterval:
    (one,) = (
        one for one in report.counts_total if (one.gate, one.direction, one.class_name) == (gate, direction, "all")
    )
    assert one.confidence_interval is not None
    return one.confidence_interval


def test_counts_stay_and_their_intervals_move() -> None:
    plain, right, few = report_of(), report_of(manual_count(100, 0.0, 606.0)), report_of(manual_count(115, 0.0, 606.0))
    assert [one.count for one in plain.counts] == [one.count for one in few.counts]
    told = [between(one, "g", "west") for one in (plain, right, few)]
    assert told[1].high < told[0].high
    assert told[2].high > told[0].high + 5, "a seventh more crossed than were seen"
    assert told[2].low <= 115 <= told[2].high
    (check,) = few.manual_count_checks
    assert (check.count, check.hand.number, check.contradicts) == (100, 115, False)
    # 594 and 683 vehicles an hour: GEH is of flows an hour, whatever the time that was counted.
    assert check.geh == pytest.approx(np.sqrt(2 * (594.06 - 683.17) ** 2 / (594.06 + 683.17)), abs=0.01)
    assert between(plain, "h", "west").low == between(few, "h", "west").low >= 95
    assert between(few, "h", "west").high > between(plain, "h", "west").high, "other gates of the site may miss as much"


def test_a_hand_count_that_cannot_be_is_said_to_contradict_and_believed_by_half() -> None:
    plain, wrong = report_of(), report_of(manual_count(0, 0.0, 606.0))
    (check,) = wrong.manual_count_checks
    assert check.contradicts
    (line,) = (line for line in wrong.notes if "contradict" in line)
    assert "gate 'g' (west), all from 0 s to 606 s: manual count 0, skope 100" in line
    told = between(wrong, "g", "west")
    assert told.low < 10
    assert told.high >= between(plain, "g", "west").low
    others = [between(one, "h", "west") for one in (plain, wrong)]
    assert abs(others[0].high - others[1].high) <= 8


def test_a_slip_of_the_counting_hand_is_no_contradiction() -> None:
    assert [
        one.contradicts for n in (85, 97, 103) for one in report_of(manual_count(n, 0.0, 606.0)).manual_count_checks
    ] == [*(True, False, False)]


def test_a_gate_whose_count_has_no_interval_has_none_beside_the_hand_count_and_learns() -> None:
    lost = [straight(k, (-45, 0), (10, 0), 4.0, begin_s=2.0 + k) for k in range(20)]
    through = [straight(20 + k, (-45, 0), (10, 0), 9.0, begin_s=30.0 + k) for k in range(5)]
    plain, told = (
        measure([*lost, *through], watched(60.0), SITE, manual_counts=hands)
        for hands in ((), [manual_count(24, 0.0, 60.0)])
    )
    assert all(one.confidence_interval is None for one in plain.counts_total if one.direction == "west")
    (check,) = told.manual_count_checks
    assert (check.near, check.count, check.confidence_interval) == (True, 5, None)
    learnt = between(told, "g", "west")
    assert learnt.low <= 24 <= learnt.high


def test_movements_learn_what_is_missed_at_their_gates() -> None:
    plain, few = report_of(), report_of(manual_count(130, 0.0, 606.0))
    moved = [
        next(
            one.confidence_interval
            for one in report.turning_total
            if (one.origin, one.destination, one.class_name) == (("g", "west"), ("h", "west"), "all")
        )
        for report in (plain, few)
    ]
    assert moved[0] is not None
    assert moved[1] is not None
    assert moved[1].low <= 130 <= moved[1].high
    assert moved[1].high > moved[0].high + 10, "a quarter of those who pass both are missed at the first one"


def test_nothing_is_learnt_where_nobody_was_ever_seen() -> None:
    unseen = MissedCrossings(gates=frozenset({"far"}))
    settings = TrafficSettings()
    checks = manual_count_checks([manual_count(3, gate="far")], [], unseen, settings)
    assert (checks[0].confidence_interval, checks[0].contradicts) == (None, False)
    assert counts_adjusted_by_manual_counts(checks, [], unseen, [GATE], settings).learnt == {}
    assert list(hand_lines(checks)) == [
        "gate 'far' (west), all from 0 s to 60 s: manual count 3, but no road user was ever detected near the gate: "
        "its counts stay unknown"
    ]


# -------------------------------------------------------------------------------------------------------- the file


def read(
    tmp_path: Path,
    rows: str,
    start: datetime | None = None,
    observation: Observation | None = None,
    classes: Sequence[str] = ("car", "bus", "unknown", "pedestrian"),
) -> tuple[ManualCount, ...]:
    (tmp_path / "c.csv").write_text(HEAD + rows)
    settings = TrafficSettings(classes=tuple(classes))
    return read_manual_counts(tmp_path / "c.csv", [GATE], settings, start, observation or watched(900.0))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("", "expected at least one count, found none"),
        ("x,west,,0,60,1", "line 2: gate: expected one of g, got 'x'"),
        ("g,north,,0,60,1", "line 2: direction: expected one of west, east, got 'north'"),
        ("g,west,tram,0,60,1", "line 2: class: expected one of , all, motor, car, bus, pedestrian, got 'tram'"),
        ("g,west,unknown,0,60,1", "line 2: class: expected one of"),
        ("g,west,,60,60,1", "line 2: end: expected a time after begin (60), got 60"),
        ("g,west,,60,0,1", "line 2: end: expected a time after begin (60), got 0"),
        ("g,west,,0,902,1", "line 2: end: '902' is not within the footage (0.0 to 900.1 s)"),
        ("g,west,,-2,60,1", "line 2: begin: '-2' is not within the footage"),
        ("g,west,,soon,60,1", "line 2: begin: expected seconds, a time like 10:15:00 or 2026-11-26T10:15:00"),
        ("g,west,,nan,60,1", "line 2: begin: expected seconds"),
        ("g,west,,10:00,60,1", "line 2: begin: expected seconds: the start of the footage is not known"),
        ("g,west,,0,60,-1", "line 2: count: expected a whole number from 0 to 100000, got '-1'"),
        ("g,west,,0,60,1.5", "line 2: count: expected a whole number from 0 to 100000, got '1.5'"),
        ("g,west,,0,60,1000000", "line 2: count: expected a whole number"),
        ("g,west,,0,60", "line 2: count: expected a whole number from 0 to 100000, got ''"),
        ("g,west,car,0,60,1\ng,west,car,0,60,1", "line 3: repeats line 2"),
        ("g,west,car,0,60,1\ng,west,,59,90,1", "line 3: has a gate, direction, class and time in common with"),
        ("g,west,car,0,60,1\ng,west,motor,30,40,1", "line 3: has a gate, direction, class and time in common"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_file_is_said_by_line_and_column(tmp_path: Path, rows: str, said: str) -> None:
    with pytest.raises(UserError) as error:
        read(tmp_path, rows)
    assert str(error.value).startswith(f"{tmp_path}/c.csv: {said}")
    assert "\n" not in str(error.value)


def test_columns_and_gaps(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text("gate,direction,begin,end,count\n")
    with pytest.raises(UserError, match="column class: missing; expected gate,direction,class,begin,end,count"):
        read_manual_counts(tmp_path / "c.csv", [GATE], TrafficSettings(), None, watched(9.0))
    gap = Observation(times_s=np.concatenate([np.arange(0, 60), np.arange(120, 200)]).astype(float))
    with pytest.raises(UserError, match="line 2: begin: the footage has a gap from begin to end"):
        read(tmp_path, "g,west,,50,130,1", observation=gap)
    rows = "g,west,car,0,60,1\ng,west,bus,0,60,1\ng,east,car,0,60,1\ng,west,car,60,90,1"
    assert [one.number for one in read(tmp_path, rows)] == [1, 1, 1, 1]
    whole = read(tmp_path, "g,west,,0,900.9,1")[0].interval
    assert (whole.begin_s, whole.end_s) == (0.0, pytest.approx(900.1))


def test_times_are_seconds_or_the_clocks(tmp_path: Path) -> None:
    start = datetime(2026, 11, 26, 23, 50, tzinfo=ZoneInfo("Europe/Berlin"))
    for begin, end in (
        ("300", "900"),
        ("23:55", "00:05"),
        ("23:55:00", "2026-11-27T00:05:00"),
        ("2026-11-26T23:55:00+01:00", "2026-11-26T23:05:00Z"),
    ):
        (one,) = read(tmp_path, f"g,east,,{begin},{end},7", start)
        assert (one.interval.begin_s, one.interval.end_s, one.direction) == (300.0, 900.0, 1)
        assert one.interval.end is not None
        assert one.interval.end.isoformat() == "2026-11-27T00:05:00+01:00"
    days = watched(2 * 86400.0, 0.5)
    with pytest.raises(UserError, match="begin: '23:55' occurs more than once in the footage: add the date"):
        read(tmp_path, "g,west,,23:55,23:58,1", start, days)
    with pytest.raises(
        UserError, match=r"end: '10:00' is not within the footage \(0.0 to 900.1 s, 2026-11-26T23:50:00"
    ):
        read(tmp_path, "g,west,,0,10:00,1", start)
    # Clocks go back half an hour at two in the morning.
    night = datetime(2026, 4, 5, 1, 0, tzinfo=LORD_HOWE)
    with pytest.raises(UserError, match="begin: '01:45' occurs more than once"):
        read(tmp_path, "g,west,,01:45,02:30,1", night, watched(7200.0, 0.5))
    (one,) = read(tmp_path, "g,west,,01:15,02:30,1", night, watched(7200.0, 0.5))
    assert (one.interval.begin_s, one.interval.end_s) == (900.0, 7200.0)


def test_all_is_everybody_who_counts_and_motor_those_with_an_engine(tmp_path: Path) -> None:
    tracks = [
        straight(k, (-10, 0), (5, 0), 4, begin_s=5.0 * k, class_name=name, category=category)
        for k, (name, category) in enumerate([("car", "vehicle"), ("unknown", "vehicle"), ("pedestrian", "pedestrian")])
    ]
    site = replace(SITE, traffic=TrafficSettings())
    rows = "".join(f"g,west,{name},0,20,0\n" for name in ("", "motor", "car", "pedestrian"))
    hands = [read(tmp_path, row, classes=site.traffic.classes)[0] for row in rows.splitlines()]
    assert hands[0].class_name == "all"
    report = measure(tracks, watched(60.0), site)
    checks = manual_count_checks(hands, report.crossings, MissedCrossings(), site.traffic)
    assert [one.count for one in checks] == [3, 2, 1, 1]
