"""Reports in the files of other programs, read by readers that know nothing of the writers."""

import json
import math
import re
import struct
import subprocess
import sys
from collections import Counter, defaultdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumolib

from skope.errors import UserError
from skope.site.site_file import SiteFile, parse_site
from skope.site.world import on_earth
from skope.traffic.exports.excel import write_excel
from skope.traffic.exports.geojson import write_geojson
from skope.traffic.exports.openlabel import write_openlabel
from skope.traffic.exports.parquet import write_parquet
from skope.traffic.exports.ssam import write_ssam
from skope.traffic.exports.sumo import write_sumo
from skope.traffic.measure import measure
from skope.traffic.report_tables import report_tables
from skope.traffic.traffic_report import TrafficReport
from tests.traffic.drives import drive, straight, watched

HEAD = 'time_zone = "Europe/Berlin"\nstart = 2026-11-26T10:00:00\n'
MARKS = (
    '[[gates]]\nname = "=SUM(A1)"\nline = [[0, -5], [0, 5]]\ndirections = ["in", "aus, \\"Süd\\""]\n'
    '[[lanes]]\nname = "lane"\nline = [[-50, 0], [50, 0]]\nwidth = 3.5\n'
    '[[zones]]\nname = "box"\npolygon = [[-2, -2], [-2, 2], [2, 2], [2, -2]]\n'
)
DEGREES = "[world]\norigin = { longitude = 8.4, latitude = 49.01 }\n"
GRID = '[world]\norigin = { easting = 456789.0, northing = 5427890.0 }\nutm_zone = "32N"\n'


def site_of(text: str) -> SiteFile:
    return parse_site(Path("site.toml"), text.encode())


def report_of(world: str = DEGREES, head: str = HEAD) -> TrafficReport:
    """Two cars that drive by, one of whom crosses the other's way, and somebody on foot."""
    walker = {"category": "pedestrian", "class_name": "pedestrian", "length": None, "width": None}
    tracks = [
        straight(1, (-30, 0), (10, 0), 6, height=1.5),
        straight(2, (0, -25), (0, 8), 6, begin_s=1.0),
        straight(3, (-4, 2), (1.2, 0), 7, begin_s=2.0, **walker),
    ]
    return measure(tracks, watched(12), site_of(head + world + MARKS))


# -------------------------------------------------------------------------------------------------- excel and parquet


def test_a_workbook_holds_the_tables_as_numbers_and_times(tmp_path: Path) -> None:
    from python_calamine import CalamineWorkbook

    report = report_of()
    (path,) = write_excel(tmp_path, report)
    book = CalamineWorkbook.from_path(path)
    tables = report_tables(report)
    assert book.sheet_names == ["summary", *(name for name in tables if name != "trajectories")]
    head, *rows = book.get_sheet_by_name("counts").to_python()
    assert head == list(tables["counts"].columns)
    want = [list(row) for row in tables["counts"].rows]
    assert len(rows) == len(want)
    for row, values in zip(rows, want, strict=True):
        for cell, value in zip(row, values, strict=True):
            if isinstance(value, datetime):
                assert cell == value.replace(tzinfo=None)
            elif value is None:
                assert cell == ""
            else:
                assert cell == value
    gates = {row[head.index("gate")] for row in rows}
    assert gates == {"=SUM(A1)"}  # text, which nothing works out
    _, *events = book.get_sheet_by_name("events").to_python()
    assert len(events) == len(list(report_tables(report)["events"].rows))
    summary = book.get_sheet_by_name("summary").to_python()
    expected = report.counts_total[0].confidence_interval
    assert expected
    assert ["=SUM(A1)", "in", "all", 2.0, expected.low, expected.high] in summary


