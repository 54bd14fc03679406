"""Tracks and gates for OTAnalytics: the files by their description, and what that program itself counts in them.

OTAnalytics is a program under the GPL with requirements of its own: it runs as a command of an environment that is made
here, and is no part of skope.
"""

import bz2
import csv
import json
import subprocess
import venv
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.errors import UserError
from skope.site.site_file import SiteFile, parse_site, read_site
from skope.tracks.track import Track
from skope.traffic.exports.otanalytics import write_otanalytics
from skope.traffic.image_counts import count_in_image
from skope.traffic.measure import measure
from skope.traffic.observation import Observation
from skope.traffic.otc_classes import OTC_CLASSES
from skope.traffic.traffic_report import TrafficReport
from tests.sightings import CAMERA
from tests.traffic.drives import along_x, drive, straight, watched
from tests.traffic.test_traffic_command import followed, site_of, tracks  # noqa: F401

Skope = Callable[..., tuple[int, str, str]]

BENT = """[camera]
size = [1280, 720]
fov_deg = 80.0
position = [0, -70, 28]
yaw_deg = 90.0
pitch_deg = 22.0
distortion = { model = "brown", coefficients = [-0.15, 0.01, 0.0, 0.0] }
"""
CROSSROADS = """start = 2026-11-26T10:13:00+01:00
[traffic]
interval_minutes = 5
""" + "".join(
    f'[[gates]]\nname = "{name}"\nline = {line}\n'
    for name, line in {
        "east": [[15.37, -8], [15.37, 8]],
        "north": [[-8, 15.37], [8, 15.37]],
        "west": [[-15.37, -8], [-15.37, 8]],
        "south": [[-8, -15.37], [8, -15.37]],
    }.items()
)
START = datetime.fromisoformat("2026-11-26T10:13:00+01:00").timestamp()
ARMS = ("east", "north", "west", "south")


def site(text: str) -> SiteFile:
    return parse_site(Path("site.toml"), text.encode())


def read_ottrk(path: Path) -> Any:
    return json.loads(bz2.decompress(path.read_bytes()))


def exported(folder: Path, report: TrafficReport, where: SiteFile) -> Path:
    folder.mkdir()
    write_otanalytics(folder, report, where.camera.camera if where.camera else None)
    return folder


def turning(number: int, arms: tuple[int, int], begin_s: float, speed: float, class_name: str) -> Track:
    """Somebody who drives on the right from 40 m out on one arm to 40 m out on another one, or turns around."""
    ahead = [np.array([np.cos(k * np.pi / 2), np.sin(k * np.pi / 2)]) for k in arms]
    begin, end = (40 * one + side * 2.2 * np.array([-one[1], one[0]]) for one, side in zip(ahead, (1, -1), strict=True))
    middle = -30 * ahead[0] if arms[0] == arms[1] else np.zeros(2)
    share = np.linspace(0, 1, round(80 / speed * 10))[:, None]
    places = (1 - share) ** 2 * begin + 2 * share * (1 - share) * middle + share**2 * end
    others = {"category": "bicycle", "length": None, "width": None} if class_name == "bicycle" else {}
    times = begin_s + np.arange(len(places)) / 10
    return drive(number, places, times, class_name=class_name, **others)


def crossroads(rng: np.random.Generator) -> list[Track]:
    """Ten minutes with all movements, and some who turn around."""
    classes = ("car", "car", "car", "van", "lorry", "bus", "bicycle")
    return [
        turning(
            number,
            (int(rng.integers(4)), int(rng.integers(4))),
            begin_s=round(float(rng.uniform(0, 580)), 1),
            speed=float(rng.uniform(5, 13)),
            class_name=classes[int(rng.integers(len(classes)))],
        )
        for number in range(1, 121)
    ]


# ----------------------------------------------------------------------------------------------------------- the files


