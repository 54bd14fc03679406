"""Local times at changes of clocks."""

from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from skope.errors import UserError
from skope.site.site_file import clock_problem, parse_site
from skope.traffic.recordings import parse_start_time


@pytest.mark.parametrize(
    ("zone", "time", "said"),
    [
        ("Europe/Berlin", "2026-03-29T01:59:59", ""),
        ("Europe/Berlin", "2026-03-29T02:00:00", "no such time"),
        ("Europe/Berlin", "2026-03-29T03:00:00", ""),
        ("Europe/Berlin", "2026-10-25T01:59:59", ""),
        ("Europe/Berlin", "2026-10-25T02:00:00", "twice"),
        ("Europe/Berlin", "2026-10-25T03:00:00", ""),
        ("America/New_York", "2026-03-08T02:30:00", "no such time"),
        ("America/New_York", "2026-11-01T01:30:00", "twice"),
        ("America/New_York", "2026-11-01T02:00:00", ""),
        ("Asia/Tokyo", "2026-03-29T02:30:00", ""),
        ("Europe/Berlin", "9999-12-31T23:59:59", "year"),
    ],
)
def test_clock_problem(zone: str, time: str, said: str) -> None:
    problem = clock_problem(datetime.fromisoformat(time), ZoneInfo(zone))
    assert said in problem
    assert bool(problem) == bool(said)


@pytest.mark.parametrize("time", ["2026-03-29T02:30:00", "2026-10-25T02:30:00"])
def test_a_site_file_and_begins_give_one_reason(time: str) -> None:
    zone = 'time_zone = "Europe/Berlin"\n'
    with pytest.raises(UserError) as start_time:
        parse_start_time(time, parse_site(Path("site.toml"), zone.encode()), "--start-time")
    with pytest.raises(UserError) as start:
        parse_site(Path("site.toml"), f"{zone}start = {time}\n".encode())
    assert str(start_time.value) == f"--start-time: {time}: {str(start.value).removeprefix('site.toml: start: ')}"
