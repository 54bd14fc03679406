"""Manual count in the page: keys beside a playing video, kept over a reload, read again by --manual-count."""

import codecs
import json
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera
from skope.files.csv_files import read_csv
from skope.files.json_files import write_json
from skope.site.gates_zones_lanes import Gate
from skope.site.site_file import parse_site
from skope.site.traffic_settings import TRAFFIC_CLASSES
from skope.tracks.csv_file import TRACKS_CSV, write_tracks
from skope.traffic.image_counts import count_in_image
from skope.traffic.measure import measure
from skope.traffic.observation import FOOTAGE_FILE, Observation
from skope.traffic.page.manual_count import (
    CLASS_LETTERS,
    MANUAL_COUNT_PAGE,
    manual_count_data,
    manual_count_json,
    packed_times,
)
from skope.traffic.page.page import traffic_page
from skope.traffic.recordings import SiteRecording
from skope.traffic.traffic_report import TrafficReport
from tests.chromium import Browser
from tests.traffic.drives import along_x, straight, watched
from tests.traffic.test_exports import HEAD, junction_report, report_of
from tests.waiting import until

Pages = Callable[[], AbstractContextManager[Browser]]
Skope = Callable[..., tuple[int, str, str]]
HOSTILE = '=<img src=x onerror="document.title=1">, "</script>'
STEP_S = 0.2
SECONDS = 8.0
CROSSED_S = (1.5, 2.7, 4.3, 6.1)
"""When cars go over the first gate to the east, which is the first direction; one goes back at 3.5 s."""
BACK_S = 3.5
SITE = f"""
[camera]
size = [320, 180]
fov_deg = 70.0
position = [0, -25, 12]
yaw_deg = 90.0
pitch_deg = 25.0
[[gates]]
name = {json.dumps(HOSTILE)}
line = [[0, -6], [0, 6]]
directions = ["east", "west"]
[[gates]]
name = "far"
line = [[12, -6], [12, 6]]
directions = ["east", "west"]
"""


def write_folder(folder: Path) -> None:
    """Cars at 10 m/s along x, which cross the first gate at the known times."""
    folder.mkdir()
    times = np.arange(0, SECONDS, STEP_S)
    cars = []
    for number, (at, way) in enumerate([*((at, 1) for at in CROSSED_S), (BACK_S, -1)], start=1):
        x = 10 * way * (times - at)
        near = np.abs(x) < 25
        cars.append(along_x(number, x[near], times[near]))
        cars[-1].position[:, 1] = -2 * way
    write_tracks(folder / TRACKS_CSV, cars)
    write_json(folder / FOOTAGE_FILE, Observation(times_s=times, source="clip.mp4", common_scale_sigma=0.01).to_dict())


def write_clip(path: Path, code: str, seconds: float = SECONDS) -> None:
    """The cars as bars that go across the picture."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 1 / STEP_S, (320, 180))  # type: ignore[attr-defined]
    assert writer.isOpened()
    for k in range(round(seconds / STEP_S)):
        picture = np.full((180, 320, 3), 80, np.uint8)
        for at in CROSSED_S:
            x = round(160 + 40 * (k * STEP_S - at))
            picture[80:110, max(0, x - 10) : max(0, x + 10)] = (40, 40, 220)
        writer.write(picture)
    writer.release()


@pytest.fixture(scope="module")
def counted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with tracks, their site, a clip of them that browsers play, and one that they do not."""
    folder = tmp_path_factory.mktemp("counted")
    write_folder(folder / "tracks")
    (folder / "site.toml").write_text(SITE)
    write_clip(folder / "clip.webm", "VP90")
    write_clip(folder / "clip.mp4", "mp4v", 1.0)
    write_clip(folder / "short.webm", "VP90", 2.0)
    return folder