def test_the_command_writes_what_it_counted(skope: Skope, tracks: Any) -> None:  # noqa: F811
    """Every detection is where the camera sees the ground under the vehicle's middle, at the frame's own time."""
    where = site_of(tracks)
    assert skope("eval", "traffic", "t", "--out", "r", "-q")[0] == 0
    assert not Path("r/otanalytics").exists()
    code, out, err = skope("eval", "traffic", "t", "--out", "r", "--export", "otanalytics")
    assert code == 0, err
    assert "wrote r/otanalytics/plan.ottrk" in out
    names = {"plan.ottrk", "plan.otflow", "image.ottrk", "image.otflow", "work.json"}
    assert {path.name for path in Path("r/otanalytics").iterdir()} == names, "the tracks know their camera"

    other = CAMERA.K * [[1.5], [1.5], [1.0]]  # that of the site is not the one that the tracks were made with
    camera = {"size": [CAMERA.width, CAMERA.height], "K": other.tolist()}
    camera["T_camera_world"] = CAMERA.T_camera_world.tolist()
    text = "\n".join(["[camera]", *(f"{key} = {value}" for key, value in camera.items())])
    where.write_text(f"{where.read_text()}{text}\n")
    assert skope("eval", "traffic", "t", "--out", "q", "--export", "otanalytics", "-q")[0] == 0
    assert {path.name for path in Path("q/otanalytics").iterdir()} == names
    document = read_ottrk(Path("q/otanalytics/image.ottrk"))
    rows = document["data"]["detections"]
    with Path("t/tracks.csv").open(newline="") as file:
        driven = [
            row
            for row in csv.DictReader(file)
            if "never_moved" not in row["flags"]
            and CAMERA.inside(CAMERA.project([*map(float, (row["x"], row["y"])), 0])[0])
        ]
    assert {row["track-id"] for row in rows} == {int(row["track"]) for row in driven}
    assert len(rows) == len(driven)
    start = datetime.fromisoformat("2026-11-26T10:14:58+01:00").timestamp()
    for row, own in zip(rows, driven, strict=True):
        (pixel,), _, _ = CAMERA.project([[float(own["x"]), float(own["y"]), 0.0]])
        assert (row["x"], row["y"]) == pytest.approx(tuple(pixel), abs=1e-3)
        assert (row["w"], row["h"], row["class"]) == (0, 0, "car")
        assert row["occurrence"] == pytest.approx(start + float(own["time_s"]), abs=1e-4)
        assert row["frame"] == 1 + int(own["frame"])
    flow = json.loads(Path("q/otanalytics/image.otflow").read_text())
    (section,) = flow["sections"]
    (gate,) = read_site(where).gates
    assert [(p["x"], p["y"]) for p in section["coordinates"]] == [
        pytest.approx(tuple(CAMERA.project([*end, 0.0])[0]), abs=1e-3) for end in gate.line
    ]

    before = {path.name: path.read_bytes() for path in Path("q/otanalytics").iterdir()}
    assert skope("eval", "traffic", "t", "--out", "q", "--export", "otanalytics", "-q")[0] == 0
    assert {path.name: path.read_bytes() for path in Path("q/otanalytics").iterdir()} == before


def test_another_camera_is_other_work(skope: Skope, tracks: Any) -> None:  # noqa: F811
    """The site file is the same: it names a file that has changed."""
    where = site_of(tracks)
    where.write_text(f'{where.read_text()}[camera]\nfile = "camera.json"\n')
    told = {**CAMERA.to_dict(), "width": CAMERA.width, "height": CAMERA.height}
    Path("camera.json").write_text(json.dumps(told))
    call = ("eval", "traffic", "t", "--out", "r", "-q")
    code, _, err = skope(*call, "--export", "otanalytics")
    assert code == 0, err
    before = {path: path.read_bytes() for path in Path("r").rglob("*.*")}
    told["K"][0][0] += 5
    Path("camera.json").write_text(json.dumps(told))
    code, _, err = skope(*call, "--export", "otanalytics")
    assert (code, "r/otanalytics holds the output of another run" in err, err.count("\n")) == (2, True, 1)
    assert {path: path.read_bytes() for path in Path("r").rglob("*.*")} == before
    assert skope(*call)[0] == 0