def test_parquet_keeps_types_and_what_is_missing(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    report = report_of()
    paths = write_parquet(tmp_path, report)
    tables = report_tables(report)
    assert [path.stem for path in paths] == list(tables)
    for path in paths:
        read = parquet.read_table(path)
        assert read.column_names == list(tables[path.stem].columns)
        rows = list(tables[path.stem].rows)
        assert read.num_rows == len(rows)
        for name, values in zip(read.column_names, zip(*rows, strict=True), strict=False):
            for cell, value in zip(read[name].to_pylist(), values, strict=True):
                missing = value is None or (isinstance(value, float) and math.isnan(value))
                assert cell is None if missing else cell == value, (path, name)
    counts = parquet.read_table(tmp_path / "counts.parquet")
    assert str(counts.schema.field("count").type) == "int64"
    assert str(counts.schema.field("begin").type) == "timestamp[ms, tz=UTC]"


# ------------------------------------------------------------------------------------------------------------ geojson


@pytest.mark.parametrize("world", [DEGREES, GRID])
def test_on_the_map_everything_is_where_it_is_on_the_road(tmp_path: Path, world: str) -> None:
    from pyproj import Transformer

    report = report_of(world)
    (path,) = write_geojson(tmp_path, report)
    features = json.loads(path.read_text())["features"]
    kinds = [feature["properties"]["kind"] for feature in features]
    assert kinds == ["gate", "lane", "zone", "track", "track", "track", *["conflict"] * len(report.conflicts.conflicts)]
    assert report.conflicts.conflicts
    # Metres of the plane around the origin, by PROJ.
    if world == GRID:
        to_metres, origin = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True), (456789.0, 5427890.0)
    else:
        local = "+proj=ortho +lon_0=8.4 +lat_0=49.01 +ellps=WGS84"
        to_metres, origin = Transformer.from_crs("EPSG:4326", local, always_xy=True), (0.0, 0.0)

    def metres(degrees: Any) -> Any:
        return np.stack(to_metres.transform(*np.array(degrees).T), axis=-1) - origin

    gate, lane, zone, first = features[:4]
    assert metres(gate["geometry"]["coordinates"]) == pytest.approx(np.array([[0, -5], [0, 5]]), abs=0.02)
    assert metres(lane["geometry"]["coordinates"]) == pytest.approx(np.array([[-50, 0], [50, 0]]), abs=0.02)
    ring = metres(zone["geometry"]["coordinates"][0])
    assert ring[0] == pytest.approx(ring[-1])
    x, y = ring.T
    assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2 == pytest.approx(16, abs=0.1)  # counter-clockwise
    assert metres(first["geometry"]["coordinates"])[[0, -1]] == pytest.approx(np.array([[-30, 0], [30, 0]]), abs=0.02)
    assert len(first["properties"]["times_s"]) == len(first["geometry"]["coordinates"])
    told = [one["properties"] for one in features if one["properties"]["kind"] == "track"]
    assert [one["otc_class"] for one in told] == ["car", "car", "pedestrian"]
    assert [one.get("length_bin") for one in told] == ["short", "short", None]
    assert told[0]["length_bin_probability"] > 0.98
    counts = gate["properties"]["counts"]
    assert {name: row["all"]["count"] for name, row in counts.items()} == {"in": 2, 'aus, "Süd"': 0}
    assert all(row["vehicle"]["low"] <= row["vehicle"]["count"] <= row["vehicle"]["high"] for row in counts.values())


@pytest.mark.parametrize(("longitude", "latitude"), [(8.4, 49.0), (-71.1, -33.4), (179.99, 5.0), (12.0, 78.0)])
def test_degrees_and_back(longitude: float, latitude: float) -> None:
    site = site_of(f"[world]\norigin = {{ longitude = {longitude}, latitude = {latitude} }}\n")
    from skope.camera.geographic import local_metres

    places = np.array([[0.0, 0.0], [120.0, -80.0], [-2000.0, 3000.0]])
    turn, tilt = on_earth(site.world, places).T
    assert local_metres(turn, tilt, (longitude, latitude)) == pytest.approx(places, abs=1e-4)


@pytest.mark.parametrize(
    ("world", "says"),
    [
        ("", "position on the Earth is missing"),
        (DEGREES + 'axes = "x south, y east"\n', "world.axes"),
        (GRID + "epsg = 25832\n", "world.epsg: 25832 is not the grid of UTM zone 32N"),
        ('[world]\norigin = { easting = 5e7, northing = 5e7 }\nutm_zone = "32N"\n', "too far from UTM zone 32N"),
    ],
)
def test_what_is_nowhere_on_the_earth_is_refused(tmp_path: Path, world: str, says: str) -> None:
    with pytest.raises(UserError, match=says):
        write_geojson(tmp_path, report_of(world))
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------------------------------------------- openlabel


