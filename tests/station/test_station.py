"""A station: a day in the database is the report of its recordings, once, whatever is killed or repeated."""

import csv
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sql

from skope.errors import UserError
from skope.eval.cli.station import measure_station
from skope.files.json_files import write_json
from skope.station.database import Database
from skope.station.measure_days import StationWork
from skope.station.station_file import read_station
from skope.tracks.csv_file import TRACKS_CSV, write_tracks
from skope.traffic.observation import FOOTAGE_FILE, Observation
from tests.traffic.drives import straight
from tests.waiting import until

Skope = Callable[..., tuple[int, str, str]]
SITE = """time_zone = "Europe/Berlin"

[[gates]]
name = "west"
line = [[-15, -6], [-15, 6]]
directions = ["in", "out"]

[traffic]
interval_minutes = 1
"""
STATION = """database = "{address}"

[[cameras]]
name = "north"
site = "site.toml"
tracks = "north"
"""


def record(folder: str, begin: str, vehicles: int, **known: Any) -> Path:
    """Write a recording of a minute: vehicles that cross the gate, and frames at 10 per second."""
    path = Path(folder)
    path.mkdir(parents=True)
    tracks = [straight(k, (-40.0, 0.0), (12.0 + k % 3, 0.0), 5.0, begin_s=1.0 + 6 * k) for k in range(1, vehicles + 1)]
    write_tracks(path / TRACKS_CSV, [replace(track, number=k) for k, track in enumerate(tracks, 1)])
    values = {"source": "camera", "common_scale_sigma": 0.01, "start_time": datetime.fromisoformat(begin), **known}
    write_json(path / FOOTAGE_FILE, Observation(times_s=np.arange(600) / 10, **values).to_dict())
    return path


def not_needed(seen: Path, out: Path) -> list[str]:
    """Tracks nothing: these stations have recordings only."""
    raise AssertionError(seen, out)


@pytest.fixture
def station(skope: Skope) -> Skope:
    """The command, in a folder with a station of one camera with three recordings on two days."""
    Path("site.toml").write_text(SITE)
    Path("station.toml").write_text(STATION.format(address="sqlite:///traffic.db"))
    record("north/a", "2026-11-26T10:00:00+01:00", 7)
    record("north/b", "2026-11-26T10:01:00+01:00", 4)
    record("north/c", "2026-11-27T00:30:00+01:00", 2)
    return skope


def rows_of(query: str) -> list[tuple[Any, ...]]:
    with sqlite3.connect("traffic.db") as file:
        return file.execute(query).fetchall()


def state() -> dict[str, list[tuple[Any, ...]]]:
    return {name: rows_of(f"select * from {name} order by 1, 2, 3") for name in ("counts", "events", "speeds")}


def test_a_day_in_the_database_is_the_report_of_its_recordings(station: Skope) -> None:
    code, out, err = station("eval", "station", "station.toml", "--once")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "north: 2026-11-26: 2 recordings, 11 events",
        "north: 2026-11-27: 1 recording, 2 events",
    ]
    assert station("eval", "traffic", "north/a", "north/b", "--site", "site.toml", "--out", "r")[0] == 0
    for name in ("counts", "events", "speeds", "visibility"):
        with Path(f"r/{name}.csv").open(encoding="utf-8-sig", newline="") as file:
            wanted = list(csv.DictReader(file))
        with sqlite3.connect("traffic.db") as file:
            file.row_factory = sqlite3.Row
            found = file.execute(f"select * from {name} where day = '2026-11-26' order by row").fetchall()
        assert len(found) == len(wanted) > 0
        for row, cells in zip(found, wanted, strict=True):
            assert set(cells) <= set(row.keys())
            for column, text in cells.items():
                value = row[column]
                if column in ("begin", "end", "time") and text:
                    assert datetime.fromisoformat(f"{value}+00:00") == datetime.fromisoformat(text)
                elif isinstance(value, float):
                    assert value == pytest.approx(float(text), rel=1e-3, abs=1e-3), column
                else:
                    assert ("" if value is None else str(value)) == text, column


def test_only_days_with_new_recordings_are_measured_again(station: Skope) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    before = state()
    assert station("eval", "station", "station.toml", "--once") == (0, "", "")
    assert state() == before
    record("north/d", "2026-11-27T00:31:00+01:00", 3)
    assert station("eval", "station", "station.toml", "--once")[1] == "north: 2026-11-27: 2 recordings, 5 events\n"
    assert rows_of("select day, count(*) from events group by day") == [("2026-11-26", 11), ("2026-11-27", 5)]


def test_a_changed_site_file_measures_all_days_again(station: Skope) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    Path("site.toml").write_text(SITE.replace("= 1\n", "= 5\n"))
    assert station("eval", "station", "station.toml", "--once")[1].count("\n") == 2
    assert rows_of("select distinct end_s - begin_s from counts") == [(300.0,)]


