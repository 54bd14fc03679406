"""Several recordings of one site: one report, gaps as gaps, and no begin that is not known."""

import csv
import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pytest

import skope as door
from skope.camera.model import Camera
from skope.dataset import coco
from skope.errors import UserError
from skope.files.json_files import write_json
from skope.site.site_file import parse_site
from skope.tracks.csv_file import TRACKS_CSV, write_tracks
from skope.tracks.track import Track
from skope.traffic.observation import FOOTAGE_FILE, Observation, frame_durations_s
from skope.traffic.recordings import begin_in_name, read_recordings
from skope.traffic.report_tables import report_tables
from tests.sightings import drive
from tests.traffic.drives import straight

Skope = Callable[..., tuple[int, str, str]]
SITE = """time_zone = "Europe/Berlin"
{head}
[[gates]]
name = "west"
line = [[-15, -6], [-15, 6]]
directions = ["in", "out"]

[[gates]]
name = "east"
line = [[15, -6], [15, 6]]
directions = ["out", "in"]

[[lanes]]
name = "lane"
line = [[-40, 0], [40, 0]]
width = 3.5

[traffic]
interval_minutes = 1
"""
LENGTH_S = 60.0
FPS = 10


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("site.toml").write_text(SITE.format(head=""))


def vehicles(count: int, seed: int = 0) -> list[Track]:
    """Vehicles along x of speeds from 9 to 15 m/s, seven a minute, none in the last ten seconds of it."""
    rng = np.random.default_rng(seed)
    start_time = [60 * k + 1.0 + 6 * j for k in range(count) for j in range(7)]
    return [
        straight(number, (-40.0, 0.0), (float(rng.normal(12, 1)), 0.0), 6.5, begin_s=begin)
        for number, begin in enumerate(start_time, start=1)
    ]


def camera_at(y: float, focal_px: float) -> Camera:
    """A camera 9 m over the road."""
    fov = 2 * math.atan(640 / focal_px)
    return Camera.looking((0.0, y, 9.0), yaw=math.pi / 2, pitch_down=0.4, size=(1280, 720), fov=fov)


def write(folder: str, tracks: Sequence[Track], begin_s: float, end_s: float, **known: Any) -> Path:
    """A folder of the tracks and frames from `begin_s` to before `end_s`, whose seconds count from there."""
    path = Path(folder)
    path.mkdir()
    inside = [(one, (one.times_s >= begin_s - 1e-6) & (one.times_s < end_s - 1e-6)) for one in tracks]
    parts = [one.during(rows) for one, rows in inside if rows.any()]
    write_tracks(path / TRACKS_CSV, [replace(one, times_s=one.times_s - begin_s) for one in parts])
    times = np.arange(round((end_s - begin_s) * FPS)) / FPS
    values: dict[str, Any] = {"source": folder, "common_scale_sigma": 0.01, "camera": camera_at(-20.0, 800.0)}
    write_json(path / FOOTAGE_FILE, Observation(times_s=times, **{**values, **known}).to_dict())
    return path


def cells(report: Any, table: str, *without: str) -> list[tuple[Any, ...]]:
    """The rows of a table, but for some columns, as the file has them."""
    found = report_tables(report)[table]
    kept = [k for k, name in enumerate(found.columns) if name not in without]
    rows = ([row[k] for k in kept] for row in found.rows)
    return [tuple(f"{cell:.3f}" if isinstance(cell, float) else cell for cell in row) for row in rows]


def rows_of(path: str) -> list[dict[str, str]]:
    with Path(path).open(encoding="utf-8-sig", newline="") as file:
        return list(csv.DictReader(file))


