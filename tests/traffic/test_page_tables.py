"""Tables of the page, crossings that are left out, and gates on the empty road, of made-up tracks."""

import re
from html import unescape
from pathlib import Path

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera
from skope.site.site_file import parse_site
from skope.traffic.image_counts import count_in_image
from skope.traffic.left_out_crossings import left_out_crossings
from skope.traffic.measure import measure
from skope.traffic.page.gates_in_picture import gates_in_picture
from skope.traffic.page.page import traffic_page
from skope.traffic.road_picture import (
    EmptyRoadPicture,
    empty_road_picture,
    read_empty_road_picture,
    write_empty_road_picture,
)
from skope.traffic.traffic_report import TrafficReport
from tests.traffic.drives import straight, watched
from tests.traffic.test_exports import HEAD, junction_report

ONE_GATE = '[[gates]]\nname = "g"\nline = [[0, -5], [0, 5]]\ndirections = ["out", "in"]\n'
IMAGE_GATE = '[[gates]]\nname = "g"\npixels = [[100, 40], [100, 140]]\ndirections = ["left", "right"]\n'


def rows_below(page: str, title: str) -> list[list[str]]:
    """Cells of the first table after a title, without their markup."""
    found = re.search(r"<table.*?</table>", page[page.index(title) :], re.DOTALL)
    assert found
    rows = re.findall(r"<tr>(.*?)</tr>", found[0], re.DOTALL)
    return [[text_of(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)] for row in rows]


def text_of(markup: str) -> str:
    return unescape(re.sub("<[^>]*>", "", markup))


def report_of(numbers: list[int], **settings: object) -> TrafficReport:
    """Cars and every fourth time a lorry through one gate, as many in each minute as the list says."""
    tracks = []
    for minute, number in enumerate(numbers):
        for _ in range(number):
            k = len(tracks)
            name = "lorry" if k % 4 == 3 else "car"
            tracks.append(
                straight(k + 1, (-20, 0), (10, 0), 4, begin_s=60 * minute + 5 + 8.0 * (k % 6), class_name=name)
            )
    site = parse_site(Path("site.toml"), f"{HEAD}{ONE_GATE}[traffic]\ninterval_minutes = 1\n".encode())
    return measure(tracks, watched(60 * len(numbers)), site)


def test_a_row_for_each_interval_and_a_column_for_each_class() -> None:
    """3, 2 and 3 crossings; the fourth and the eighth are lorries."""
    report = report_of([3, 2, 3])
    page = traffic_page(report, tracks="t")
    head, *rows, foot = rows_below(page, "g (out): counts by interval and class")
    assert head == ["from", "all", "car", "lorry", "PCE"]
    assert [row[0] for row in rows] == ["10:00", "10:01", "10:02", "10:03 observed in part"]
    assert [row[2:] for row in rows] == [
        ["3", "0", "3.0"],
        ["1", "1", "3.3"],
        ["2", "1", "4.3"],
        ["0", "0", "0.0"],
    ]
    expected = report.counts[0].confidence_interval
    assert expected
    assert rows[0][1] == f"3 {expected.low} to {expected.high}"
    assert foot[0] == "whole footage"
    assert [cell.split()[0] for cell in foot[1:]] == ["8", "6", "2", "10.6"]
    assert "g (in): counts by interval and class" not in page  # nobody


def test_long_tables_are_folded() -> None:
    short, long = (traffic_page(report_of([1] * n), tracks="t") for n in (3, 14))
    assert '<details open=""><summary>g (out): counts by interval and class' in short
    assert "<details><summary>g (out): counts by interval and class" in long