def choose(browser: Browser, path: Path) -> None:
    """Choose a file as a person does."""
    root = browser.call("DOM.getDocument")["root"]["nodeId"]
    node = browser.call("DOM.querySelector", nodeId=root, selector="#manual-file")["nodeId"]
    browser.call("DOM.setFileInputFiles", files=[str(path)], nodeId=node)


def note(browser: Browser) -> str:
    return str(browser.run("document.getElementById('manual-note').textContent"))


def seconds(browser: Browser) -> float:
    return float(browser.run("document.getElementById('manual-video').currentTime"))


def opened(browser: Browser, page: Path, clip: Path) -> None:
    browser.open(page.as_uri())
    browser.until("document.readyState === 'complete' && !!document.getElementById('manual')")
    played(browser, clip)


def played(browser: Browser, clip: Path) -> None:
    choose(browser, clip)
    browser.until("document.getElementById('manual').classList.contains('manual-ready')")


def click(browser: Browser, what: str) -> None:
    browser.run(f"document.getElementById('manual-{what}').click()")


def step_to(browser: Browser, time_s: float) -> None:
    """Frame by frame, with the arrow key."""
    while (at := seconds(browser)) < time_s - 0.01:
        browser.press("ArrowRight")
        browser.until(f"((v) => v.currentTime > {at} && !v.seeking)(document.getElementById('manual-video'))")


def rows_of(browser: Browser) -> list[list[str]]:
    """The cells of the results."""
    script = (
        "[...document.querySelectorAll('#manual-done tbody tr')].map((row) => [...row.cells].map((c) => c.textContent))"
    )
    return list(browser.run(script))


def downloaded(browser: Browser, folder: Path) -> Path:
    browser.call(
        "Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder), browserContextId=browser.context
    )
    click(browser, "download")
    path = folder / "manual_count.csv"
    until(lambda: path.is_file() and path.stat().st_size)
    return path


