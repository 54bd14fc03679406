"""`skope eval traffic`: from tracks to files, what is refused in one line, and the same from Python."""

import base64
import csv
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import skope as door
from skope import cli
from skope.camera.model import Camera
from skope.dataset import coco
from skope.errors import UserError
from skope.files.json_files import write_json
from skope.pose.camera_error import CALIBRATED_FIELD
from skope.schema import AnnotationFile, Result, RoadUserResult
from skope.site.site_file import parse_site, read_site
from skope.site.traffic_settings import TrafficSettings
from skope.site.write_site import save_site
from skope.tracking.headings import with_body_error
from skope.tracking.track_list import Tracks
from skope.tracking.vehicle_tracker import track_vehicles
from skope.tracks.csv_file import TRACKS_CSV, read_tracks, write_tracks
from skope.traffic.measure import measure
from skope.traffic.observation import FOOTAGE_FILE, Observation
from skope.traffic.report_tables import report_tables
from skope.video.write import write_video
from tests.eval.cli.test_footage import numbered_video
from tests.sightings import CAMERA, drive
from tests.traffic.drives import straight

Skope = Callable[..., tuple[int, str, str]]
HEAD = 'time_zone = "Europe/Berlin"\nstart = 2026-11-26T10:14:58\n'


def site_of(file: AnnotationFile, name: str = "site.toml", head: str = HEAD) -> Path:
    """A site file with a gate across the way that `drive` takes, in the middle."""
    boxes = [a.box_3d for a in file.annotations if a.box_3d and a.track_id == 1]
    middle, ahead = boxes[len(boxes) // 2].center[:2], boxes[-1].center[:2] - boxes[0].center[:2]
    across = 8 * np.array([ahead[1], -ahead[0]]) / np.linalg.norm(ahead)
    # From its right to its left as the car sees it: who comes is on the left of the line as drawn.
    line = [(middle + across).round(3).tolist(), (middle - across).round(3).tolist()]
    text = f'{head}[[gates]]\nname = "gate"\nline = {line}\ndirections = ["here", "away"]\n'
    Path(name).write_text(text)
    return Path(name)


def rows_of(path: str) -> list[dict[str, str]]:
    with Path(path).open(encoding="utf-8-sig", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AnnotationFile]:
    """A folder of tracks of a car at 12 m/s, and one that stands, and what they were made of."""
    file, folder = drive(5.0, 5.0), tmp_path_factory.mktemp("followed")
    coco.write(folder / "road.json", file)
    words = ["eval", "track", "--annotations", f"{folder}/road.json", "-q", "--out", f"{folder}/t"]
    assert CliRunner().invoke(cli.app, words, catch_exceptions=False).exit_code == 0
    return folder / "t", file


@pytest.fixture
def tracks(skope: Skope, followed: tuple[Path, AnnotationFile]) -> AnnotationFile:
    """The tracks lie in the folder t."""
    shutil.copytree(followed[0], "t")
    return followed[1]


def test_from_tracks_to_a_report(skope: Skope, tracks: AnnotationFile) -> None:
    site_of(tracks)
    code, out, err = skope("eval", "traffic", "t", "--out", "r")
    assert code == 0, err
    (gate,) = (row for row in rows_of("r/events.csv") if row["event"] == "gate")
    assert (gate["place"], gate["direction"], gate["class"]) == ("gate", "here", "car")
    assert float(gate["speed_kmh"]) == pytest.approx(12 * 3.6, abs=0.5)
    passing = [a.image_id for a in tracks.annotations if a.track_id == 1]
    assert float(gate["time_s"]) == pytest.approx((passing[len(passing) // 2] - 1) / 5, abs=0.02)
    assert gate["time"].startswith("2026-11-26T10:15:00.")
    counted = {(row["begin"][11:16], row["direction"]): row["count"] for row in rows_of("r/counts.csv")
               if row["class"] == row["lane"] == "all"}  # fmt: skip
    assert counted == {
        ("10:00", "away"): "0", ("10:00", "here"): "0", ("10:15", "away"): "0", ("10:15", "here"): "1"
    }  # fmt: skip
    speeds = rows_of("r/speeds.csv")
    assert all(row["v85_kmh"] == "" and "an interval needs 19" in row["unavailable_reason"] for row in speeds)
    summary = json.loads(Path("r/summary.json").read_text())
    assert summary["site_revision"] == read_site(Path("site.toml")).revision
    assert summary["settings"] == TrafficSettings().to_dict()
    assert summary["observed_s"] == pytest.approx(5.0)
    assert any("no lanes" in line for line in summary["notes"])
    assert "gate    here" in out
    moments = rows_of("r/trajectories.csv")
    assert len(moments) < 0.6 * len(rows_of("t/tracks.csv")), "thinned"

    before = {path.name: path.read_bytes() for path in Path("r").iterdir()}
    assert skope("eval", "traffic", "t", "--out", "r", "-q")[0] == 0
    assert {path.name: path.read_bytes() for path in Path("r").iterdir()} == before
    Path("site.toml").write_text(Path("site.toml").read_text() + "[traffic]\ninterval_minutes = 5\n")
    code, _, err = skope("eval", "traffic", "t", "--out", "r")
    assert (code, "another run" in err) == (2, True)


def test_python_counts_what_the_command_counts(tracks: AnnotationFile) -> None:
    site = site_of(tracks)
    report = door.measure_traffic("t", site)
    (crossing,) = report.crossings
    assert [one.count for one in door.count("t", str(site)) if one.count] == [1, 1, 1]  # of all, of vehicles, of cars
    with Path("t/tracks.csv").open() as file:
        assert sum(1 for _ in file) > 20
    found = door.measure_traffic([], site, times_s=[0.0, 0.1, 0.2])
    assert [one.count for one in found.counts if one.class_name == "all"] == [0, 0]
    assert crossing.sigma_s < 0.05


def test_a_moved_camera_observes_nothing(tracks: AnnotationFile) -> None:
    document = json.loads(Path("t/footage.json").read_text())
    assert document["common_scale_sigma"] is None
    assert document["camera"]["T_camera_world"] == CAMERA.T_camera_world.tolist()
    document["times_s"] = [time for time in document["times_s"] if not 1.0 < time < 3.0]
    Path("t/footage.json").write_text(json.dumps(document))
    report = door.measure_traffic("t", site_of(tracks))
    assert any("were not observed" in line for line in report.notes)
    assert report.observation.seconds_in(0, 5) == pytest.approx(5 - 2.0, abs=0.21)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("interval_minutes = 7", "traffic.interval_minutes: expected whole minutes that a day is a multiple of"),
        ("interval_minutes = 0.5", "traffic.interval_minutes: expected a number from 1 to 1440"),
        ('classes = ["car", "tram"]', "traffic.classes: 'tram' is none of the classes: car, van"),
        ('turning = ["south"]', "traffic.turning: 'south' is none of the gates of this file: gate"),
        ("ttc_s = -1", "traffic.ttc_s: expected a number from 0.1 to 10"),
        ("queue_end_kmh = 2", "traffic.queue_end_kmh: expected 5 (queue_speed_kmh) or more"),
        ("free_flow_kmh = true", "traffic.free_flow_kmh: expected a number from 5 to 250, got True"),
    ],
)
def test_settings_that_are_wrong_get_one_line(
    skope: Skope, text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("site.toml").write_text(f'[[gates]]\nname = "gate"\nline = [[0, 0], [0, 5]]\n[traffic]\n{text}\n')
    code, _, err = skope("eval", "traffic", "nothing", "--out", "r")
    assert (code, err.count("\n")) == (2, 1)
    assert f"site.toml: {said}" in err
    assert not Path("r").exists()


def test_settings_are_read_kept_and_named(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text("# mine\n[traffic]\ninterval_minutes = 5 # short\nspeed_limit = 50\n")
    site = read_site(path)
    assert site.traffic == TrafficSettings(interval_minutes=5)
    assert site.unknown == ("traffic.speed_limit",)
    saved = save_site(path, {"traffic": {"ttc_s": 2.0}}, site.revision)
    assert saved.traffic == TrafficSettings(interval_minutes=5, ttc_s=2.0)
    assert "# short" in path.read_text()
    assert "speed_limit = 50" in path.read_text()
    assert parse_site(path, b"").traffic == TrafficSettings()


def test_files_that_are_wrong_get_one_line(skope: Skope, tracks: AnnotationFile) -> None:
    site_of(tracks)
    whole = Path("t/tracks.csv").read_text()
    footage = Path("t/footage.json").read_text()

    def refused(said: str) -> None:
        code, _, err = skope("eval", "traffic", "t", "--out", "r")
        assert (code, err.count("\n")) == (2, 1), err
        assert said in err
        assert not Path("r").exists()

    Path("t/tracks.csv").write_text(whole.replace("sigma_speed", "sigma"))
    refused("t/tracks.csv: expected a column sigma_speed")
    lines = whole.splitlines()
    Path("t/tracks.csv").write_text(
        "\n".join(
            [*lines[:3], ",".join("here" if k == 9 else cell for k, cell in enumerate(lines[3].split(","))), *lines[4:]]
        )
    )
    refused("t/tracks.csv: line 4: x: expected a number, got 'here'")
    Path("t/tracks.csv").write_text(whole)
    Path("t/footage.json").write_text(footage.replace('"times_s":[0.0', '"times_s":[9.0'))
    refused("t/footage.json: times_s: expected increasing times")
    Path("t/footage.json").unlink()
    refused("t/footage.json: no such file; `skope eval track` writes it")
    code, _, err = skope("eval", "traffic", "t", "--start-time", "noon", "--out", "r")
    assert (code, "--start-time: expected a time" in err) == (2, True)


def test_without_a_camera_gates_in_the_image_count_and_nothing_else(skope: Skope) -> None:
    """Boxes that go to the right, over a gate that is drawn upwards: from its left to its right."""
    file = drive(5.0, 10.0, speeds=(0.0,))
    images = tuple(image for image in file.images)
    rows: list[Result | RoadUserResult] = []
    for k, image in enumerate(images):
        seen = {1: [10.0 + 8 * k, 100, 60, 40], 2: [400.0 - 8 * k, 100, 60, 40], 4: [20.0 + 8 * k, 80, 60, 40]}
        if k > 4:
            seen[3] = [14.0 + 8 * k, 103, 50, 34]  # the first one a second time; the fourth drives beside it
        rows += [
            Result(image_id=image.id, score=0.9, bbox=np.array(box), keypoints=np.zeros((33, 3)), track_id=number)
            for number, box in seen.items()
        ]
    Path("seen").mkdir()
    bare = AnnotationFile(images=images, annotations=(), info={"source": "a.mp4"}, name="a.mp4", scheme=file.scheme)
    coco.write(Path("seen/frames.json"), bare)
    coco.write_results(Path("seen/predictions.json"), rows)
    Path("site.toml").write_text(
        '[[gates]]\nname = "g"\npixels = [[240, 200], [240, 60]]\ndirections = ["right", "left"]\n'
    )
    code, out, err = skope("eval", "traffic", "seen", "--out", "r")
    assert code == 0, err
    assert "no metres: positions are in pixels" in out
    assert "classes of vehicles: not available at gates in the image" in out
    counts = {row["class"]: row for row in rows_of("r/counts.csv") if row["direction"] == "right"}
    assert list(counts) == ["all", "vehicle", "unknown", "motorcycle", "bicycle", "pedestrian"]
    shown = [(counts[name]["count"], bool(counts[name]["count_high_90"])) for name in ("vehicle", "unknown", "bicycle")]
    assert shown == [("2", True), ("2", False), ("0", True)]
    assert "the site file has a camera" not in out
    camera = f"[camera]\nsize = [{images[0].width}, {images[0].height}]\nfov_deg = 60\nposition = [0, 0, 6]\n"
    Path("known.toml").write_text(f"{camera}look_at = [0, 20, 0]\n{Path('site.toml').read_text()}")
    code, out, err = skope("eval", "traffic", "seen", "--site", "known.toml", "--out", "known")
    assert (code, "note: the site file has a camera, but seen has detections in pixels" in out) == (0, True), err
    assert sorted(path.name for path in Path("r").iterdir()) == [
        "counts.csv", "events.csv", "report.html", "summary.json", "turning_movements.csv", "visibility.csv",
        "work.json",
    ]  # fmt: skip
    Path("h.csv").write_text("gate,direction,class,begin,end,count\ng,right,all,0,4,3\n")
    assert skope("eval", "traffic", "seen", "--out", "manual_count", "--manual-count", "h.csv")[0] == 0
    (manual_count,) = rows_of("manual_count/manual_count.csv")
    assert (manual_count["count"], manual_count["difference"]) == ("2", "-1")
    events = rows_of("r/events.csv")
    assert sorted((row["direction"], row["track"], row["speed_kmh"]) for row in events) == [
        ("left", "2", ""), ("right", "1", ""), ("right", "3", "")
    ]  # fmt: skip
    assert sorted(row["y"] for row in events) == ["120.000", "140.000", "140.000"]
    # Drawn in a picture of half the size it counts the same; of another aspect ratio it is rejected.
    width, height = images[0].width, images[0].height
    half = f'[[gates]]\nname = "g"\npixels = [[120, 100], [120, 30]]\nsize = [{width // 2}, {height // 2}]\n'
    Path("half.toml").write_text(half + 'directions = ["right", "left"]\n')
    assert skope("eval", "traffic", "seen", "--site", "half.toml", "--out", "half")[0] == 0
    assert rows_of("half/counts.csv") == rows_of("r/counts.csv")
    Path("half.toml").write_text(half.replace(f"{height // 2}]", f"{height // 2 + 40}]"))
    code, _, err = skope("eval", "traffic", "seen", "--site", "half.toml", "--out", "other")
    assert (code, err.count("\n"), Path("other").exists()) == (2, 1, False)
    drawn = f"drawn in an image of {width // 2}x{height // 2 + 40}, but this footage is {width}x{height}"
    assert f"half.toml: gate 'g': {drawn}" in err
    Path("site.toml").write_text("")
    code, _, err = skope("eval", "traffic", "seen", "--out", "other")
    assert (code, "needs gates with `pixels`" in err) == (2, True)


def test_gates_in_the_image_are_drawn_on_the_empty_road_if_the_footage_is_there(skope: Skope) -> None:
    driven = drive(5.0, 10.0, speeds=(0.0,))
    times_s = np.arange(24) / 2
    frames = [np.full((90, 160, 3), 90, dtype=np.uint8) for _ in times_s]
    for k, frame in enumerate(frames):
        frame[40:60, 6 * k : 6 * k + 12] = 250  # a white vehicle, in no pixel for most of the time
    write_video(Path("a.mp4"), iter(frames), 2.0)
    images = tuple(
        replace(
            driven.images[0], id=k + 1, file_name=f"{k}.jpg", width=160, height=90, time_s=float(time_s), frame_index=k
        )
        for k, time_s in enumerate(times_s)
    )
    boxes = [np.array([6.0 * k, 40, 12, 20]) for k in range(len(images))]
    rows: list[Result | RoadUserResult] = [
        Result(image_id=image.id, score=0.9, bbox=box, keypoints=np.zeros((33, 3)), track_id=1)
        for image, box in zip(images, boxes, strict=True)
    ]
    info = {"source": "a.mp4", "found_at": "../a.mp4"}
    file = AnnotationFile(images=images, annotations=(), info=info, name="a.mp4", scheme=driven.scheme)
    Path("seen").mkdir()
    coco.write(Path("seen/frames.json"), file)
    coco.write_results(Path("seen/predictions.json"), rows)
    Path("site.toml").write_text('[[gates]]\nname = "g"\npixels = [[80, 80], [80, 20]]\n')
    code, out, err = skope("eval", "traffic", "seen", "--out", "r")
    assert code == 0, err
    assert "no picture" not in out
    page = Path("r/report.html").read_text()
    (data,) = re.findall(r'<image href="data:image/jpeg;base64,(.*?)"', page)
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (90, 160)
    assert picture.max() < 110  # nobody is in it
    Path("a.mp4").unlink()
    code, out, err = skope("eval", "traffic", "seen", "--out", "later")
    assert code == 0, err
    assert "note: the page has no image of the road: " in out
    assert "<image" not in Path("later/report.html").read_text()


def test_memory_folder_and_read_back_tracks_give_one_report(tracks: AnnotationFile) -> None:
    """To the last digit: every table, and every number of every row."""
    from tests.tracking.test_vehicle_tracker import seen, straight

    times = (np.arange(60) / 10).tolist()
    drives = [straight(9.0 + k / 7, 3.1 * k) for k in range(4)]
    made = track_vehicles(seen(drives, times), times)
    assert len(made) == 4
    folder = Path("memory")
    folder.mkdir()
    watch = Observation(times_s=np.array(times), common_scale_sigma=0.013)
    write_tracks(folder / TRACKS_CSV, made)
    write_json(folder / FOOTAGE_FILE, watch.to_dict())
    site = site_of(tracks)
    in_memory = door.measure_traffic(Tracks(made, watch), site)
    read_back = door.measure_traffic(Tracks(read_tracks(folder / TRACKS_CSV), watch), site)
    for report in (in_memory, read_back):
        assert tables(report) == tables(door.measure_traffic(folder, site))
    assert len(tables(in_memory)["events"]) == 2
    with pytest.raises(UserError, match="no such file"):
        door.measure_traffic("nowhere", site)


def tables(report: Any) -> dict[str, list[Any]]:
    """All rows of a report's tables, numbers as they are; NaN equal to itself."""
    return {name: [[repr(cell) for cell in row] for row in table.rows] for name, table in report_tables(report).items()}


def test_a_vehicles_height_is_one_error_along_the_line_of_sight() -> None:
    """A vehicle that stands 4 cm higher than the plane seems 0.04 * distance / height nearer all the way."""
    still = straight(1, (80.0, 0.0), (0.0, 0.0), 1.0, sigma=0.1)
    body = with_body_error(still, np.array([0.0, 0.0, 8.0]), 0.04)
    assert body.body_error == pytest.approx(np.tile([0.4, 0.0], (11, 1)))
    assert np.array_equal(body.covariance, still.covariance), "noise alone"
    assert body.total_covariance[0] == pytest.approx(np.diag([0.1**2 + 0.4**2, 0.1**2]))
    leaves = with_body_error(straight(1, (80.0, 0.0), (10.0, 0.0), 1.0), np.array([0.0, 0.0, 8.0]), 0.04)
    assert leaves.speed_sigma == pytest.approx(np.hypot(0.1, 10 * 0.04 / 8))


def test_footage_is_detected_and_tracked_first_and_once(
    skope: Skope, random_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that was stopped goes on after what it has: finished tracks are not made again."""
    numbered_video(Path("v.mp4"), 8)
    site = Path("site.toml")
    call = ("eval", "traffic", "v.mp4", "--checkpoint", random_run, "--device", "cpu", "--out", "r")
    site.write_text(HEAD + '[[gates]]\nname = "g"\nline = [[0, 20], [9, 20]]\n')
    code, _, err = skope(*call)
    assert (code, err.count("\n"), Path("r").exists()) == (2, 1, False)
    assert "site.toml: gates: expected a gate drawn in the image (`pixels`), or a [camera] for metres" in err
    camera = "[camera]\nsize = [96, 64]\nfov_deg = 60.0\nposition = [0, 0, 6]\nyaw_deg = 90.0\npitch_deg = 20.0\n"
    camera += 'covariance = { of = ["z"], matrix = [[0.0036]] }\n'  # 6 cm of 6 m: all distances are off by 1%
    site.write_text(f"{site.read_text()}{camera}")
    assert skope(*call)[0] == 0
    assert {"seen", "tracks", "camera.json", "counts.csv", "summary.json"} <= {
        path.name for path in Path("r").iterdir()
    }
    made = {path.name: path.read_bytes() for path in Path("r").glob("*.csv")}
    assert json.loads(Path("r/tracks/footage.json").read_text())["times_s"] == pytest.approx(np.arange(8) / 10)
    assert [row[0] for row in json.loads(Path("r/tracks/footage.json").read_text())["visibility_samples"]] == [0.0, 0.5]
    assert all(0 < float(row["brightness"]) < 1 for row in rows_of("r/visibility.csv"))
    assert json.loads(Path("r/summary.json").read_text())["camera_common_sigma"] == pytest.approx(0.01, rel=0.1)

    def never(*_: object) -> None:
        raise AssertionError("detected again")

    monkeypatch.setattr("skope.footage.predict_footage.predict", never)
    Path("r/summary.json").unlink()
    code, out, _ = skope(*call)
    assert (code, "has the tracks of" in out) == (0, True)
    assert {path.name: path.read_bytes() for path in Path("r").glob("*.csv")} == made
    numbered_video(Path("v.mp4"), 9)
    code, _, err = skope(*call)
    assert (code, "another run" in err) == (2, True)


def test_a_site_without_gates_is_warned_of_before_minutes_are_spent(
    skope: Skope, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbered_video(Path("v.mp4"), 8)
    Path("site.toml").write_text(VIDEO_CAMERA.format(width=96, height=64))

    def stop(*_: object) -> None:
        raise UserError("detects now")

    monkeypatch.setattr("skope.footage.predict_footage.predict", stop)
    _, _, err = skope("eval", "traffic", "v.mp4", "--out", "r", "--device", "cpu")
    assert err.index("site.toml: has no gates: nothing will be counted") < err.index("detects now")


VIDEO_CAMERA = (
    "[camera]\nsize = [{width}, {height}]\nfov_deg = 60.0\nposition = [0, 0, 6]\nyaw_deg = 90.0\npitch_deg = 20.0\n"
)
IMAGE_GATE = '[[gates]]\nname = "g"\npixels = [[20, 100], [160, 100]]\nsize = [{width}, {height}]\n'


def test_footage_is_counted_by_gates_in_the_image_where_there_is_no_camera(
    skope: Skope, random_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gate is of a picture twice as large; another aspect ratio is rejected before anything is detected."""
    numbered_video(Path("v.mp4"), 8)
    site = Path("site.toml")
    call = ("eval", "traffic", "v.mp4", "--checkpoint", random_run, "--device", "cpu", "--out", "r")
    site.write_text(IMAGE_GATE.format(width=192, height=144))
    code, out, err = skope(*call)
    assert (code, err.count("\n"), Path("r").exists()) == (2, 1, False)
    assert "site.toml: gate 'g': drawn in an image of 192x144, but this footage is 96x64" in err
    site.write_text(IMAGE_GATE.format(width=192, height=128))
    code, out, err = skope(*call)
    assert (code, "warning" in err) == (0, False), err
    assert "no metres: positions are in pixels" in out
    written = {path.name for path in Path("r").iterdir()}
    assert {"seen", "counts.csv", "events.csv", "report.html", "summary.json"} <= written
    assert "tracks" not in written
    assert len(rows_of("r/counts.csv")) > 0

    def never(*_: object) -> None:
        raise AssertionError("detected again")

    monkeypatch.setattr("skope.footage.predict_footage.predict", never)
    made = Path("r/counts.csv").read_bytes()
    frames = json.loads(Path("r/seen/frames.json").read_text())
    frames["info"]["skipped"] = ["v.mp4: frame 5 of 8 cannot be decoded"]
    Path("r/seen/frames.json").write_text(json.dumps(frames))
    code, out, _ = skope(*call)
    assert (code, "has the detections of v" in out) == (0, True)
    assert Path("r/counts.csv").read_bytes() == made
    note = "not read in the footage: v.mp4: frame 5 of 8 cannot be decoded"
    assert f"note: {note}" in out
    assert note in json.loads(Path("r/summary.json").read_text())["notes"]
    code, _, err = skope(*call, "--manual-count", "h.csv")
    assert (code, "skope eval traffic r/seen --site site.toml` with --manual-count" in err) == (2, True)


def test_a_camera_of_another_image_size_is_scaled_to_the_footage(skope: Skope, random_run: Path) -> None:
    numbered_video(Path("v.mp4"), 8)
    gate = '[[gates]]\nname = "g"\nline = [[0, 20], [9, 20]]\n'
    call = ("eval", "traffic", "v.mp4", "--checkpoint", random_run, "--device", "cpu", "--out", "r")
    Path("site.toml").write_text(gate + VIDEO_CAMERA.format(width=192, height=144))
    code, _, err = skope(*call)
    assert (code, err.count("\n"), Path("r").exists()) == (2, 1, False)
    assert "site.toml: camera: image size: expected the aspect ratio of v, 96x64, got 192x144" in err
    Path("site.toml").write_text(gate + VIDEO_CAMERA.format(width=192, height=128))
    code, out, err = skope(*call)
    assert code == 0, err
    assert "site.toml: camera: camera of 192x128, scaled to the 96x64 of v" in out
    written = json.loads(Path("r/camera.json").read_text())
    assert (written["width"], written["height"]) == (96, 64)


def test_a_camera_file_in_a_site_file_keeps_the_part_of_the_footage_that_it_belongs_to(
    skope: Skope, random_run: Path
) -> None:
    """A file without `source` and `seconds`, or whose pose is not used, names no part."""
    numbered_video(Path("v.mp4"), 8)
    gate = '[[gates]]\nname = "g"\nline = [[0, 20], [9, 20]]\n'
    camera = Camera.looking((0, 0, 6), yaw=1.57, pitch_down=0.35, size=(96, 64), fov=1.05)
    part = {"source": "v", "seconds": [0.5, 0.7]}
    pose = "position = [0, 0, 6]\nlook_at = [0, 20, 0]\n"
    for name, calibrated, keys, kept in (
        ("whole", {"from": "vehicles"}, "", None), ("part", {"from": "vehicles", **part}, "", part),
        ("pose", part, pose, None), ("half", {"seconds": [0.5, 0.7]}, "", None),
    ):  # fmt: skip
        write_json(Path("camera.json"), {"width": 96, "height": 64, **camera.to_dict(), "calibrated": calibrated})
        Path("site.toml").write_text(f'{gate}[camera]\nfile = "camera.json"\n{keys}')
        code, _, err = skope(
            *("eval", "traffic", "v.mp4", "--checkpoint", random_run, "--device", "cpu", "--out", name)
        )
        assert code == 0, err
        assert coco.read(Path(name) / "seen" / "frames.json").info.get(CALIBRATED_FIELD) == kept


def test_people_on_foot_count_by_where_they_stand(tracks: AnnotationFile) -> None:
    """They have no heading while they may stand, and no length."""
    site = Path("site.toml")
    x, y, _ = (CAMERA.position + 8).tolist()
    line = [[x, y - 4], [x, y + 4]]
    site.write_text(f'[[gates]]\nname = "kerb"\nline = {line}\ndirections = ["over", "back"]\n')
    walk = straight(7, (x - 2, y), (1.25, 0.0), 3.8, step_s=0.2, category="pedestrian", class_name="pedestrian",
                    class_confidence=1.0, length=None, width=None)  # fmt: skip
    walk.heading[:3] = np.nan
    write_tracks(Path("t/tracks.csv"), [*read_tracks(Path("t/tracks.csv")), walk])
    report = door.measure_traffic("t", site)
    (one,) = report.crossings
    assert (one.trajectory.class_name, one.direction_name, one.trajectory.number) == ("pedestrian", "over", 7)
    assert one.time_s == pytest.approx(1.6)
    assert {row.class_name: row.count for row in report.counts if row.count} == {"all": 1, "pedestrian": 1}
    assert not report.headways
    text = Path("t/tracks.csv").read_text()
    Path("t/tracks.csv").write_text(text.replace("7,pedestrian,pedestrian", "7,horse,pedestrian"))
    with pytest.raises(UserError, match=r"tracks\.csv: line \d+: category: expected one of vehicle, bicycle"):
        door.measure_traffic("t", site)
    Path("t/tracks.csv").write_text(text.replace("7,pedestrian,pedestrian", "7,pedestrian,car"))
    with pytest.raises(UserError, match=r"line \d+: class: expected one of pedestrian, got 'car'"):
        door.measure_traffic("t", site)


def test_a_gate_near_the_edge_of_what_is_seen_is_warned_of(tmp_path: Path) -> None:
    """Tracks that begin 1 m before it may well have begun after it."""
    site = parse_site(tmp_path / "s.toml", b'[[gates]]\nname = "edge"\nline = [[0, -5], [0, 5]]\n')
    watch = Observation(times_s=np.arange(600) / 10, common_scale_sigma=0.0)
    near = [straight(k, (-1.0, 0), (9, 0), 3, begin_s=5.0 + 5 * k) for k in range(6)]
    far = [straight(k, (-20.0, 0), (9, 0), 5, begin_s=5.0 + 5 * k) for k in range(6)]
    warned = [line for line in measure(near, watch, site).notes if "'edge'" in line]
    assert warned == [
        "gate 'edge': 6 tracks begin or end within 2 m of it (6 crossings): many may be missed; move the gate to "
        "where vehicles are visible on both sides"
    ]
    assert not [line for line in measure(far, watch, site).notes if "'edge'" in line]


def test_a_gate_that_ends_where_people_walk_is_warned_of(tmp_path: Path) -> None:
    site = parse_site(tmp_path / "s.toml", b'[[gates]]\nname = "short"\nline = [[0, -5], [0, 5]]\n')
    watch = Observation(times_s=np.arange(600) / 10, common_scale_sigma=0.0)
    walk = {"category": "pedestrian", "class_name": "pedestrian", "sigma": 0.4}

    def warned(y: float) -> list[str]:
        walkers = [straight(k, (-6.0, y), (1.5, 0), 8, begin_s=5.0 + 5 * k, **walk) for k in range(4)]
        return [line for line in measure(walkers, watch, site).notes if "'short'" in line]

    assert warned(5.1) == [
        "gate 'short': 4 road users pass so close to an end of the gate that they may be inside or outside; move the "
        "ends to where no road user passes, for example to either edge of a pavement"
    ]
    assert not warned(2.0)
    assert not [line for line in warned(8.0) if "ends" in line]


def test_a_hand_count_gets_a_table_and_moves_intervals(skope: Skope, tracks: AnnotationFile) -> None:
    site_of(tracks)
    Path("h.csv").write_text(
        "gate,direction,class,begin,end,count\ngate,here,,10:14:58,10:15:03,4\ngate,away,car,0,5,0\n"
    )
    code, out, err = skope("eval", "traffic", "t", "--out", "r", "--manual-count", "h.csv")
    assert code == 0, err
    here, away = rows_of("r/manual_count.csv")
    assert (here["begin"], here["begin_s"], here["class"], here["manual_count"], here["count"], here["difference"]) == (
        *("2026-11-26T10:14:58+01:00", "0.000", "all", "4", "1", "-3"),
    )
    assert float(here["geh"]) == pytest.approx((2 * 2160**2 / 3600) ** 0.5, abs=1e-3)  # 1 and 4 in 5 s
    assert (away["geh"], away["contradicts"]) == ("0.000", "0")
    assert json.loads(Path("r/summary.json").read_text())["manual_counts"] == 2
    assert "manual count" in out
    assert skope("eval", "traffic", "t", "--out", "plain")[0] == 0
    assert not Path("plain/manual_count.csv").exists()
    tables = [rows_of(f"{folder}/counts.csv") for folder in ("r", "plain")]
    assert [row["count"] for row in tables[0]] == [row["count"] for row in tables[1]]
    assert [row["count_high_90"] for row in tables[0]] != [row["count_high_90"] for row in tables[1]]
    python = door.measure_traffic("t", "site.toml", manual_count="h.csv")
    assert [str(one.confidence_interval.high) for one in python.counts if one.confidence_interval] == [
        row["count_high_90"] for row in tables[0] if row["count_high_90"]
    ]
    code, _, err = skope("eval", "traffic", "t", "--out", "r")
    assert (code, "another run" in err) == (2, True)
    Path("h.csv").write_text("gate,direction,class,begin,end,count\ngate,here,,0,5,-2\n")
    code, _, err = skope("eval", "traffic", "t", "--out", "new", "--manual-count", "h.csv")
    assert (code, err.count("\n"), Path("new").exists()) == (2, 1, False)
    assert "h.csv: line 2: count: expected a whole number" in err
    code, _, err = skope("eval", "traffic", "a.mp4", "--out", "new", "--manual-count", "h.csv")
    assert (code, err.count("\n"), Path("new").exists()) == (2, 1, False)
    assert "--manual-count: expected a folder, got footage" in err


def test_files_of_other_programs_are_written_beside_the_report(skope: Skope, tracks: AnnotationFile) -> None:
    site = site_of(tracks)
    site.write_text(site.read_text() + 'edges = ["A", "B"]\n[world]\norigin = { longitude = 8.4, latitude = 49.0 }\n')
    names = ["excel", "geojson", "openlabel", "otanalytics", "parquet", "ssam", "sumo"]
    call = ["eval", "traffic", "t", "--site", str(site)]
    code, out, err = skope(*call, "--out", "r", "--export", ",".join(names))
    assert code == 0, err
    assert sorted(path.name for path in Path("r").iterdir() if path.is_dir()) == names
    assert all(any(path.name != "work.json" for path in Path("r", name).iterdir()) for name in names)
    assert f"wrote {Path('r', 'ssam', 'tracks.trj')}" in out
    assert skope(*call, "--out", "r", "--export", "excel")[0] == 0, "the same again"
    assert skope(*call, "--out", "r")[0] == 0


@pytest.mark.parametrize(
    ("also", "says"),
    [
        (
            "excel,word",
            "--export: expected some of excel, parquet, geojson, openlabel, otanalytics, ssam, sumo, got 'word'",
        ),
        ("geojson", "the site's position on the Earth is missing"),
        ("sumo", "no gate of the site has edges"),
    ],
)
def test_what_a_format_lacks_is_said_before_anything_is_written(
    skope: Skope, tracks: AnnotationFile, also: str, says: str
) -> None:
    code, _, err = skope("eval", "traffic", "t", "--site", str(site_of(tracks)), "--out", "new", "--export", also)
    assert (code, err.count("\n"), Path("new").exists()) == (2, 1, False)
    assert says in err