def test_tracks_have_all_that_the_format_asks_for(tmp_path: Path) -> None:
    where = site(CROSSROADS + BENT)
    report = measure(crossroads(np.random.default_rng(1)), watched(600), where)
    folder = exported(tmp_path / "ot", report, where)
    for name in ("image", "plan"):
        document = read_ottrk(folder / f"{name}.ottrk")
        metadata, rows = document["metadata"], document["data"]["detections"]
        assert (metadata["ottrk_version"], metadata["otdet_version"]) == ("1.1", "1.4")
        video = metadata["video"]
        assert (video["filename"], video["filetype"]) == ("skope_footage", ".mp4")
        assert (video["number_of_frames"], video["recorded_fps"]) == (6001, pytest.approx(10))
        assert video["length"] == "0:10:01"
        assert video["recorded_start_date"] == START
        assert sorted(metadata["detection"]["model"]["classes"].values()) == sorted(OTC_CLASSES.values())
        assert {"tracking_run_id", "frame_group"} <= metadata["tracking"].keys()
        needed = {"class", "confidence", "x", "y", "w", "h", "frame", "occurrence", "interpolated-detection"}
        assert all((needed | {"track-id", "first", "finished"}) <= row.keys() for row in rows)
        assert {row["class"] for row in rows} == {"car", "delivery_van", "truck", "bus", "bicyclist"}
        assert sum(row["first"] for row in rows) == sum(row["finished"] for row in rows) == 120
        assert all(0 <= row["x"] <= video["width"] and 0 <= row["y"] <= video["height"] for row in rows)
        assert all(row["frame"] == 1 + round(10 * (row["occurrence"] - video["recorded_start_date"])) for row in rows)
    told = read_ottrk(folder / "plan.ottrk")["metadata"]["georeference"]
    bounds, size = told["geo_bounds"], told["birds_eye_view_size"]
    scale = (bounds["max_x"] - bounds["min_x"]) / (size["width"] - 2 * told["padding"])
    assert told["crs"].startswith("LOCAL_CS")
    for row in rows:
        assert row["geo_x"] == pytest.approx(bounds["min_x"] + row["x"] * scale, abs=1e-3)
        assert row["geo_y"] == pytest.approx(bounds["max_y"] - row["y"] * scale, abs=1e-3)
    assert len(rows) == sum(len(one.times_s) for one in report.trajectories)


def test_gates_are_bent_as_the_camera_bends_them_and_flows_are_pairs(tmp_path: Path) -> None:
    """Any point of the gate on the road lies on the line in the image."""
    from shapely import LineString, Point

    text = CROSSROADS + BENT + '[[gates]]\nname = "drawn"\npixels = [[10, 20], [30, 40]]\nline = [[1, 2], [3, 4]]\n'
    where = site(text + '[[gates]]\nname = "behind"\nline = [[30, -90], [30, 30]]\n')
    report = measure([turning(1, (1, 1), 0, 8, "car")], watched(30), where)
    flow = json.loads((exported(tmp_path / "ot", report, where) / "image.otflow").read_text())
    lines = {one["name"]: [(p["x"], p["y"]) for p in one["coordinates"]] for one in flow["sections"]}
    assert where.camera is not None
    for gate in where.gates:
        if gate.pixels:
            continue
        a, b = np.array(gate.line)
        spots = a + np.linspace(0, 1, 200)[:, None] * (b - a)
        pixels, _, valid = where.camera.camera.project(np.column_stack([spots, np.zeros(200)]))
        inside = valid & ((pixels >= 0) & (pixels <= [1280, 720])).all(axis=1)
        assert inside.all() == (gate.name != "behind")
        away = [LineString(lines[gate.name]).distance(Point(*pixel)) for pixel in pixels[inside]]
        assert max(away) < 0.1, gate.name
    assert len(lines["behind"]) > 2
    assert lines["drawn"] == [(10, 20), (30, 40)]
    assert {one["type"] for one in flow["sections"]} == {"line"}
    names = {one["id"]: one["name"] for one in flow["sections"]}
    pairs = [(names[one["start"]], names[one["end"]]) for one in flow["flows"]]
    own = (*ARMS, "drawn", "behind")
    assert pairs == [(a, b) for a in own for b in own if a != b or a == "north"]
    assert len({one["id"] for one in flow["flows"]}) == len(pairs)


def test_a_gate_of_an_undistorted_image_has_two_ends_and_one_that_is_not_seen_has_none(tmp_path: Path) -> None:
    text = CROSSROADS + BENT.replace("distortion", "# ") + '[[gates]]\nname = "far"\nline = [[0, -99], [5, -99]]\n'
    where = site(text)
    flow = json.loads((exported(tmp_path / "o", measure([], watched(9), where), where) / "image.otflow").read_text())
    assert [(one["name"], len(one["coordinates"])) for one in flow["sections"]] == [(name, 2) for name in ARMS]
    assert read_ottrk(tmp_path / "o" / "image.ottrk")["data"]["detections"] == []


def test_places_of_a_map_are_those_of_the_map(tmp_path: Path) -> None:
    where = site(
        '[world]\norigin = { easting = 456789.0, northing = 5427890.5 }\nutm_zone = "32N"\n'
        '[[gates]]\nname = "g"\nline = [[0, -5], [0, 5]]\n'
    )
    report = measure([straight(7, (-20.0, 1.25), (9.0, 0.0), 4)], watched(9), where)
    document = read_ottrk(exported(tmp_path / "o", report, where) / "plan.ottrk")
    first = document["data"]["detections"][0]
    assert (first["geo_x"], first["geo_y"]) == (456769.0, 5427891.75)
    assert document["metadata"]["georeference"]["crs"] == "EPSG:32632"
    assert document["metadata"]["video"]["recorded_start_date"] == 0, "nothing says when it began"