def contents(folder: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def names(count: int) -> list[str]:
    return [f"cam_2026-11-26_10-{k:02}-00" for k in range(count)]


def test_recordings_without_a_gap_are_the_unbroken_one() -> None:
    tracks = vehicles(3)
    write("whole", tracks, 0, 180, start_time=datetime(2026, 11, 26, 9, tzinfo=UTC))
    for k, name in enumerate(names(3)):
        write(name, tracks, 60 * k, 60 * k + 60)
    whole, parts = door.measure_traffic("whole", "site.toml"), door.measure_traffic(names(3), "site.toml")
    assert whole.start == parts.start
    assert np.array_equal(whole.observation.times_s, parts.observation.times_s), "to the last digit"
    assert sum(one.count or 0 for one in parts.counts_total) == 2 * 2 * 21
    for table in ("counts", "turning_movements", "speeds", "occupancy", "queues", "delays", "conflicts", "visibility"):
        assert cells(parts, table, "track") == cells(whole, table, "track"), table
    assert cells(parts, "events", "recording", "track") == cells(whole, "events", "track")
    # Nobody is told to have driven behind somebody of another recording.
    assert len(whole.headways) - len(parts.headways) == 2 * 2
    assert len({one.number for one in parts.trajectories}) == 21
    assert not any("were not observed" in line for line in parts.notes)


def test_between_recordings_nothing_is_observed(skope: Skope) -> None:
    tracks = vehicles(3)
    late, early = write("late", tracks, 120, 180), write("early", tracks, 0, 60)
    times = ("--start-time", "2026-11-26T10:02:00", "--start-time", "2026-11-26T10:00")
    code, _, err = skope("eval", "traffic", late, early, *times, "--out", "r")
    assert code == 0, err
    counted = {
        (row["begin"][11:16], row["observed"], row["count"], row["count_low_90"] != "")
        for row in rows_of("r/counts.csv")
        if (row["gate"], row["direction"], row["class"], row["lane"]) == ("west", "in", "all", "all")
    }
    assert counted == {
        ("10:00", "full", "7", True),
        ("10:01", "none", "", False),
        ("10:02", "full", "7", True),
    }
    assert {(row["time"][11:16], row["recording"]) for row in rows_of("r/events.csv")} == {
        ("10:00", "1"),
        ("10:02", "2"),
    }
    moments = rows_of("r/trajectories.csv")
    assert {row["track"] for row in moments if row["recording"] == "1"} == {str(k) for k in range(1, 8)}
    summary = json.loads(Path("r/summary.json").read_text())
    assert [one["tracks"] for one in summary["recordings"]] == summary["tracks"] == ["early", "late"]
    assert [(one["begin_s"], one["added_to_track"]) for one in summary["recordings"]] == [(0.0, 0), (120.0, 7)]
    numbers = {int(row["track"]) - 7 for row in moments if row["recording"] == "2"}
    assert numbers == {int(row["track"]) for row in rows_of("late/tracks.csv")}
    assert any("60 s within the footage were not observed" in line for line in summary["notes"])

    times = (*times[2:], *times[:2])
    assert skope("eval", "traffic", early, late, *times, "--out", "again", "-q")[0] == 0
    assert contents("again") == contents("r")
    assert skope("eval", "traffic", early, late, *times, "--out", "r", "-q")[0] == 0, "the same work in another order"
    swapped = (times[0], times[3], times[2], times[1])
    code, _, err = skope("eval", "traffic", early, late, *swapped, "--out", "r")
    assert (code, "another run" in err, err.count("\n")) == (2, True, 1)
    assert contents("r") == contents("again")
    code, _, err = skope("eval", "traffic", early, *times[:2], "--out", "r")
    assert (code, "another run" in err) == (2, True)


def test_a_track_is_joined_over_a_short_gap_alone() -> None:
    one = straight(1, (-40.0, 0.0), (12.0, 0.0), 6.5, begin_s=57.0)
    write(names(1)[0], [one], 0, 60)
    write("soon", [one], 61, 121, source="")
    write("later", [one], 63.2, 121, source="")
    start_time = ["2026-11-26T10:00:00", "2026-11-26T10:01:01"]
    near = door.measure_traffic([names(1)[0], "soon"], "site.toml", start_time=start_time)
    (track,) = near.trajectories
    assert (track.number, track.joined) == (1, (2,))
    assert [near.observation.recording_at(time) for time in (59.9, 60.9, 61.0)] == [1, 1, 2]
    start_time[1] = "2026-11-26T10:01:21"
    assert len(door.measure_traffic([names(1)[0], "soon"], "site.toml", start_time=start_time).trajectories) == 2


def test_a_vehicle_that_a_seam_cuts_is_not_lost_at_the_gate() -> None:
    """A recording that ends while somebody is at the gate says nothing of what the gate misses."""
    cut = [straight(k, (-25.0 - 12 * k, 0.0), (12.0, 0.0), 2.0, begin_s=58.0) for k in range(3)]
    write(names(1)[0], cut, 0, 60)
    write(names(2)[1], [], 60, 120)
    report = door.measure_traffic(names(2), "site.toml")
    assert report.observation.spans.tolist() == pytest.approx(np.array([[0, 60], [60, 120]]))
    assert all(report.observation.is_cut(time) for time in (59.9, 60.0))
    assert not report.observation.together(59.0, 61.0)
    assert report.unseen.vanished == ()


def test_the_hour_that_comes_twice() -> None:
    tracks = vehicles(1)
    write("first", tracks, 0, 60, start_time=datetime(2026, 10, 25, 0, 59, 30, tzinfo=UTC))  # 02:59:30 in summer
    write("second", tracks[:5], 0, 60, start_time=datetime(2026, 10, 25, 1, 0, 30, tzinfo=UTC))  # 02:00:30 in winter
    report = door.measure_traffic(["second", "first"], "site.toml")
    start_time = [one.begin.isoformat()[11:] for one in report.intervals if one.begin]
    assert start_time == ["02:59:00+02:00", "02:00:00+01:00", "02:01:00+01:00"]
    assert [one.begin_s for one in report.recordings] == [0.0, 60.0]
    with pytest.raises(UserError, match="start_time: 2026-10-25T02:30:00: clocks show this twice"):
        door.measure_traffic(
            ["first", "second"], "site.toml", start_time=["2026-10-25T02:30:00", "2026-10-25T04:00:00"]
        )


def test_a_begin_in_a_name_is_a_guess_and_said() -> None:
    site = parse_site(Path("site.toml"), b'time_zone = "Europe/Berlin"')
    zone = ZoneInfo("Europe/Berlin")
    for name in ("HOST_2026-11-26_10-00-00", "ch01_20261126100000", "20261126-100000.mp4", "x-20261126T090000Z"):
        assert begin_in_name(name, site) == datetime(2026, 11, 26, 10, tzinfo=zone), name
    for name in (
        "cam", "2026-11-26", "120261126100000", "20261126_100000_20261126_110000", "2026-13-26_10-00-00",
        "2026-10-25_02-30-00", "2026-03-29_02-30-00", "20261126_1000001", "2026-11-26T10-00-00+0200",
        "2026-11-26T10:00:00-05:00",
    ):  # fmt: skip
        assert begin_in_name(name, site) is None, name
    assert begin_in_name("2026-11-26_10-00-00", parse_site(Path("site.toml"), b"")) is None
    tracks = vehicles(2)
    for k, name in enumerate(names(2)):
        write(name, tracks, 60 * k, 60 * k + 60)
    refused = door.measure_traffic(names(2), "site.toml").notes
    assert any("2 of 2 recordings: the start is guessed from the name of the footage" in line for line in refused)


def test_begins_that_are_known_to_a_second_leave_no_overlap() -> None:
    tracks = vehicles(2)
    write("a", tracks, 0, 60.4)
    write("b", tracks, 60.4, 120)
    start_time = ["2026-11-26T10:00:00", "2026-11-26T10:01:00"]
    report = door.measure_traffic(["a", "b"], "site.toml", start_time=start_time)
    assert report.observation.spans[1, 0] == pytest.approx(60.4)
    assert any("begin up to 0.40 s before the previous recording ends (first: b)" in line for line in report.notes)


@pytest.mark.parametrize(
    ("start_time", "said"),
    [
        (["10:00:00", "10:00:58"], "b: begins at 2026-11-26T10:00:58+01:00, before a ends (2026-11-26T10:01:00"),
        (["10:00:00"], "--start-time: expected one time for each of 2 recordings, in their order; got 1"),
        ([], "a: the start time is not known: give --start-time once for each recording"),
        (["10:00:00", "noon"], "--start-time: expected a time like 2026-11-26T10:00:00, got '2026-11-26Tnoon'"),
    ],
)
def test_what_cannot_be_one_report_gets_one_line(
    skope: Skope, start_time: list[str], said: str, tmp_path: Path
) -> None:
    tracks = vehicles(2)
    write("a", tracks, 0, 60)
    write("b", tracks, 60, 120)
    Path("site.toml").write_text(SITE.format(head="start = 2026-11-26T10:00:00"))
    words = [word for one in start_time for word in ("--start-time", f"2026-11-26T{one}")]
    code, _, err = skope("eval", "traffic", "a", "b", *words, "--out", "r")
    assert (code, err.count("\n")) == (2, 1), err
    assert said in err
    assert not Path("r").exists()


def test_a_recording_is_not_counted_twice(skope: Skope) -> None:
    write("a", vehicles(1), 0, 60)
    shutil.copytree("a", "b")
    start_time = ["2026-11-26T10:00:00", "2026-11-26T10:01:00"]
    with pytest.raises(UserError, match=r"b/tracks.csv: contains the same tracks as a/tracks.csv"):
        door.measure_traffic(["a", "b"], "site.toml", start_time=start_time)
    with pytest.raises(UserError, match=r"a: given twice"):
        door.measure_traffic(["a", "./a"], "site.toml", start_time=start_time)
    write("c", vehicles(2), 60, 120)
    with pytest.raises(UserError, match="more than 31 days after a"):
        door.measure_traffic(["a", "c"], "site.toml", start_time=[start_time[0], "2027-11-26T10:01:00"])
    write("none", [], 0, 0, start_time=datetime(2026, 11, 26, 12, tzinfo=UTC))
    with pytest.raises(UserError, match=r"none/footage\.json: times_s: expected at least one frame"):
        door.measure_traffic(["a", "none"], "site.toml", start_time=start_time)
    with pytest.raises(ValueError, match="not both"):
        door.measure_traffic(["a", object()], "site.toml")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="start_time: expected a time like 2026-11-26T10:00:00, got '0001-01-01'"):
        door.measure_traffic(["a", "c"], "site.toml", start_time=["0001-01-01", start_time[0]])
    document = json.loads(Path("a/footage.json").read_text())
    Path("a/footage.json").write_text(json.dumps({**document, "start_time": "2026-11-26T10:00:00"}))
    code, _, err = skope("eval", "traffic", "a", "--out", "r")
    assert (code, err.count("\n")) == (2, 1)
    assert "a/footage.json: start_time: expected a time with its UTC offset" in err