def test_openlabel_by_its_checker(tmp_path: Path) -> None:
    from openlabel_checker import check_file

    report = report_of()
    (path,) = write_openlabel(tmp_path, report)
    found = check_file(str(path))
    issues = [issue for outcome in found.outcomes for issue in outcome.issues]
    assert not issues
    document = json.loads(path.read_text())["openlabel"]
    assert set(document["objects"]) == {"1", "2", "3"}
    assert len(document["frames"]) == len(report.observation.times_s)
    (body,) = document["frames"]["30"]["objects"]["1"]["object_data"]["cuboid"]
    assert body["val"] == pytest.approx([0, 0, 0.75, 0, 0, 0, 1, 4, 2, 1.5], abs=1e-6)
    (north,) = document["frames"]["30"]["objects"]["2"]["object_data"]["cuboid"]
    assert north["val"][3:7] == pytest.approx([0, 0, math.sin(math.pi / 4), math.cos(math.pi / 4)], abs=1e-6)
    measured = [
        document["frames"]["30"]["objects"][number]["object_data"]["cuboid"][0]["attributes"]["boolean"][0]["val"]
        for number in "123"
    ]
    assert measured == [True, False, False]


# --------------------------------------------------------------------------------------------------------------- sumo

NETWORK = Path("examples/own_road/junction.net.xml")
ARMS = """
[[gates]]
name = "west"
line = [[-10, 5], [-10, -5]]
directions = ["to the west", "from the west"]
edges = ["-10#0", "10#0"]
[[gates]]
name = "east"
line = [[10, -5], [10, 5]]
directions = ["to the east", "from the east"]
edges = ["10#1", "-10#1"]
[[gates]]
name = "south"
line = [[-5, -10], [5, -10]]
directions = ["to the south", "from the south"]
edges = ["11", "-11"]
[traffic]
interval_minutes = 5
"""
CORNERS = {"west": (-25.0, 0.0), "east": (25.0, 0.0), "south": (0.0, -25.0)}
DRIVEN = {("west", "east"): 7, ("west", "south"): 4, ("east", "west"): 5, ("south", "east"): 3}


def junction_report(head: str = HEAD) -> TrafficReport:
    """Cars, one lorry among them, through a junction in five minutes, 12 s apart, and somebody on foot."""
    tracks = []
    for origin, destination in (pair for pair, number in DRIVEN.items() for _ in range(number)):
        corners = np.array([CORNERS[origin], (0.0, 0.0), CORNERS[destination]])
        along = np.linspace(0, 2, 51)
        places = np.stack([np.interp(along, range(3), corners[:, k]) for k in range(2)], axis=1)
        number = len(tracks) + 1
        times = 12.0 * number + np.arange(51) * 0.1
        tracks.append(drive(number, places, times, class_name="lorry" if number == 1 else "car"))
    walker = {"category": "pedestrian", "class_name": "pedestrian"}
    tracks.append(straight(99, (-14, 1), (1.2, 0), 7, begin_s=2.0, **walker))
    return measure(tracks, watched(299.9), site_of(head + ARMS))


def test_sumos_tools_take_the_counts(tmp_path: Path) -> None:
    """routeSampler makes routes that give the counts back, by its own GEH; flowrouter finds the flows."""
    report = junction_report()
    assert (
        sum(
            one.count or 0
            for one in report.turning
            if (one.destination, one.class_name) == (("east", "to the east"), "vehicle")
        )
        == 10
    )
    written = write_sumo(tmp_path, report)
    pairs = [("10#0", "10#1"), ("10#0", "11"), ("-10#1", "-10#0"), ("-10#1", "11"), ("-11", "10#1"), ("-11", "-10#0")]
    routes = "".join(f'<route id="{k}" edges="{a} {b}"/>' for k, (a, b) in enumerate(pairs))
    (tmp_path / "routes.xml").write_text(f"<routes>{routes}</routes>")
    out, off = tmp_path / "sampled.xml", tmp_path / "off.xml"
    words = ["-r", str(tmp_path / "routes.xml"), "--turn-files", str(written[0]), "--edgedata-files", str(written[1])]
    run_tool("routeSampler.py", *words, "-o", str(out), "--mismatch-output", str(off), "--optimize", "full")
    start_time = 10 * 3600.0
    sampled = Counter(
        tuple(vehicle.route[0].edges.split())
        for vehicle in sumolib.xml.parse(str(out), "vehicle")
        if start_time <= float(vehicle.depart) < start_time + 300
    )
    ways = {"west": ("10#0", "-10#0"), "east": ("-10#1", "10#1"), "south": ("-11", "11")}
    assert sampled == {(ways[a][0], ways[b][1]): number for (a, b), number in DRIVEN.items()}
    text = off.read_text()
    assert text.count("deficit=") >= len(DRIVEN)
    assert not re.findall(r'deficit="(?!0")', text)
    run_tool(
        "detector/flowrouter.py",
        *("-n", str(NETWORK), "-d", str(written[2]), "-f", str(written[3]), "-i", "5", "-b", "600"),
        *("-o", str(tmp_path / "routed.xml"), "-e", str(tmp_path / "flows.xml"), "--revalidate-detectors"),
    )
    routed = {route.id: route.edges for route in sumolib.xml.parse(str(tmp_path / "routed.xml"), "route")}
    entering: Counter[str] = Counter()
    for flow in sumolib.xml.parse(str(tmp_path / "flows.xml"), "flow"):
        entering[routed[flow.route].split()[0]] += int(flow.number)
    assert entering == {"10#0": 10, "-10#1": 5, "-11": 3}  # it takes light vehicles unless it is told otherwise
    rows = written[3].read_text().splitlines()
    assert rows[0] == "Detector;Time;qPKW;qLKW;vPKW;vLKW"
    assert rows[1 : 1 + 6][1].startswith("10#0;600;10;1;")