def test_who_never_moves_is_left_out_and_long_tracks_are_thinned(tmp_path: Path) -> None:
    """OTAnalytics would drop a track of more than 12 000 detections."""
    where = site('[[gates]]\nname = "g"\nline = [[0, -5], [0, 5]]\n[traffic]\nclasses = ["car"]\n')
    x = np.concatenate([np.full(13_000, -20.0), np.linspace(-20, 20, 100)])
    parked = straight(2, (3.0, 3.0), (0.0, 0.0), 5, flags=("never_moved",))
    report = measure(
        [along_x(1, x), parked, straight(3, (-9.0, 2.0), (5.0, 0.0), 4, class_name="bus")], watched(1400), where
    )
    rows = read_ottrk(exported(tmp_path / "o", report, where) / "plan.ottrk")["data"]["detections"]
    assert {row["track-id"] for row in rows} == {1}
    assert len(rows) == 6550


def test_without_metres_places_and_gates_are_those_of_the_image(tmp_path: Path) -> None:
    where = site('[[gates]]\nname = "g"\npixels = [[240, 200], [240, 60]]\n')
    track = drive(4, [(100.0 + 20 * k, -140.0) for k in range(12)], sigma=1.0, class_name="unknown")
    watch = Observation(times_s=np.arange(12) / 10, source="otcamera01_bridge.mp4")
    (folder,) = {path.parent for path in write_otanalytics(tmp_path, count_in_image([track], watch, where))}
    document = read_ottrk(folder / "image.ottrk")
    assert [(row["x"], row["y"], row["class"]) for row in document["data"]["detections"][:2]] == [
        (100, 140, "other"), (120, 140, "other")
    ]  # fmt: skip
    assert document["metadata"]["video"]["filename"] == "otcamera01_bridge", "as OTVision names footage"
    (section,) = json.loads((folder / "image.otflow").read_text())["sections"]
    assert section["coordinates"] == [{"x": 240, "y": 200}, {"x": 240, "y": 60}]
    assert {path.name for path in folder.iterdir()} == {"image.ottrk", "image.otflow"}


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    where = site(CROSSROADS)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file"):
        write_otanalytics(tmp_path / "file", measure([], watched(9), where))


# --------------------------------------------------------------------------------------------- what OTAnalytics counts

_NEEDS = (
    *("aioboto3", "av", "customtkinter", "fastapi", "ijson", "matplotlib", "more-itertools", "nicegui", "numpy"),
    *("opencv-python-headless", "openpyxl", "pandas", "pillow", "polars", "pyarrow", "requests", "seaborn", "shapely"),
    *("starlette", "tqdm", "ujson", "uvicorn"),
)