def test_cameras_that_were_calibrated_again_are_taken_with_care() -> None:
    tracks = vehicles(2)
    write(names(2)[0], tracks, 0, 60)
    write(names(2)[1], tracks, 60, 120, common_scale_sigma=0.03, camera=camera_at(-22.0, 400.0))
    report = door.measure_traffic(names(2), "site.toml")
    seen = report.observation
    assert seen.common_scale_sigma == 0.03
    first_px, second_px = (part.pixels_per_metre(np.zeros(2)) or 0.0 for part in seen.parts)
    assert seen.pixels_per_metre(np.zeros(2)) == second_px < first_px / 2
    assert any("the calibration error is 1.00% in one recording and 3.00% in another" in line for line in report.notes)
    assert any("recordings differ in the calibration of the camera" in line for line in report.notes)

    write("third", [], 0, 60, common_scale_sigma=None, start_time=datetime(2026, 11, 26, 12, tzinfo=UTC))
    unknown = door.measure_traffic([*names(2), "third"], "site.toml")
    assert unknown.observation.common_scale_sigma is None
    assert any("only 2 of 3 recordings have a camera with covariance" in line for line in unknown.notes)
    assert not any(one.common_known for one in unknown.speeds)


def test_a_count_by_hand_may_go_over_a_seam_but_not_over_a_gap(skope: Skope) -> None:
    tracks = vehicles(3)
    for k, name in enumerate(names(2)):
        write(name, tracks, 60 * k, 60 * k + 60)
    write("after", tracks, 130, 180, start_time=datetime(2026, 11, 26, 9, 2, 10, tzinfo=UTC))
    head = "gate,direction,class,begin,end,count\n"
    Path("h.csv").write_text(f"{head}west,in,all,10:00,10:02,14\n")
    (check,) = door.measure_traffic([*names(2), "after"], "site.toml", manual_count="h.csv").manual_count_checks
    assert (check.count, check.hand.number) == (14, 14)
    Path("h.csv").write_text(f"{head}west,in,all,10:01,10:03,14\n")
    with pytest.raises(UserError, match="the footage has a gap from begin to end"):
        door.measure_traffic([*names(2), "after"], "site.toml", manual_count="h.csv")