def test_a_running_station_does_not_take_old_gates_for_new_ones(station: Skope) -> None:
    read = read_station(Path("station.toml"))
    work = StationWork(read, Database.open(read.database), not_needed)
    assert len(list(work.work_off(rest=False))) == 2
    Path("site.toml").write_text(SITE.replace("= 1\n", "= 5\n"))
    assert list(work.work_off(rest=False)) == []
    assert station("eval", "station", "station.toml", "--once")[1].count("\n") == 2
    assert rows_of("select distinct end_s - begin_s from counts") == [(300.0,)]


def test_a_recording_without_a_start_is_left_out_once(station: Skope) -> None:
    record("north/e", "2026-11-27T00:40:00+01:00", 1, start_time=None)
    Path("north/f").mkdir()
    Path("north/f", TRACKS_CSV).write_text("nonsense")
    Path("north/f", FOOTAGE_FILE).write_text("{")
    read = read_station(Path("station.toml"))
    work = StationWork(read, Database.open(read.database), not_needed)
    lines = list(work.work_off(rest=False))
    assert len(lines) == 4
    assert "start time is not known; left out" in lines[0]
    assert "north/f" in lines[1]
    assert list(work.work_off(rest=False)) == []


def test_a_killed_station_loses_and_doubles_nothing(station: Skope) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    wanted = state()
    rng = np.random.default_rng(3)
    for _ in range(4):
        for file in Path().glob("traffic.db*"):
            file.unlink()
        with subprocess.Popen([sys.executable, "-m", "skope", "eval", "station", "station.toml", "-q"]) as run:
            until(Path("traffic.db").is_file)
            time.sleep(float(rng.uniform(0, 0.4)))
            run.send_signal(signal.SIGKILL)
        if rows_of("select 1 from sqlite_master where name = 'visibility'"):
            days = {row[0] for row in rows_of("select day from days")}
            assert {row[1] for row in state()["events"]} == days, "a day is there as a whole or not at all"
        assert station("eval", "station", "station.toml", "--once")[0] == 0
        assert state() == wanted


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("name", "nane"), "cameras[0].nane: unknown field; did you mean name?"),
        (("north", "a/b"), "cameras[0].name: expected"),
        (("site.toml", "missing.toml"), "missing.toml: "),
        (("database =", "data ="), "data: unknown"),
        (("sqlite:///traffic.db", "nonsense"), "database: not an address of a database"),
        (("sqlite:///traffic.db", "sqlite:////no/such/folder/traffic.db"), "database sqlite:////no/such/folder"),
        (("sqlite:///traffic.db", "postgresql+psycopg://user:secret@127.0.0.1:1/x"), "user:***@127.0.0.1"),
        (("sqlite:///traffic.db", "oracle://x"), "database: its driver"),
    ],
)
def test_a_wrong_station_is_one_line(station: Skope, change: tuple[str, str], said: str) -> None:
    file = Path("station.toml")
    file.write_text(file.read_text().replace(*change, 1))
    code, _, err = station("eval", "station", "station.toml", "--once")
    assert (code, err.count("\n")) == (2, 1)
    assert said in err
    assert "secret" not in err


def test_tables_of_another_version_are_not_touched(station: Skope) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    with sqlite3.connect("traffic.db") as file:
        file.execute("update skope_schema set version = 99")
    code, _, err = station("eval", "station", "station.toml", "--once")
    assert code == 2
    assert "its tables have version 99, expected 2" in err


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    """The address of a PostgreSQL server that runs for these tests."""
    programs = [Path(path).parent for path in (shutil.which("initdb"),) if path]
    programs += sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    if not programs:
        pytest.skip("PostgreSQL's initdb was not found")
    folder = Path(tempfile.mkdtemp(prefix="skope-"))  # short: the path of a socket has at most 107 letters
    user: dict[str, Any] = {}
    if os.geteuid() == 0:  # the server refuses to run as root
        user = {"user": "postgres", "group": "postgres"}
        shutil.chown(folder, "postgres", "postgres")
    quiet: dict[str, Any] = {"check": True, "stdout": subprocess.DEVNULL, "cwd": folder, **user}
    subprocess.run([programs[0] / "initdb", "-D", folder / "data", "-U", "skope", "-A", "trust"], **quiet)
    start = f"-c listen_addresses= -k {folder} -c fsync=off"
    server = [programs[0] / "pg_ctl", "-D", folder / "data", "-w"]
    subprocess.run([*server, "-l", folder / "log", "-o", start, "start"], **quiet)
    try:
        yield f"postgresql+psycopg://skope@/postgres?host={folder}"
    finally:
        subprocess.run([*server, "-m", "immediate", "stop"], **quiet)
        shutil.rmtree(folder)


