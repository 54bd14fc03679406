"""Local times: what clocks at a road show, which is ambiguous or impossible where they are put back or forward."""

from datetime import UTC, datetime
from typing import Final
from zoneinfo import ZoneInfo

_FOOTAGE_YEARS: Final = range(1900, 2900)
"""Years in which footage may begin. Times near year 1 or 9999 have no counterpart in other zones."""


def year_doubt(time: datetime) -> str:
    """Message about a year in which no footage was taken; empty for other years."""
    if time.year in _FOOTAGE_YEARS:
        return ""
    return f"expected a year from {_FOOTAGE_YEARS.start} to {_FOOTAGE_YEARS.stop - 1}, got {time.year}"


def clock_doubt(time: datetime, zone: ZoneInfo) -> str:
    """Check a local time against the clocks of its zone.

    Args:
        time: The time, without an offset.
        zone: The zone that it belongs to.

    Returns:
        A message: clocks skip the time, show it twice, or its year is impossible; empty where nothing is wrong.
    """
    if doubt := year_doubt(time):
        return doubt
    first, second = (time.replace(tzinfo=zone, fold=fold) for fold in (0, 1))
    if first.astimezone(UTC).astimezone(zone).replace(tzinfo=None) != time:
        return f"there is no such time in {zone.key}: clocks are put forward then"
    if first.utcoffset() != second.utcoffset():
        ways = " or ".join(f"{one.isoformat(sep=' ')}" for one in (first, second))
        return f"clocks show this twice, as they are put back: type {ways}"
    return ""