def test_a_clip_counted_with_keys_is_read_back_by_the_command(
    chromium_pages: Pages, skope: Skope, counted: Path, tmp_path: Path
) -> None:
    where = ["--site", str(counted / "site.toml")]
    code, _, err = skope("eval", "traffic", counted / "tracks", *where, "--out", tmp_path / "r", "-q")
    assert code == 0, err
    with chromium_pages() as browser:
        browser.size(1280, 900)
        opened(browser, tmp_path / "r/report.html", counted / "clip.webm")
        assert "called" not in note(browser), "a copy in another format has the same name"
        click(browser, "begin")
        visible = (
            "[...document.querySelectorAll('main > *')].filter((one) => one.offsetParent && one.id !== 'manual').length"
        )
        assert browser.run(visible) == 0, "nothing that was counted is seen by who counts"
        assert browser.run("document.querySelectorAll('#manual-gates path.manual-line').length") == 2
        step_to(browser, 1.6)
        browser.press("1")
        step_to(browser, 2.0)
        browser.press("2")  # a slip, taken back at once
        browser.press("Backspace")
        browser.press("3")  # another one, seen later
        step_to(browser, 2.8)
        browser.press("1")
        assert browser.run("document.querySelector('#manual-list li:last-child').textContent").startswith("0:00:01.6")
        # The work is there again after the page was loaded anew, and goes on where it was.
        browser.open((tmp_path / "r/report.html").as_uri())
        browser.until(
            "document.readyState === 'complete' && document.getElementById('manual-number').textContent === '3'"
        )
        assert browser.run(visible) == 0
        assert "choose the video file again" in note(browser)
        played(browser, counted / "clip.webm")
        browser.until("Math.abs(document.getElementById('manual-video').currentTime - 2.8) < 0.1")
        browser.run("document.querySelectorAll('#manual-list li button')[1].click()")
        # Nobody leaves out a part: to jump ahead leads back.
        click(browser, "ahead")
        browser.until("document.getElementById('manual-video').currentTime < 3")
        assert "A count must not skip any part" in note(browser)
        # With the mouse, while it plays, at half the speed.
        browser.press("-")
        browser.press("-")
        assert browser.run("document.getElementById('manual-video').playbackRate") == 0.5
        browser.press(" ")
        browser.until("document.getElementById('manual-video').currentTime >= 3.1")
        browser.run("document.querySelector('#manual-keys [data-side=\"1\"]').click()")
        browser.press(" ")
        assert browser.run("document.getElementById('manual-video').paused")
        step_to(browser, 4.3)
        browser.press("1")
        step_to(browser, 5.4)
        browser.press("2")
        click(browser, "finish")
        assert "1 key presses after 0:00:05 are excluded" in browser.run("document.body.textContent")
        rows = rows_of(browser)
        assert rows[:2] == [
            [f"{HOSTILE} (east)", "3", "3", "0 (0 %)", "0.0"],
            [f"{HOSTILE} (west)", "1", "1", "0 (0 %)", "0.0"],
        ]  # fmt: skip
        path = downloaded(browser, tmp_path)
        assert path.read_bytes().startswith(codecs.BOM_UTF8), "Excel knows by it that the file is UTF-8"
        assert "'=<img" in path.read_text(), "no spreadsheet takes the name for a formula"
        # A second count of the same, in part, would count somebody twice.
        click(browser, "back")
        click(browser, "begin")
        step_to(browser, seconds(browser) + 1.2)
        click(browser, "finish")
        assert "overlap in time" in browser.run("document.getElementById('manual-done').textContent")
        assert browser.run("document.getElementById('manual-download')") is None
        assert browser.run("document.title").startswith("Traffic: "), "names are text"
        assert not browser.told("Runtime.exceptionThrown")
        requests = [one["request"]["url"] for one in browser.told("Network.requestWillBeSent")]
        assert not [url for url in requests if not url.startswith(("file:", "data:", "blob:"))]
    code, _, err = skope(
        "eval", "traffic", counted / "tracks", *where, "--manual-count", path, "--out", tmp_path / "again", "-q"
    )
    assert code == 0, err
    _, checks = read_csv(tmp_path / "again/manual_count.csv")
    assert [[f"{row['gate']} ({row['direction']})", row["manual_count"], row["count"]] for row in checks] == [
        row[:3] for row in rows
    ]
    assert {(row["begin_s"], row["end_s"]) for row in checks} == {("0.000", "5.000")}