def test_movements_are_a_matrix_with_totals() -> None:
    """Rows and columns add up to the counts of their gates; the person on foot is in none of vehicles."""
    page = traffic_page(junction_report(), tracks="t")
    head, *rows, foot = rows_below(page, "Movements of vehicles (more than two wheels), from row to column")
    sides = ["to west (to the west)", "to east (to the east)", "to south (to the south)"]
    assert head == ["from", *sides, "not seen after", "total"]
    assert [row[0] for row in rows] == [
        "west (from the west)",
        "east (from the east)",
        "south (from the south)",
        "not seen before",
    ]
    numbers = [[cell.split()[0] for cell in row[1:]] for row in rows]
    assert numbers == [
        ["0", "7", "4", "0", "11"],
        ["5", "0", "0", "0", "5"],
        ["0", "3", "0", "0", "3"],
        ["0", "0", "0", "–", "0"],
    ]
    assert [cell.split()[0] for cell in foot[1:]] == ["5", "10", "4", "0", "19"]
    assert re.fullmatch(r"7 \d+ to \d+", rows[0][2])  # a cell has its interval


def test_gates_with_many_crossings_that_are_not_counted_list_them() -> None:
    """Five cars count; four that pass 1 m beside the end of the gate do not, and three vanish before it."""
    tracks = [straight(k, (-20, 0), (10, 0), 4, begin_s=10.0 * k) for k in range(1, 6)]
    tracks += [straight(k, (-20, 5.5), (10, 0), 4, begin_s=10.0 * k + 5, sigma=1.0) for k in range(6, 10)]
    tracks += [straight(k, (-30, 0), (10, 0), 2.5, begin_s=10.0 * k) for k in range(10, 13)]
    site = parse_site(Path("site.toml"), ONE_GATE.encode())
    report = measure(tracks, watched(200), site, broken=False)
    ((side, left_out),) = left_out_crossings(report).items()
    assert side == ("g", "out")
    assert [row.track for row in left_out] == list(range(6, 13))
    assert [row.reason for row in left_out[4:]] == ["the track ends before the gate"] * 3
    assert re.fullmatch(r"passes beside the end of the gate \(probability 0\.\d\d\)", left_out[0].reason)
    rows = rows_below(traffic_page(report, tracks="t"), "g (out): 7 crossings that are not counted")
    assert rows[1][:3] == ["67.0\u00a0s", "6", "car"]
    many = [straight(k, (-30, 0), (10, 0), 2.5, begin_s=4.0 * k) for k in range(1, 41)]
    page = traffic_page(measure(many, watched(200), site, broken=False), tracks="t")
    assert "g (out): 40 crossings that are not counted" in page
    assert "and 10 more" in page


def test_a_few_that_are_not_counted_are_not_listed() -> None:
    tracks = [straight(k, (-20, 0), (10, 0), 4, begin_s=5.0 * k) for k in range(1, 31)]
    lost = [straight(100 + k, (-30, 0), (10, 0), 2.5, begin_s=5.0 * k + 2) for k in range(1, 4)]
    site = parse_site(Path("site.toml"), ONE_GATE.encode())
    assert left_out_crossings(measure([*tracks, *lost], watched(200), site, broken=False)) == {}  # 3 of 30: 10%
    assert left_out_crossings(measure([*tracks[:29], *lost], watched(200), site, broken=False))


def test_a_track_on_both_sides_of_the_line_alone_is_not_far_enough_beyond() -> None:
    """Three that go from 0.4 m before the line to 0.4 m behind it, less than the hysteresis of 0.5 m."""
    tracks = [straight(k, (-0.4, 0), (0.2, 0), 4, begin_s=20.0 * k) for k in range(1, 4)]
    report = measure(tracks, watched(100), parse_site(Path("site.toml"), ONE_GATE.encode()), broken=False)
    ((side, left_out),) = left_out_crossings(report).items()
    assert side == ("g", "out")
    assert {row.reason for row in left_out} == {"not seen far enough beyond the line on both sides (hysteresis)"}
    assert [row.time_s for row in left_out] == pytest.approx([22.0, 42.0, 62.0])


def road(width: int = 200, height: int = 160) -> EmptyRoadPicture:
    picture = empty_road_picture(np.full((height, width, 3), 90, dtype=np.uint8), np.arange(0.0, 20.0))
    assert picture
    return picture