def test_postgresql_has_the_rows_of_sqlite(station: Skope, postgres: str) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    Path("station.toml").write_text(STATION.format(address=postgres))
    for _ in range(2):
        code, _, err = station("eval", "station", "station.toml", "--once")
        assert (code, err) == (0, "")
    engine = sql.create_engine(postgres)
    with engine.connect() as connection:
        for name, rows in state().items():
            found = connection.execute(sql.text(f"select * from {name} order by 1, 2, 3")).fetchall()
            assert len(found) == len(rows) > 0
            for row, wanted in zip(found, rows, strict=True):
                assert [_plain(cell) for cell in row] == [_plain(cell) for cell in wanted]
    engine.dispose()


def _plain(cell: Any) -> Any:
    """A cell as text; times without their zone, which SQLite does not have."""
    if isinstance(cell, datetime):
        return str(cell.astimezone().replace(tzinfo=None)) if cell.tzinfo is None else _utc(cell)
    if isinstance(cell, str) and cell[:3] == "202" and ":" in cell:
        return _utc(datetime.fromisoformat(f"{cell}+00:00"))
    return f"{cell:.9g}" if isinstance(cell, float) else str(cell)


def _utc(moment: datetime) -> str:
    return f"{moment.timestamp():.3f}"


def test_an_unreachable_database_is_tried_again(station: Skope, monkeypatch: pytest.MonkeyPatch) -> None:
    read = read_station(Path("station.toml"))
    database = Database.open(read.database)
    tries: list[int] = []
    real = database.measured_days

    def fails_once(camera: str) -> Any:
        tries.append(1)
        if len(tries) == 1:
            raise UserError("database: gone")
        return real(camera)

    monkeypatch.setattr(database, "measured_days", fails_once)
    monkeypatch.setattr("skope.station.database.Database.open", lambda _: database)
    monkeypatch.setattr("skope.station.supervise.end_with_parent", lambda: None)
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("skope.eval.cli.station.time.sleep", wait)
    measure_station(5.0, Path("station.toml"))
    assert waits == [5.0, 5.0]
    assert len(tries) == 2
    assert len(database.days("north")) == 2


def test_recordings_that_overlap_are_left_out_and_the_day_is_measured(station: Skope) -> None:
    record("north/a2", "2026-11-26T10:00:20+01:00", 7)
    code, out, _ = station("eval", "station", "station.toml", "--once")
    assert code == 0
    assert "north/a2: overlaps the one before it; left out" in out
    assert "north: 2026-11-26: 2 recordings, 11 events" in out


def test_a_day_that_was_just_measured_waits(station: Skope) -> None:
    read = read_station(Path("station.toml"))
    database = Database.open(read.database)
    work = StationWork(read, database, not_needed)
    assert len(list(work.work_off())) == 2
    record("north/d", "2026-11-27T00:31:00+01:00", 3)
    with sqlite3.connect("traffic.db") as file:
        file.execute("update days set took_s = 100")
    assert list(work.work_off()) == []
    with sqlite3.connect("traffic.db") as file:
        file.execute("update days set took_s = 0")
    assert list(work.work_off()) == ["north: 2026-11-27: 2 recordings, 5 events"]


def test_tables_of_version_1_are_extended(station: Skope) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    wanted = state()
    with sqlite3.connect("traffic.db") as file:
        file.execute("drop table recordings")
        file.execute("alter table days drop column took_s")
        file.execute("update skope_schema set version = 1")
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    assert rows_of("select version from skope_schema") == [(2,)]
    assert state() == wanted


def test_recordings_have_a_row_each(station: Skope) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    rows = rows_of("select folder, begin, frames, observed_s, moved from recordings order by begin")
    assert [row[0] for row in rows] == ["a", "b", "c"]
    assert [row[2:] for row in rows] == [(600, pytest.approx(60.0), 0)] * 3
    assert rows[0][1].startswith("2026-11-26 09:00:00")


def test_days_that_are_no_longer_kept_lose_events_but_not_counts(station: Skope) -> None:
    assert station("eval", "station", "station.toml", "--once")[0] == 0
    counts = rows_of("select * from counts order by 1, 2, 3")
    now = datetime.now(UTC)
    record("north/new", now.isoformat(), 3)
    Path("station.toml").write_text("keep_days = 2\n" + STATION.format(address="sqlite:///traffic.db"))
    read = read_station(Path("station.toml"))
    of_stream = replace(read, cameras=tuple(replace(camera, stream="rtsp://camera") for camera in read.cameras))
    for kept in (read, of_stream):
        lines = list(StationWork(kept, Database.open(read.database), not_needed).work_off(rest=False))
        old = [
            row for row in rows_of("select day from events") if row[0] < (now - timedelta(days=2)).date().isoformat()
        ]
        assert old == []
        assert set(rows_of("select * from counts")) >= set(counts)
        assert Path("north/a").is_dir() == (kept is read), lines
    assert Path("north/new").is_dir()
    assert len(rows_of(f"select 1 from events where day = '{now.date()}'")) == 3