def test_a_picture_does_not_stand_until_the_next_recording() -> None:
    times = np.array([0.0, 1.0, 2.0, 2.5, 100.0, 101.0])
    assert frame_durations_s(times, 0.0, 200.0, [100.0]).tolist() == [1.0, 1.0, 0.5, 1.0, 1.0, 1.0]
    assert frame_durations_s(times, 0.0, 200.0)[3] == 1.0


def test_tracks_know_when_their_footage_began(skope: Skope) -> None:
    coco.write(Path("road.json"), drive(1.0, 5.0))
    call = ("eval", "track", "--annotations", "road.json", "--out", "t", "-q")
    code, _, err = skope(*call, "--start-time", "2026-11-26T10:00:00")
    assert (code, err.count("\n"), Path("t").exists()) == (2, 1, False)
    assert "--start-time: expected a time with its UTC offset" in err
    assert skope(*call, "--start-time", "2026-11-26T10:00:00+01:00")[0] == 0
    assert door.measure_traffic("t", "site.toml").start == datetime(2026, 11, 26, 9, tzinfo=UTC)
    code, _, err = skope(*call, "--start-time", "2026-11-26T11:00:00+01:00")
    assert (code, "another run (start_time = 2026-11-26T10:00:00+01:00" in err) == (2, True)
    Path("site.toml").write_text(SITE.format(head="start = 2026-11-26T12:00:00"))
    report = door.measure_traffic("t", "site.toml")
    assert report.start == datetime(2026, 11, 26, 9, tzinfo=UTC), "its own begin, not that of another recording"
    later = door.measure_traffic("t", "site.toml", start_time="2026-11-26T13:00:00").start
    assert later == datetime(2026, 11, 26, 12, tzinfo=UTC)