def image_report() -> TrafficReport:
    """Three vehicles from left to right over column 100: positions are columns and negative rows."""
    tracks = [
        straight(k, (20, -90), (40, 0), 4, begin_s=5.0 * k, class_name="unknown", class_confidence=0.0, sigma=1.0)
        for k in range(1, 4)
    ]
    return count_in_image(tracks, watched(30), parse_site(Path("site.toml"), IMAGE_GATE.encode()))


def test_gates_are_drawn_on_the_empty_road() -> None:
    """The gate is at column 100 of 200, so at 550 of 1100; the arrow with the three counts goes right."""
    drawn = gates_in_picture(image_report(), road(), None)
    (line,) = re.findall(r'<path d="(\S+ \S+ \S+)" class="gate" data-tip', drawn)
    assert line == "M550.0 220.0L550.0 770.0"
    (a, b) = re.findall(r'<path d="M(\S+) (\S+)L(\S+) (\S+?)M[^"]*" class="way"></path>', drawn)
    assert (float(a[2]) - float(a[0]), float(b[2]) - float(b[0])) == pytest.approx((-42, 42))
    assert ">a 0</text>" in drawn
    assert ">b 3</text>" in drawn
    assert "<b>b</b> g (right): 3 (" in drawn
    page = traffic_page(image_report(), tracks="t", view=road())
    assert 'class="chart road view"' in page
    assert "PCE (passenger-car equivalents) are not available: without metres" in page
    assert 'class="chart road view"' not in traffic_page(image_report(), tracks="t")


def test_a_report_in_metres_is_drawn_as_the_camera_shows_it() -> None:
    """Camera 10 m above (-20, 0), looking along x, 30 degrees down: the gate at x = 0 is level in the image."""
    down = np.radians(30)
    rotation = np.array([[0, -1, 0], [-np.sin(down), 0, -np.cos(down)], [np.cos(down), 0, -np.sin(down)]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.array([-20.0, 0.0, 10.0])
    camera = Camera(
        K=np.array([[150.0, 0, 100], [0, 150.0, 80], [0, 0, 1]]), width=200, height=160, T_camera_world=pose
    )
    drawn = gates_in_picture(report_of([3]), road(), camera)
    (ax, ay, bx, by) = re.findall(r'<path d="M(\S+) (\S+?)L(\S+) (\S+?)" class="gate" data-tip', drawn)[0]
    assert float(ay) == pytest.approx(float(by), abs=0.2)
    assert abs(float(ax) - float(bx)) > 100
    away = re.findall(r'<path d="M\S+ (\S+?)L\S+ (\S+?)M[^"]*" class="way"></path>', drawn)[0]
    assert float(away[1]) < float(away[0])  # "out" goes away from the camera: upwards
    assert gates_in_picture(report_of([3]), road(width=300), camera) == ""  # another camera's picture
    assert gates_in_picture(report_of([3]), road(), None) == ""


def test_the_empty_road_is_kept_beside_the_tracks(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (900, 1600, 3), dtype=np.uint8)
    picture = empty_road_picture(pixels, np.arange(0.0, 20.0, 0.5))
    assert picture
    assert picture.size == (1600, 900)
    assert cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (720, 1280, 3)
    assert write_empty_road_picture(tmp_path, picture) == ["empty_road.jpg", "empty_road.json"]
    assert read_empty_road_picture(tmp_path) == picture
    (tmp_path / "empty_road.json").write_text('{"size": [0, 1]}')
    assert read_empty_road_picture(tmp_path) is None
    assert read_empty_road_picture(tmp_path / "nothing") is None


@pytest.mark.parametrize("times_s", [np.arange(0.0, 9.5, 0.5), np.arange(0.0, 90.0, 10.0)])
def test_footage_that_is_too_short_shows_road_users_and_is_not_kept(times_s: np.ndarray) -> None:
    assert empty_road_picture(np.zeros((8, 8, 3), dtype=np.uint8), times_s) is None
