"""Time zone and start of the footage, as they are typed on the page."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final
from zoneinfo import ZoneInfo

from skope.site.local_times import clock_doubt
from skope.site.page.marks import Problem

FIELDS: Final = ("time_zone", "start")


@dataclass(frozen=True, kw_only=True)
class FootageTime:
    """Time at which the footage was taken, as far as the page says it."""

    time_zone: str | None
    start: datetime | None
    """With a zone of its own, or without where it is in `time_zone`."""
    problems: tuple[Problem, ...]


def read_time(document: Mapping[str, Any]) -> FootageTime:
    """Time zone and start of a document, texts or None, and what is wrong with them."""
    problems: list[Problem] = []

    def wrong(field: str, text: str) -> None:
        problems.append(Problem(kind="footage", index=0, field=field, text=text))

    name, zone = document.get("time_zone"), None
    if name not in (None, ""):
        zone = _zone(name)
        if zone is None:
            wrong("time_zone", 'expected a name like "Europe/Berlin"')
    text, start = document.get("start"), None
    if text not in (None, ""):
        try:
            start = datetime.fromisoformat(text.strip().replace(" ", "T", 1))
        except (AttributeError, ValueError):
            wrong("start", "expected date and time, like 2026-11-26 10:00:00")
    if start is not None and start.tzinfo is None:
        if zone is None and not problems:
            wrong("start", "type the time zone too")
        elif zone is not None and (doubt := clock_doubt(start, zone)):
            wrong("start", doubt)
    return FootageTime(time_zone=zone.key if zone else None, start=start, problems=tuple(problems))


def time_texts(time_zone: str | None, start: datetime | None) -> dict[str, str | None]:
    """`time_zone` and `start` of a document; a start in that zone is written without it."""
    if start is not None and time_zone is not None and getattr(start.tzinfo, "key", None) == time_zone:
        start = start.replace(tzinfo=None)
    return {"time_zone": time_zone, "start": None if start is None else start.isoformat(sep=" ")}


def _zone(name: Any) -> ZoneInfo | None:
    try:
        return ZoneInfo(name)
    except (ValueError, KeyError, OSError, TypeError):  # no such zone, a path, a folder of zones
        return None