def run_tool(name: str, *words: str) -> None:
    sumo = pytest.importorskip("sumo")
    tool = Path(sumo.SUMO_HOME) / "tools" / name
    done = subprocess.run([sys.executable, str(tool), *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_who_has_no_edges_is_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no gate of the site has edges"):
        write_sumo(tmp_path, report_of())
    with pytest.raises(UserError, match=r"edges: both are 'A'"):
        site_of('[[gates]]\nname = "g"\nline = [[0, 0], [1, 1]]\nedges = ["A", "A"]\n')


# --------------------------------------------------------------------------------------------------------------- ssam


def read_trj(path: Path) -> tuple[tuple[Any, ...], dict[float, list[tuple[Any, ...]]]]:
    """A reader by FHWA's description of the format: dimensions, and the vehicles of each time."""
    data = path.read_bytes()
    assert data[0] == 0
    assert data[1:2] == b"L"
    version, z = struct.unpack_from("<fB", data, 2)
    assert (version, z) == (3.0, 1)
    at, dimensions, steps, now = 7, (), defaultdict(list), math.nan
    while at < len(data):
        kind, at = data[at], at + 1
        if kind == 1:
            dimensions, at = struct.unpack_from("<Bf4i", data, at), at + 21
        elif kind == 2:
            (now,), at = struct.unpack_from("<f", data, at), at + 4
            steps[now] = []
        else:
            assert kind == 3
            steps[now].append(struct.unpack_from("<iiB8f2f", data, at))
            at += 49
    return dimensions, steps


def test_trj_by_a_reader_of_the_specification(tmp_path: Path) -> None:
    report = report_of()
    (path,) = write_ssam(tmp_path, report)
    (units, scale, *area), steps = read_trj(path)
    assert (units, scale) == (1, 1.0)
    west, south, east, north = area
    assert list(steps) == pytest.approx(np.arange(0, 12.05, 0.1).tolist(), abs=1e-4)
    by_vehicle = defaultdict(list)
    for time_s, vehicles in steps.items():
        for one in vehicles:
            by_vehicle[one[0]].append((time_s, one))
    assert set(by_vehicle) == {1, 2, 3}
    for _, one in (row for rows in by_vehicle.values() for row in rows):
        assert west <= one[3] <= east
        assert south <= one[4] <= north
    first = by_vehicle[1]
    assert [time_s for time_s, _ in first] == pytest.approx(np.arange(0, 6.05, 0.1).tolist(), abs=1e-4)
    for time_s, (_, _, _, fx, fy, rx, ry, length, width, speed, acceleration, fz, rz) in first:
        # The corner that places count from is not told: differences are.
        assert fx - first[0][1][3] == pytest.approx(10 * time_s, abs=1e-3)
        assert (fx - rx, fy - ry) == pytest.approx((4.0, 0.0), abs=1e-4)
        assert (length, width, speed, acceleration) == pytest.approx((4, 2, 10, 0), abs=1e-3)
        assert (fz, rz) == (0, 0)
    (_, north_bound), (_, walker) = by_vehicle[2][0], by_vehicle[3][0]
    # The first car at 1 s is at (-20, 0), the second one at (0, -25); places are those of the middle of the bumpers.
    at_one = first[10][1]
    assert (north_bound[3] - at_one[3], north_bound[4] - at_one[4]) == pytest.approx((18.0, -23.0), abs=1e-3)
    assert (walker[7], walker[8]) == pytest.approx((0.5, 0.6))
