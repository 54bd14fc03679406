"""Seconds in which the camera saw little, in the intervals of a report."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope.errors import UserError
from skope.traffic.measure import measure
from skope.traffic.observation import Observation, checked_visibility, frame_durations_s, read_observation
from skope.traffic.report_remarks import interval_visibility, visibility_lines
from skope.traffic.write_report import write_traffic_report
from tests.traffic.drives import straight, watched
from tests.traffic.test_missed_crossings import SITE

LOOKS = np.array([[0.5 * k, 0.05 if 10 <= k < 20 else 0.4, 0.005 if 30 <= k < 36 else 0.2] for k in range(120)])
"""A minute of small pictures: dark from 5 to 10 s, without contrast from 15 to 18 s."""


def test_seconds_that_are_dark_flat_or_after_a_move_are_counted_once() -> None:
    seen = replace(watched(39.9), camera_moved_s=np.arange(400, 600) / 10, visibility_samples=LOOKS)
    whole = interval_visibility(seen, 0.0, 60.0)
    assert (whole.low_brightness_s, whole.low_contrast_s, whole.camera_moved_s, whole.poor_s) == pytest.approx(
        (5.0, 3.0, 20.0, 28.0)
    )
    part = interval_visibility(seen, 7.25, 16.0)
    assert (part.low_brightness_s, part.low_contrast_s, part.camera_moved_s, part.poor_s) == pytest.approx(
        (2.75, 1.0, 0.0, 3.75)
    )
    assert part.brightness == pytest.approx((2.75 * 0.05 + 6.0 * 0.4) / 8.75)
    both = LOOKS.copy()
    both[100:, 1] = 0.0  # dark too after the move
    assert interval_visibility(replace(seen, visibility_samples=both), 0.0, 60.0).poor_s == pytest.approx(28.0)
    (line,) = visibility_lines(seen)
    assert "5 s dark, 3 s without contrast, 20 s with the camera moved to another view" in line
    # A calibration of the later part: dark from 5 to 10 s is of the other view.
    turned = Observation(times_s=np.arange(80, 600) / 10, camera_moved_s=np.arange(80) / 10, visibility_samples=LOOKS)
    found = interval_visibility(turned, 0.0, 60.0)
    assert (found.camera_moved_s, found.low_brightness_s, found.poor_s) == pytest.approx((8.0, 5.0, 8.0 + 2.0 + 3.0))
    assert not list(visibility_lines(watched(60.0)))


def test_what_was_not_measured_is_not_said_to_be_good() -> None:
    nothing = interval_visibility(watched(60.0), 0.0, 60.0)
    assert (nothing.low_brightness_s, nothing.low_contrast_s, nothing.poor_s, nothing.brightness) == (
        None,
        None,
        None,
        None,
    )
    late = interval_visibility(replace(watched(60.0), visibility_samples=LOOKS), 100.0, 160.0)
    assert (late.low_brightness_s, late.poor_s) == (None, None)
    assert interval_visibility(Observation(times_s=np.zeros(0)), 0.0, 60.0).camera_moved_s == 0


@pytest.mark.parametrize("pause_s", [0.04, 0.6, 0.99, 1.2, 5.0])
def test_durations_of_frames_and_observed_periods_agree(pause_s: float) -> None:
    """At 25 frames per second a pause of 0.6 s is no gap, for the observed time and for the sum of durations."""
    times = np.concatenate([np.arange(50) / 25, 49 / 25 + pause_s + np.arange(50) / 25])
    observed_s = Observation(times_s=times).seconds_in(0.0, 60.0)
    assert frame_durations_s(times, 0.0, 60.0).sum() == pytest.approx(observed_s)
    assert observed_s == pytest.approx(99 / 25 + (pause_s if pause_s < 1 else 1 / 25))


def test_a_frame_stands_until_the_next_one_but_for_gaps() -> None:
    times = np.array([0.0, 1.0, 2.0, 50.0, 51.0])
    assert frame_durations_s(times, 0.0, 60.0).tolist() == [1.0, 1.0, 1.0, 1.0, 1.0]
    assert frame_durations_s(times, 0.5, 2.5).tolist() == [0.5, 1.0, 0.5, 0.0, 0.0]
    assert frame_durations_s(np.array([3.0]), 0.0, 9.0).tolist() == [0.0]
    assert frame_durations_s(np.zeros(0), 0.0, 9.0).tolist() == []


def test_the_report_marks_its_intervals(tmp_path: Path) -> None:
    site = replace(SITE, traffic=replace(SITE.traffic, interval_minutes=1))
    seen = replace(watched(119.9), visibility_samples=np.concatenate([LOOKS + [60, 0, 0], LOOKS + [120, 0, 0]]))
    report = measure([straight(1, (-30, 0), (10, 0), 6.0, begin_s=10.0)], seen, site)
    write_traffic_report(tmp_path, report, tracks="t", revision=None)
    tables = {}
    for name in ("visibility", "counts"):
        with (tmp_path / f"{name}.csv").open(encoding="utf-8-sig", newline="") as file:
            tables[name] = list(csv.DictReader(file))
    assert [(row["begin_s"], row["low_brightness_s"], row["low_contrast_s"]) for row in tables["visibility"]] == [
        ("0.000", "", ""), ("60.000", "5.000", "3.000")
    ]  # fmt: skip
    assert {(row["begin_s"], row["low_visibility_s"]) for row in tables["counts"]} == {
        ("0.000", ""),
        ("60.000", "8.000"),
    }
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert any(line.startswith("poor visibility: 10 s dark") for line in summary["notes"])


def test_what_is_written_is_read_again_and_what_is_wrong_is_said(tmp_path: Path) -> None:
    seen = replace(watched(1.0), camera_moved_s=np.array([1.1, 1.2]), visibility_samples=LOOKS[:3])
    document = seen.to_dict()
    (tmp_path / "footage.json").write_text(json.dumps(document))
    read = read_observation(tmp_path)
    assert (read.camera_moved_s.tolist(), read.visibility_samples.tolist()) == ([1.1, 1.2], LOOKS[:3].tolist())
    for name, said in (
        ("visibility_samples", "expected rows of time"),
        ("moved_times_s", "expected a list of numbers"),
    ):
        without = {key: value for key, value in document.items() if key != name}
        (tmp_path / "footage.json").write_text(json.dumps(without))
        with pytest.raises(UserError, match=f"footage.json: {name}: {said}"):
            read_observation(tmp_path)
    for rows in ("dark", [[1, 2]], [[0, 1, 1], [0, 1, 1]], [[0, 1, "x"]], [[0, 1, None]], [[0.0, 1.0, float("inf")]]):
        with pytest.raises(UserError, match=r"^f: sight: expected rows of time, brightness and contrast"):
            checked_visibility(rows, "f: sight")