@pytest.fixture(scope="module")
def otanalytics(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment of its own with OTAnalytics; it asks for Python 3.12, and runs on 3.11 too."""
    home = tmp_path_factory.mktemp("otanalytics")
    venv.create(home, with_pip=True)
    install = [home / "bin" / "pip", "install", "--quiet", "--disable-pip-version-check"]
    for words in (["--no-deps", "--ignore-requires-python", "otanalytics==0.7.5"], list(_NEEDS)):
        done = subprocess.run([*install, *words], capture_output=True, text=True)
        if done.returncode:
            pytest.skip(f"OTAnalytics cannot be installed here: {done.stderr.strip().splitlines()[-1][:200]}")
    return home / "bin" / "python"


def counted_by(python: Path, tracks_file: Path, minutes: int) -> tuple[list[dict[str, str]], Counter[Any]]:
    """OTAnalytics' events of sections, and its counts by when an interval begins, flow and class.

    It keeps what it has read beside the tracks and never reads these again: `tracks_file` is in a folder of this call.
    """
    out = tracks_file.parent / f"out_{tracks_file.stem}"
    out.mkdir()
    words = ["--cli", "--ottrks", tracks_file, "--otflow", tracks_file.with_suffix(".otflow"), "--save-dir", out]
    words += ["--save-name", "x", "--event-formats", "csv", "--count-intervals", str(minutes)]
    done = subprocess.run(
        [python, "-m", "OTAnalytics", *words], cwd=tracks_file.parent, env={}, capture_output=True, text=True
    )
    assert (out / f"x.counts_{minutes}min.csv").is_file(), done.stdout[-2000:] + done.stderr[-2000:]

    def rows(name: str) -> list[dict[str, str]]:
        with (out / name).open(encoding="utf-8-sig", newline="") as file:
            return list(csv.DictReader(file))

    counts = Counter[Any]()
    for row in rows(f"x.counts_{minutes}min.csv"):
        key = (row["start time"], row["from section"], row["to section"], row["classification"])
        counts[key] += int(row["count"])
    return [row for row in rows("x.events.csv") if row["event_type"] == "section-enter"], +counts


def seconds_of(text: str) -> float:
    """Seconds since 1970 of a time as OTAnalytics writes it, UTC."""
    return datetime.fromisoformat(f"{text}+00:00").timestamp()


@pytest.mark.slow
@pytest.mark.parametrize(("view", "off_s"), [("plan", 0.001), ("image", 0.05)])
def test_otanalytics_counts_what_we_count(otanalytics: Path, tmp_path: Path, view: str, off_s: float) -> None:
    """At a crossroads, by gate, movement, class and interval; between frames it takes the image to be linear."""
    where = site(CROSSROADS + BENT)
    report = measure(crossroads(np.random.default_rng(2)), watched(600), where)
    assert len(report.crossings) == 240
    events, counts = counted_by(otanalytics, exported(tmp_path / "ot", report, where) / f"{view}.ottrk", 5)
    told = [
        (row["road_user_id"].rsplit("#", 1)[1], row["section_name"], seconds_of(row["interpolated_occurrence"]))
        for row in events
    ]
    own = [(str(one.trajectory.number), one.gate, START + one.time_s) for one in report.crossings]
    assert Counter(one[:2] for one in told) == Counter(one[:2] for one in own)
    for theirs, ours in zip(sorted(told), sorted(own), strict=True):
        assert theirs[2] == pytest.approx(ours[2], abs=off_s)
    expected = Counter(
        (
            datetime.fromtimestamp((START + one.time_s) // 300 * 300, tz=UTC).strftime("%Y-%m-%d %H:%M:%S"),
            one.origin.gate,
            one.destination.gate,
            OTC_CLASSES[one.origin.trajectory.class_name],
        )
        for one in report.movements
        if one.origin is not None and one.destination is not None
    )
    assert counts == expected
    assert sum(counts.values()) == 120
    assert any(key[1] == key[2] for key in counts), "some turn around"


def case(number: int, x: Sequence[float], **others: Any) -> Track:
    """A car along x in a street of its own, 50 m from the next one."""
    track = along_x(number, x, **others)
    return drive(number, track.xy + [0.0, 50.0 * number], track.times_s)


@pytest.mark.slow
def test_where_otanalytics_counts_otherwise_is_known(otanalytics: Path, tmp_path: Path) -> None:
    """It counts every meeting of a track with a gate, and of the flows of a track the one that takes longest."""
    streets = {1: (0.0,), 2: (0.0, 10.3), 3: (0.0,), 4: (0.0, 5.3, 10.3)}
    text = "".join(
        f'[[gates]]\nname = "{street}{"abc"[k]}"\nline = [[{x}, {50 * street - 5}], [{x}, {50 * street + 5}]]\n'
        for street, gates in streets.items()
        for k, x in enumerate(gates)
    )
    where = site(text)
    away, on = np.arange(-9.5, -0.4, 1.0), np.arange(0.5, 15, 1.0)
    jitter = [0.2, -0.2, 0.1, -0.1, 0.2, -0.2]
    found = [
        case(1, np.arange(-9.0, 10, 1.0)),  # a detection exactly on the gate
        case(2, [*away, *jitter, *on]),  # jitter on the first of two gates
        case(3, [*away, 0.7, 0.8, -0.5, *away[::-1]]),  # a box that jumps over the gate and back
        case(4, [*away, *on]),  # three gates in a row
    ]
    report = measure(found, watched(30), where)
    assert Counter(one.gate for one in report.crossings) == Counter(["1a", "2a", "2b", "4a", "4b", "4c"])
    events, counts = counted_by(otanalytics, exported(tmp_path / "ot", report, where) / "plan.ottrk", 15)
    assert Counter(row["section_name"] for row in events) == {
        "1a": 2, "2a": 7, "2b": 1, "3a": 2, "4a": 1, "4b": 1, "4c": 1
    }  # fmt: skip
    moved = {(one.origin.gate, one.destination.gate) for one in report.movements if one.origin and one.destination}
    assert moved == {("2a", "2b"), ("4a", "4b"), ("4b", "4c")}
    assert {key[1:3]: number for key, number in counts.items()} == {("2a", "2b"): 1, ("4a", "4c"): 1}
