"""The page of a station: health of its cameras, and counts of today and of the last days."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final
from urllib.parse import quote

from skope.page.templates import Table, render, text_of
from skope.station.database import Database
from skope.station.health import CameraHealth
from skope.terminal.console import counted

DAYS_SHOWN: Final = 7
_EVERY: Final = "all"


@dataclass(frozen=True)
class _MeasuredCamera:
    """Notes and tables of a camera."""

    name: str
    notes: Sequence[str]
    tables: Sequence[Table]


def station_page(
    database: Database, health: Sequence[CameraHealth], pictures: Sequence[str] = (), query: str = ""
) -> str:
    """Return the page as HTML.

    Args:
        database: The database of the station.
        health: Health of all cameras.
        pictures: Names of the cameras that have a picture.
        query: Query of the page's address, which may have a token; addresses of pictures have it too.

    Raises:
        UserError: The database cannot be read.
    """
    return render(
        "station/station.html",
        title="Station",
        time=f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC",
        style=text_of("page/page.css"),
        cameras=_health_table(health),
        measured=[_measured(database, camera.camera) for camera in health],
        pictures={name: f"/api/cameras/{quote(name)}/picture?{query}" for name in pictures},
    )


def _health_table(health: Sequence[CameraHealth]) -> Table:
    head = ("camera", "state", "last frame (UTC)", "frames/s", "skipped", "delay", "in view", "restarts")
    rows = [
        (
            camera.camera,
            f"{camera.state}: {camera.message}" if camera.message else camera.state,
            "" if camera.last_frame is None else camera.last_frame[11:19],
            "" if camera.rate is None else f"{camera.rate:.1f}",
            "" if camera.skipped is None else f"{100 * camera.skipped:.0f}%",
            "" if camera.delay_s is None else f"{camera.delay_s:.1f} s",
            "" if camera.in_view is None else camera.in_view,
            camera.restarts,
        )
        for camera in health
    ]
    return Table(caption="Cameras", head=head, rows=rows, sticky=True)


def _measured(database: Database, camera: str) -> _MeasuredCamera:
    days = database.days(camera, DAYS_SHOWN)
    if not days:
        return _MeasuredCamera(camera, ["Nothing is measured yet."], [])
    newest, counts = days[0], {day["day"]: database.rows("counts", camera, day["day"]) for day in days}
    recordings = database.rows("recordings", camera, newest["day"])
    notes = [
        f"{newest['day']}: {counted(len(recordings), 'recording')}, measured at {newest['measured']:%H:%M:%S} UTC. "
        "The figures of a day that is not over are provisional."
    ]
    moved = [row for row in recordings if row["moved"]]
    if moved:
        notes.append(f"The camera was moved at {moved[-1]['begin']:%H:%M} UTC or soon after: check its site file.")
    tables = [_counts_table(f"Counts of {newest['day']}", counts[newest["day"]])]
    if len(days) > 1:
        tables.append(_days_table(counts))
    return _MeasuredCamera(camera, notes, tables)


def totals(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], dict[str, float | None]]:
    """Return the counts of a day by gate and direction, then by class; None where no interval was observed.

    Args:
        rows: Rows of the table `counts`.
    """
    found = defaultdict[tuple[str, str], dict[str, float | None]](dict)
    for row in rows:
        if row["lane"] == _EVERY:
            of_gate, count = found[row["gate"], row["direction"]], row["count"]
            before = of_gate.setdefault(row["class"], None)
            of_gate[row["class"]] = before if count is None else (before or 0) + count
    return dict(found)


def observed_minutes(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return the observed time and the length of the counting intervals of a day, in words."""
    intervals = {(row["begin_s"], row["end_s"]): row["observed_s"] or 0.0 for row in rows}
    length_s = math.fsum(end - begin for begin, end in intervals)
    return f"{math.fsum(intervals.values()) / 60:.0f} of {length_s / 60:.0f} min"


def _counts_table(caption: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    found = totals(rows)
    names = dict.fromkeys(name for of_gate in found.values() for name in of_gate)
    classes = [name for name in names if name not in (_EVERY, "vehicle")]
    shown = [name for name in classes if any(of_gate.get(name) for of_gate in found.values())]
    return Table(
        caption=f"{caption}: {observed_minutes(rows)} of its counting intervals are observed",
        sticky=True,
        head=("gate, direction", *shown, _EVERY),
        rows=[
            (f"{gate}, {direction}", *(_count(of_gate.get(name)) for name in shown), _count(of_gate.get(_EVERY)))
            for (gate, direction), of_gate in found.items()
        ],
    )


def _days_table(counts: Mapping[Any, Sequence[Mapping[str, Any]]]) -> Table:
    """Return the totals of each day by gate and direction."""
    by_day = {day: totals(rows) for day, rows in counts.items()}
    gates = list(dict.fromkeys(gate for found in by_day.values() for gate in found))
    rows = [
        (str(day), observed_minutes(counts[day]), *(_count(found.get(gate, {}).get(_EVERY)) for gate in gates))
        for day, found in by_day.items()
    ]
    head = ("day", "observed", *(f"{gate}, {direction}" for gate, direction in gates))
    return Table(caption=f"Last {len(by_day)} days", head=head, rows=rows, sticky=True)


def _count(value: float | None) -> str:
    return "not observed" if value is None else f"{value:.0f}"
