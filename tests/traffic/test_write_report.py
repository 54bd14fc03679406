"""The CSV files of a report in a spreadsheet: names from a site file are text there, and are read back as they are."""

import codecs
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope.files.csv_files import read_csv
from skope.site.site_file import parse_site
from skope.traffic.manual_count_file import read_manual_counts
from skope.traffic.measure import measure
from skope.traffic.report_tables import report_tables
from skope.traffic.time_to_collision import HardBraking
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.write_report import write_traffic_report
from tests.traffic.drives import straight, watched

GATES = ('=HYPERLINK("http://x.invalid","Nord")', "-Süd, Straße 1")
DIRECTIONS = ("@in", "+out")
LANE, ZONE = "=lane", "'-zone"
SITE = f"""
start = 2026-11-26T10:00:00
time_zone = "Europe/Berlin"
[[gates]]
name = '{GATES[0]}'
line = [[0, -5], [0, 5]]
directions = {list(DIRECTIONS)}
[[gates]]
name = "{GATES[1]}"
line = [[10, -5], [10, 5]]
directions = {list(DIRECTIONS)}
[[lanes]]
name = "{LANE}"
line = [[-50, 0], [50, 0]]
width = 3.5
[[zones]]
name = "{ZONE}"
polygon = [[-2, -2], [-2, 2], [2, 2], [2, -2]]
"""


@pytest.fixture(scope="module")
def report() -> TrafficReport:
    """Cars in one lane through both gates, and one that drives across."""
    tracks = [straight(k, (-30, 0), (10, 0), 6, begin_s=2.0 * k) for k in range(1, 4)]
    crossing = straight(9, (0, -25), (0, 8), 6, begin_s=4.0)
    return measure([*tracks, crossing], watched(20.0), parse_site(Path("site.toml"), SITE.encode()))


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def test_no_cell_of_a_report_begins_like_a_formula(report: TrafficReport, tmp_path: Path) -> None:
    tables = [
        path for path in write_traffic_report(tmp_path, report, tracks="t", revision=None) if path.suffix == ".csv"
    ]
    assert len(tables) >= 12
    for path in tables:
        data = path.read_bytes()
        assert data.startswith(codecs.BOM_UTF8), f"{path.name}: Excel knows by it that the file is UTF-8"
        for row in csv.reader(data.decode("utf-8-sig").splitlines()):
            assert not [cell for cell in row if cell[:1] in tuple("=+-@") and not is_number(cell)], path.name


def test_names_of_a_report_are_read_back(report: TrafficReport, tmp_path: Path) -> None:
    write_traffic_report(tmp_path, report, tracks="t", revision=None)
    for name, table in report_tables(report).items():
        columns, rows = read_csv(tmp_path / f"{name}.csv")
        assert columns == list(table.columns)
        for row, cells in zip(rows, table.rows, strict=True):
            for column, cell in zip(columns, cells, strict=True):
                if isinstance(cell, str):
                    assert row[column] == cell, name
    _, counts = read_csv(tmp_path / "counts.csv")
    assert {(row["gate"], row["direction"]) for row in counts} == {(g, d) for g in GATES for d in DIRECTIONS}
    _, events = read_csv(tmp_path / "events.csv")
    assert ZONE in {row["place"] for row in events}
    assert LANE in {row["lane"] for row in events}
    assert min(float(row["y"]) for row in events) < 0, "negative numbers are numbers"


def test_hard_braking_has_columns_of_its_own(report: TrafficReport, tmp_path: Path) -> None:
    track = report.crossings[0].trajectory
    cells = {"deceleration": 5.2, "sigma": 0.3, "probability": 0.99}
    brake = HardBraking(trajectory=track, time_s=2.5, position=np.array([3.0, -1.0]), **cells)
    write_traffic_report(tmp_path, replace(report, brakings=(brake,)), tracks="t", revision=None)
    _, events = read_csv(tmp_path / "events.csv")
    (row,) = (event for event in events if event["event"] == "hard braking")
    assert (row["x"], row["y"], row["track"], row["remark"]) == ("3.000", "-1.000", str(track.number), "")
    assert (float(row["deceleration_ms2"]), float(row["deceleration_sigma_ms2"])) == pytest.approx((5.2, 0.3))
    assert not any(event["deceleration_ms2"] for event in events if event is not row)


@pytest.mark.parametrize("gate", [GATES[1], f"'{GATES[1]}"])
def test_a_manual_count_names_gates_with_an_apostrophe_or_without(
    report: TrafficReport, tmp_path: Path, gate: str
) -> None:
    """The name is copied from counts.csv, or from the site file."""
    path = tmp_path / "mine.csv"
    path.write_text(f'gate,direction,class,begin,end,count\n"{gate}",\'@in,motor,0,20,3\n', encoding="utf-8")
    (count,) = read_manual_counts(path, report.gates, report.site.traffic, report.start, report.observation)
    assert (count.gate, count.direction_name, count.number) == (GATES[1], "@in", 3)
