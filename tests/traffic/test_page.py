"""The page of a traffic report: complete in itself, readable on a phone, harmless whatever names hold."""

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import pytest

from skope.site.gates_zones_lanes import Gate
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.manual_count_file import ManualCount
from skope.traffic.measure import measure
from skope.traffic.page.count_tables import side_name
from skope.traffic.page.page import traffic_page, write_page
from skope.traffic.road_picture import RoadPicture, read_road_picture, write_road_picture
from skope.traffic.traffic_report import TrafficReport
from tests.chromium import Browser
from tests.traffic.drives import watched
from tests.traffic.test_exports import HEAD, junction_report, report_of, site_of

HOSTILE = '<img src=x onerror="document.title=1">&"'


def hand(number: int) -> ManualCount:
    interval = ClockInterval(begin_s=0.0, end_s=60.0, begin=None, end=None)
    return ManualCount(
        gate="west", direction=1, direction_name="from the west", class_name="all", interval=interval, number=number
    )


def test_it_says_what_the_tables_say() -> None:
    report = junction_report()
    page = traffic_page(report, tracks="runs/tracks")
    for one in report.counts_total:
        assert one.confidence_interval
        before = "" if one.class_name == "all" else "<td>.*?</td>"
        cell = f"<td>{one.count} <small>{one.confidence_interval.low} to {one.confidence_interval.high}</small></td>"
        assert re.search(rf">{re.escape(side_name((one.gate, one.direction)))}</th>{before}{cell}", page)
    assert "from the west) to east (to the east): 7 (" in page  # the tip of a band
    assert page.count('class="flow ') == 4
    assert "2026-11-26 10:00:00 to 2026-11-26 10:05:00, Europe/Berlin" in page
    assert "No manual counts." in page
    (short,) = (one for one in report.lengths_total if (one.direction, one.bin_name) == ("to the east", "short"))
    assert short.confidence_interval
    row = f">{short.gate} ({short.direction})</th><td>{short.count} <small>{short.confidence_interval.low} to"
    assert row in page
    assert "no intervals above 12 m" in page
    for line in report.notes:
        assert f"<li>{line}</li>".replace("'", "&#39;") in page


def test_a_count_by_hand_is_beside_what_was_counted() -> None:
    plain = junction_report()
    report = measure(plain.trajectories, plain.observation, plain.site, plain.start, [hand(5), hand(3)])
    page = traffic_page(report, tracks="t")
    (first, _) = report.manual_count_checks
    off = f"{100 * (first.count - 5) / 5:+.0f} %"
    assert f"<td>5</td><td>{first.count}</td><td>{off}</td><td>{first.geh:.1f}</td>" in page
    assert "in manual counts of 8" in page


def test_a_report_of_nothing_is_a_page_too() -> None:
    page = traffic_page(measure([], watched(10), site_of(HEAD)), tracks="t")
    assert "no counts, speeds and headways: the site has no gates" in page
    assert "<svg" not in page


def hostile_report() -> TrafficReport:
    plain = report_of()
    gate = Gate(name=HOSTILE, line=((0.0, -5.0), (0.0, 5.0)), directions=(HOSTILE, "</script>"))
    other = replace(gate, name="<b>", line=((10.0, -5.0), (10.0, 5.0)))
    site = replace(plain.site, gates=(gate, other))
    return measure(plain.trajectories, replace(plain.observation, source=HOSTILE), site, plain.start)


def test_in_a_browser(chromium_pages: Callable[[], AbstractContextManager[Browser]], tmp_path: Path) -> None:
    path = write_page(tmp_path, hostile_report(), tracks=HOSTILE)
    body = path.read_text().split("</head>")[1].replace("http://www.w3.org/2000/svg", "")
    assert not re.findall(r"<img|<b>|https?://", body)
    with chromium_pages() as browser:
        for width, height in ((390, 844), (1280, 800)):
            browser.size(width, height, phone=width < 600)
            browser.events.clear()
            browser.call("Page.navigate", url=path.as_uri())
            browser.until("document.readyState === 'complete' && document.querySelector('svg.road') !== null")
            assert browser.run("document.title").startswith("Traffic: <img")
            assert browser.run("document.documentElement.scrollWidth") <= width
            requests = [
                event["params"]["request"]["url"]
                for event in browser.events
                if event.get("method") == "Network.requestWillBeSent"
            ]
            assert [url for url in requests if not url.startswith(("file:", "data:"))] == []
            errors = [event for event in browser.events if event.get("method") == "Runtime.exceptionThrown"]
            assert not errors
        # Pointing at a gate says its counts.
        browser.run(
            "document.querySelector('path.gate').dispatchEvent(new PointerEvent('pointerover', {bubbles: true}))"
        )
        assert "<img" in browser.run("document.getElementById('tip').textContent")
        key = "new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true})"
        browser.run(f"document.querySelector('svg.road').dispatchEvent({key})")
        assert browser.run("document.getElementById('tip').textContent").startswith("<b>: ")  # the next gate
        pdf = browser.call("Page.printToPDF", printBackground=True)["data"]
        assert len(pdf) > 10_000


def test_tracks_are_drawn_on_the_empty_road_where_it_lies(tmp_path: Path) -> None:
    report = report_of()
    picture = RoadPicture(b"jpeg", (-40.0, -30.0), (40.0, 20.0))
    assert write_road_picture(tmp_path, picture) == ["road.jpg", "road.json"]
    assert read_road_picture(tmp_path) == picture
    page = traffic_page(report, tracks="t", road=picture)
    (found,) = re.findall(
        r'<image href="data:image/jpeg;base64,anBlZw==" x="(.*?)" y="(.*?)" width="(.*?)" height', page
    )
    x, _, width = map(float, found)
    # The gate lies at x = 0: in the middle of the picture.
    (gate,) = re.findall(r'd="M(\S+) \S+L\S+ \S+" class="gate"', page)
    assert float(gate) == pytest.approx(float(x) + float(width) / 2, abs=0.2)
    (tmp_path / "road.json").write_text('{"low": [1, 2]}')
    assert read_road_picture(tmp_path) is None
