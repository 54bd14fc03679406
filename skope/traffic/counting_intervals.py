"""Divide footage into counting intervals by the clock, also on days of 23 and 25 hours."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from typing import TYPE_CHECKING, Any, Final
from zoneinfo import ZoneInfo

from skope.errors import UserError
from skope.site.site_file import year_problem

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts

CLOCK_STEP: Final = timedelta(seconds=1)
"""Precision of the search for a clock change. Clocks change at whole seconds."""


@dataclass(frozen=True, kw_only=True)
class ClockInterval:
    """Counting interval: part of the footage from `begin_s` up to but excluding `end_s`, seconds of the footage."""

    begin_s: float
    end_s: float
    begin: datetime | None
    """Start time, in the site's zone; None if the time of the footage is not known."""
    end: datetime | None


def local_start(site: "SiteParts") -> datetime | None:
    """Return the start time of the footage in the site file, in the site's zone; None if there is none."""
    return None if site.start is None else local_time(site.start, site)


def local_time(time: datetime, site: "SiteParts") -> datetime:
    """Return a time, converted to the site's time zone if that is known."""
    return time.astimezone(ZoneInfo(site.time_zone)) if site.time_zone else time


def time_of(text: Any, where: str, like: str = "2026-11-26T10:00:00") -> datetime:
    """Read a time.

    Args:
        text: A time in ISO 8601 format, with or without a zone.
        where: Start of the error message.
        like: An example for the message.

    Raises:
        UserError: The text is no such time, or the year is implausible for footage.
    """
    try:
        time = datetime.fromisoformat(text)
    except (TypeError, ValueError):
        time = datetime.min
    if year_problem(time):
        raise UserError(f"{where}: expected a time like {like}, got {text!r:.40}")
    return time


def clock_intervals(start: datetime | None, begin_s: float, end_s: float, minutes: int) -> list[ClockInterval]:
    """Return the counting intervals that overlap the footage from `begin_s` to `end_s`.

    Intervals begin at multiples of `minutes` from midnight. An interval ends at a clock change, where the next interval
    begins. No interval is therefore longer than `minutes`, and the repeated hour in autumn has its intervals twice.

    Args:
        start: Time of second 0 of the footage; None: intervals begin at second 0.
        begin_s: Start of the footage, seconds.
        end_s: End of the footage, seconds.
        minutes: Length of an interval, minutes.
    """
    if start is None:
        size = 60.0 * minutes
        first, last = int(begin_s // size), int(max(begin_s, end_s - 1e-9) // size)
        return [
            ClockInterval(begin_s=k * size, end_s=(k + 1) * size, begin=None, end=None) for k in range(first, last + 1)
        ]
    zone = start.tzinfo
    assert zone is not None
    zero = start.astimezone(UTC)
    at, until = zero + timedelta(seconds=begin_s), zero + timedelta(seconds=end_s)
    out: list[ClockInterval] = []
    while not out or at < until:
        begin, end = _around(at, zone, minutes)
        out.append(
            ClockInterval(
                begin_s=(begin - zero).total_seconds(),
                end_s=(end - zero).total_seconds(),
                begin=begin.astimezone(zone),
                end=end.astimezone(zone),
            )
        )
        at = end
    return out


def _around(at: datetime, zone: tzinfo, minutes: int) -> tuple[datetime, datetime]:
    """Return start and end, in UTC, of the counting interval that contains an instant in UTC."""
    offset = _offset(at, zone)
    wall = (at + offset).replace(tzinfo=None)
    midnight = wall.replace(hour=0, minute=0, second=0, microsecond=0)
    size = timedelta(minutes=minutes)
    first = (midnight + (wall - midnight) // size * size).replace(tzinfo=UTC) - offset
    begin, end = first, first + size
    if _offset(begin, zone) != offset:
        begin = _change(begin, at, zone)
    if _offset(end - CLOCK_STEP, zone) != offset:
        end = _change(at, end, zone)
    return begin, end


def _offset(at: datetime, zone: tzinfo) -> timedelta:
    offset = at.astimezone(zone).utcoffset()
    assert offset is not None
    return offset


def _change(before: datetime, after: datetime, zone: tzinfo) -> datetime:
    """Return the first second, in UTC, that no longer has the UTC offset of `before`."""
    low, high = 0, int((after - before) / CLOCK_STEP) + 1
    was = _offset(before, zone)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _offset(before + middle * CLOCK_STEP, zone) == was else (low, middle)
    return (before + high * CLOCK_STEP).replace(microsecond=0)