def test_windows_of_a_stream_with_irregular_frames_do_not_drift_apart() -> None:
    """Each window ends with a frame, whose usual duration reaches beyond the first frame of the next window."""
    rng = np.random.default_rng(1)
    times_s = np.cumsum(rng.choice([0.2, 0.2, 0.2, 0.4, 0.6], 12_000))
    begin = datetime(2026, 11, 26, 10, tzinfo=UTC)
    site = parse_site(Path("site.toml"), SITE.format(head="").encode())
    folders = []
    for number, window in enumerate(np.split(times_s, np.flatnonzero(np.diff(times_s // 10)) + 1)):
        folder = Path(f"w{number:04d}")
        folder.mkdir()
        write_tracks(folder / TRACKS_CSV, [])
        start = begin + timedelta(seconds=float(window[0]))
        known = Observation(times_s=window - window[0], source="camera", start_time=start)
        write_json(folder / FOOTAGE_FILE, known.to_dict())
        folders.append(folder)
    footage = read_recordings(folders, (), site, "start_time")
    assert len(footage.recordings) == len(folders) > 300
    assert max(recording.late_s for recording in footage.recordings) < 0.01
    spans = footage.observation.spans
    assert (spans[1:, 0] - spans[:-1, 1] > -0.01).all()
    # At a seam, the time after a frame's usual duration is not observed.
    missing_s = times_s[-1] - times_s[0] - footage.observation.observed_s
    assert -0.5 < missing_s < 0.4 * len(folders)