def test_what_cannot_be_counted_is_said(chromium_pages: Pages, counted: Path, tmp_path: Path) -> None:
    """A file that browsers do not play, one of another length; a begin in a gap; movements, with two keys each."""
    gap = replace(watched(8.0, 5.0), times_s=np.concatenate([np.arange(0, 3, 0.2), np.arange(5, 8, 0.2)]))
    site = parse_site(Path("site.toml"), SITE.encode())
    cars = [straight(k, (-30, -2), (10, 0), 6.0, begin_s=at - 3) for k, at in enumerate((3.2, 6.5))]
    report = measure(cars, replace(gap, source="clip.mp4"), site)
    page = tmp_path / "page.html"
    page.write_text(traffic_page(report, tracks="t", camera=site.camera.camera if site.camera else None))
    with chromium_pages() as browser:
        browser.size(390, 844, phone=True)
        browser.open(page.as_uri())
        browser.until("document.readyState === 'complete' && !!document.getElementById('manual')")
        choose(browser, counted / "clip.mp4")
        browser.until("document.getElementById('manual-note').textContent.includes('cannot play')")
        assert "ffmpeg -i VIDEO" in note(browser)
        assert not browser.run("document.getElementById('manual').classList.contains('manual-ready')")
        played(browser, counted / "short.webm")
        assert "lasts 0:00:02, the measured footage 0:00:08" in note(browser)
        played(browser, counted / "clip.webm")
        assert note(browser) == ""
        assert browser.run("document.documentElement.scrollWidth") <= 390
        browser.run("document.getElementById('manual-video').currentTime = 4")
        browser.until("!document.getElementById('manual-video').seeking")
        click(browser, "begin")
        assert "Nothing was observed at 0:00:04" in note(browser)
        browser.run("document.getElementById('manual-video').currentTime = 5")
        browser.until("!document.getElementById('manual-video').seeking")
        browser.run("document.querySelector('[name=manual-what][value=movements]').click()")
        click(browser, "begin")
        step_to(browser, 6.6)
        browser.press("1")
        assert "From " in browser.run("document.getElementById('manual-asked').textContent")
        browser.press("3")
        step_to(browser, 7.2)
        click(browser, "finish")
        assert rows_of(browser) == [[f"{HOSTILE} (east) to far (east)", "1", "1", "0 (0 %)", "0.0"]]
        assert browser.run("document.getElementById('manual-download')") is None
        assert browser.run("document.documentElement.scrollWidth") <= 390
        # A file that begins later than the footage has its times in the footage, also after the page is loaded anew.
        browser.run("document.getElementById('manual-offset').value = 2.5")
        browser.run("document.getElementById('manual-video').currentTime = 3")
        browser.until("!document.getElementById('manual-video').seeking")
        browser.run("document.querySelector('[name=manual-what][value=crossings]').click()")
        click(browser, "begin")
        step_to(browser, 3.9)
        browser.press("1")
        for k in range(2):
            told = browser.run("document.getElementById('manual-list').textContent")
            assert told.startswith("0:00:06.4"), told
            assert float(browser.run("document.getElementById('manual-offset').value")) == 2.5
            if not k:
                browser.open(page.as_uri())
                browser.until("document.readyState === 'complete' && !document.getElementById('manual').hidden")
                played(browser, counted / "clip.webm")
                browser.until("Math.abs(document.getElementById('manual-video').currentTime - 3.9) < 0.1")
        # What the page has not kept itself is not believed.
        key = "'skope-manual-count:' + JSON.parse(document.getElementById('manual-data').textContent).key"
        for text in ("nonsense", '{"done": [{"begin": 1}]}', '{"done": [], "current": {"sides": [99]}}'):
            browser.run(f"localStorage.setItem({key}, {json.dumps(text)})")
            browser.open(page.as_uri())
            browser.until("document.readyState === 'complete' && !document.getElementById('manual').hidden")
            assert rows_of(browser) == []
            assert not browser.run("document.body.classList.contains('manual-is-counting')")
        assert not browser.told("Runtime.exceptionThrown")


# ------------------------------------------------------------------------------------------------- what the page holds


def unpacked(text: str) -> Iterator[tuple[int, str]]:
    """What the page's script makes of it."""
    now = 0
    for later, letter in re.findall(r"(-?\d+)([a-z])", text):
        now += int(later)
        yield now, letter


def test_crossings_are_held_to_the_millisecond_and_no_later() -> None:
    events = [(59.9999, "car"), (1.2345, "pedestrian"), (3600.0, "bus")]
    assert list(unpacked(packed_times(events))) == [(1234, "h"), (59_999, "a"), (3_600_000, "d")]
    assert len(set(CLASS_LETTERS.values())) == len(TRAFFIC_CLASSES)


def test_the_page_holds_who_crossed_when_and_went_where() -> None:
    report = junction_report()
    data = manual_count_data(report, None)
    names = [(side["gate"], side["direction"]) for side in data["sides"]]
    assert [len(list(unpacked(text))) for text in data["crossings"]] == [
        sum((one.gate, one.direction_name) == side for one in report.crossings) for side in names
    ]
    moved = {(names[a], names[b]): len(list(unpacked(text))) for a, b, text in data["movements"]}
    assert moved[("west", "from the west"), ("east", "to the east")] == 7
    assert sum(moved.values()) == 19
    assert data["clocks"] == [[0.0, 36000.0]]
    assert dict(data["kinds"])["motor"] == "abcdef"
    assert data["view"] is None
    # Ten bytes a crossing, its movement too: under 300 kB for eight hours of 1500 crossings.
    assert len(json.dumps([data["crossings"], data["movements"]])) < 20 * len(report.crossings)


