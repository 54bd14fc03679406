"""Begin of a recording: as somebody says it, or guessed from the name of its footage."""

import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final
from zoneinfo import ZoneInfo

from skope.errors import UserError
from skope.site.local_times import clock_doubt
from skope.traffic.counting_intervals import local_time, time_of

if TYPE_CHECKING:
    from skope.site.site_file import SiteFile

_IN_NAME: Final = re.compile(
    r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]?(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d)(Z?)(?![\dA-Za-z])"
    r"(?![-+]\d\d:?\d\d(?!\d))"
)
"""Day and time in a name, as recorders write them; with a Z in UTC, else by the clocks at the road. What may be an
offset behind it, or a counter, leaves it in doubt."""


def said_begin(said: str | datetime, site: "SiteFile", where: str) -> datetime:
    """Read the time at which somebody says that footage begins.

    Args:
        said: The time, with or without a zone.
        site: Its zone is taken for a time that has none.
        where: What the message begins with.

    Returns:
        The time, in the site's zone where it has none of its own.

    Raises:
        UserError: It is no time, has no zone at all, or clocks show it never or twice.
    """
    begin = said if isinstance(said, datetime) else time_of(said, where)
    if begin.tzinfo is not None:
        return local_time(begin, site)
    zone = _zone(site)
    if zone is None:
        raise UserError(f"{where}: {said} has no zone, as 2026-11-26T10:00:00+01:00 has, and {site.path} no time_zone")
    if doubt := clock_doubt(begin, zone):
        raise UserError(f"{where}: {said}: {doubt}")
    return begin.replace(tzinfo=zone)


def begin_in_name(name: str, site: "SiteFile") -> datetime | None:
    """The time that a name has in it; None where it has none or several, or where clocks do not tell it for sure."""
    found = {match.groups() for match in _IN_NAME.finditer(name)}
    if len(found) != 1:
        return None
    *numbers, utc = found.pop()
    try:
        begin = datetime(*map(int, numbers))  # type: ignore[arg-type]
    except ValueError:
        return None
    if utc:
        return local_time(begin.replace(tzinfo=UTC), site)
    zone = _zone(site)
    return None if zone is None or clock_doubt(begin, zone) else begin.replace(tzinfo=zone)


def _zone(site: "SiteFile") -> ZoneInfo | None:
    return ZoneInfo(site.time_zone) if site.time_zone else None
