"""Peak hours and their factors, and passenger-car equivalents, of made-up crossings whose numbers are worked out."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope.errors import UserError
from skope.site.site_file import parse_site
from skope.site.traffic_settings import PCE_FACTORS, TrafficSettings
from skope.tracks.track import Track
from skope.traffic.measure import measure
from skope.traffic.observation import Observation
from skope.traffic.page.page import traffic_page
from skope.traffic.peak_hour import peak_hours, peak_hours_in_json, why_no_factor, why_no_peak_hour
from skope.traffic.report_tables import report_tables
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.write_report import write_traffic_report
from tests.traffic.drives import straight, watched

ONE_GATE = '[[gates]]\nname = "g"\nline = [[0, -5], [0, 5]]\ndirections = ["out", "in"]\n'
TWO_GATES = ONE_GATE + '[[gates]]\nname = "h"\nline = [[20, -5], [20, 5]]\n'
QUARTER_S = 900.0


def cars(numbers: Sequence[int], *, end_m: float = 10.0, **others: str) -> list[Track]:
    """As many cars in each quarter of an hour, which cross x = 0 one second after they begin at x = -10."""
    seconds = (end_m + 10.0) / 10.0
    tracks: list[Track] = []
    for quarter, number in enumerate(numbers):
        for k in range(number):
            begin_s = quarter * QUARTER_S + 10.0 + 20.0 * k
            tracks.append(straight(len(tracks) + 1, (-10, 0), (10, 0), seconds, begin_s=begin_s, **others))
    return tracks


def counted(
    tracks: Sequence[Track],
    hours: float,
    settings: str = "",
    gates: str = ONE_GATE,
    observation: Observation | None = None,
) -> TrafficReport:
    site = parse_site(Path("site.toml"), f"{gates}[traffic]\n{settings}\n".encode())
    return measure(tracks, observation or watched(3600 * hours, fps=1.0), site, broken=False)


def test_the_factor_is_the_volume_over_four_highest_quarters() -> None:
    """6 + 10 + 8 + 8 = 32 in the second to fifth quarter, 28 in the first four: 32 / (4 x 10) = 0.8."""
    report = counted(cars([4, 6, 10, 8, 8, 1]), 1.5)
    site, out, back = peak_hours(report)
    assert (out.gate, out.direction, out.class_name) == ("g", "out", "vehicle")
    assert (out.begin_s, out.end_s) == (900.0, 4500.0)
    assert (out.volume, out.highest_15_minutes, out.factor) == (32, 10, 0.8)
    assert (site.gate, site.volume, site.factor) == ("", 32, 0.8)
    assert (back.direction, back.volume, back.factor) == ("in", 0, None)
    assert peak_hours_in_json(report)["hours"][1]["factor"] == 0.8


def test_who_crosses_two_gates_counts_once_at_the_site() -> None:
    site, *gates = peak_hours(counted(cars([3, 3, 3, 3], end_m=30.0), 1.0, gates=TWO_GATES))
    assert site.volume == 12
    assert [one.volume for one in gates] == [12, 0, 12, 0]
    assert site.factor == 1.0


def test_the_highest_quarter_of_shorter_intervals_begins_with_any_of_them() -> None:
    """Cars at 20 s steps from minute 10 on: with 5-minute intervals 9 in minutes 10 to 25, in no quarter alone."""
    late = [straight(k, (-10, 0), (10, 0), 2, begin_s=600.0 + 90.0 * k) for k in range(1, 10)]
    _, out, _ = peak_hours(counted(late, 1.0, "interval_minutes = 5"))
    assert (out.volume, out.highest_15_minutes, out.factor) == (9, 9, 0.25)


def test_why_there_is_none() -> None:
    tracks = cars([4, 4, 4, 4])
    assert "15-minute intervals; the longest run is 45 minutes" in why_no_peak_hour(counted(tracks, 0.99))
    assert "45-minute intervals do not divide an hour" in why_no_peak_hour(
        counted(tracks, 1.0, "interval_minutes = 45")
    )
    report = counted(tracks, 1.0, "interval_minutes = 30")
    assert why_no_peak_hour(report) == ""
    assert "30-minute intervals do not divide 15 minutes" in why_no_factor(report)
    assert [one.factor for one in peak_hours(report)] == [None] * 3
    assert "not_available" in peak_hours_in_json(counted(tracks, 0.5))
    assert "Not available: it needs 60 consecutive minutes" in traffic_page(counted(tracks, 0.5), tracks="t")


def test_an_interval_with_a_gap_is_in_no_peak_hour() -> None:
    """The third quarter has a gap of a minute: no hour of an hour and a half lies beside it."""
    times = np.arange(0, 5401.0)
    seen = Observation(times_s=times[(times < 2000) | (times > 2060)], common_scale_sigma=0.0)
    report = counted(cars([4, 4, 4, 4, 4, 4]), 1.5, observation=seen)
    assert "15-minute intervals; the longest run is 45 minutes" in why_no_peak_hour(report)


def test_passenger_cars_of_a_gate(tmp_path: Path) -> None:
    """Two cars, one lorry (2.3) and one bicycle (0.2): 4.5; with lorry = 3 in the site file 5.2."""
    bicycle = {"category": "bicycle", "class_name": "bicycle"}
    tracks = [
        *cars([2]),
        straight(3, (-10, 0), (10, 0), 2, begin_s=100.0, class_name="lorry"),
        straight(4, (-10, 0), (5, 0), 4, begin_s=200.0, **bicycle),
        straight(5, (-10, 2), (1.2, 0), 17, begin_s=300.0, category="pedestrian", class_name="pedestrian"),
    ]
    report = counted(tracks, 0.5)
    assert {(one.direction, one.class_name): one.pce for one in report.counts_total} == {
        ("out", "all"): 4.5,
        ("out", "vehicle"): None,
        ("in", "all"): 0.0,
        ("in", "vehicle"): None,
    }
    assert counted(tracks, 0.5, "pce = { lorry = 3.0 }").counts_total[0].pce == 5.2
    table = report_tables(report)["counts"]
    assert table.columns[-1] == "pce"
    assert next(row[-1] for row in table.rows) == 4.5
    write_traffic_report(tmp_path, report, tracks="t", revision=None)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["counts"][0]["pce"] == 4.5
    assert summary["settings"]["pce"] == PCE_FACTORS


def test_a_vehicle_of_unknown_class_counts_as_the_mean_of_the_others() -> None:
    """A car, a lorry (2.3) and an unknown one (1.65 in the mean): 4.95."""
    tracks = [*cars([1]), straight(2, (-10, 0), (10, 0), 2, begin_s=100.0, class_name="lorry")]
    unknown = [straight(3 + k, (-10, 0), (10, 0), 2, begin_s=200.0 + 50 * k, class_name="unknown") for k in range(3)]
    assert counted([*tracks, unknown[0]], 0.5).counts_total[0].pce == 4.95
    few = counted([*tracks, *unknown], 0.5)
    assert few.counts_total[0].pce is None
    assert "fewer than half of the vehicles" in traffic_page(few, tracks="t")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pce = { truck = 2.0 }", "site.toml: traffic.pce.truck: unknown; known are bicycle, bus, lorry, motorcycle"),
        ("pce = { bus = -1 }", "site.toml: traffic.pce.bus: expected a number from 0 to 10, got -1"),
        ("pce = 2.0", "site.toml: traffic.pce: expected a table"),
    ],
)
def test_a_wrong_factor_gets_one_line(text: str, message: str) -> None:
    with pytest.raises(UserError, match=r"^[^\n]*$") as raised:
        parse_site(Path("site.toml"), f"[traffic]\n{text}\n".encode())
    assert message in str(raised.value)


def test_factors_that_are_not_named_keep_their_defaults() -> None:
    site = parse_site(Path("site.toml"), b"[traffic]\npce = { bus = 2.5 }\n")
    assert site.traffic == replace(TrafficSettings(), pce={**PCE_FACTORS, "bus": 2.5})