def test_too_many_crossings_are_left_out_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "skope.traffic.page.manual_count.MANUAL_COUNT_PAGE", replace(MANUAL_COUNT_PAGE, most_crossings=1)
    )
    report = report_of()
    data = manual_count_data(report, None)
    assert (data["crossings"], data["movements"]) == (None, None)
    assert "There are too many crossings for this page" in traffic_page(report, tracks="t")


def test_clocks_that_change_meanwhile_are_told() -> None:
    plain = report_of(head=HEAD)
    start = datetime(2026, 10, 25, 2, 30, tzinfo=ZoneInfo("Europe/Berlin"))
    report = measure([], watched(7200.0, 1.0), plain.site, start)
    assert manual_count_data(report, None)["clocks"] == [[0.0, 9000.0], [1800.0, 7200.0]]


def test_each_recording_begins_at_its_second_of_the_report() -> None:
    plain = report_of()
    parts = tuple(replace(watched(60.0, begin_s=begin), source=f"{begin:g}.mp4") for begin in (0.0, 3600.0))
    whole = Observation(times_s=np.concatenate([one.times_s for one in parts]), source="both", parts=parts)
    begin = datetime(2026, 11, 26, 10, tzinfo=ZoneInfo("Europe/Berlin"))
    recordings = [
        SiteRecording(
            folder=Path(one.source),
            source=one.source,
            begin=begin,
            begin_s=3600.0 * k,
            added=0,
            guessed=False,
            late_s=0.0,
        )
        for k, one in enumerate(parts)
    ]
    data = manual_count_data(measure([], whole, plain.site, begin, recordings=recordings), None)
    assert data["recordings"] == [
        {"source": "0.mp4", "begin_s": 0.0, "end_s": 60.1},
        {"source": "3600.mp4", "begin_s": 3600.0, "end_s": 3660.1},
    ]
    assert data["spans"] == [[0.0, 60.1], [3600.0, 3660.1]]


def test_gates_are_drawn_where_the_camera_sees_them() -> None:
    """From 10 m above, looking straight down with 100 pixels a metre at the road."""
    gate = Gate(name="g", line=((0.0, -1.0), (0.0, 1.0)), directions=("a", "b"))
    plain = report_of()
    report = measure(plain.trajectories, plain.observation, replace(plain.site, gates=(gate,)), plain.start)
    view = seen_from_above(report)
    (one,) = view["gates"]
    assert view["size"] == (1000, 800)
    # x to the right, y upwards: the gate runs upwards in the picture, and its left lies on the left.
    assert one["line"] == [[500.0, 500.0], [500.0, 300.0]]
    assert one["arrow"] == [[200.0, 400.0], [800.0, 400.0]]


def seen_from_above(report: TrafficReport) -> dict[str, Any]:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 10.0
    K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    camera = Camera(width=1000, height=800, K=K, T_camera_world=T)
    return dict(manual_count_data(report, camera)["view"])


def test_gates_of_the_image_are_drawn_where_they_are() -> None:
    """One that is drawn upwards: from its left to its right is to the right on the screen."""
    text = b'[[gates]]\nname = "g"\npixels = [[240, 200], [240, 60]]\ndirections = ["right", "left"]\n'
    report = count_in_image([], watched(10.0), parse_site(Path("site.toml"), text))
    view = manual_count_data(report, None)["view"]
    assert view["size"] is None
    assert view["gates"] == [
        {"gate": "g", "line": [[240.0, 200.0], [240.0, 60.0]], "arrow": [[220.0, 130.0], [260.0, 130.0]]}
    ]


def test_without_gates_or_frames_there_is_nothing_to_count() -> None:
    plain = report_of()
    assert manual_count_json(replace(plain, gates=())) is None
    assert manual_count_json(measure([], Observation(times_s=np.zeros(0)), plain.site)) is None
