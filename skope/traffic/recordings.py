"""Several recordings of one site, put one after the other as if the camera had paused between them.

Second 0 is that of the earliest recording; all further ones count from there by the clock, so that what was not
recorded is a gap in the footage as any other is. Positions keep the errors of the camera of their own recording. The
begin of a recording is given, or guessed from the name of its footage.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final
from zoneinfo import ZoneInfo

import numpy as np

from skope.errors import UserError
from skope.files.atomic import sha256_of
from skope.site.site_file import clock_doubt
from skope.terminal.console import counted
from skope.tracks.csv_file import TRACKS_CSV, read_tracks
from skope.tracks.track import Track
from skope.traffic.counting_intervals import local_start, local_time, time_of
from skope.traffic.observation import FOOTAGE_FILE, Observation, read_observation
from skope.types import Array

if TYPE_CHECKING:
    from skope.site.site_file import SiteFile


_IN_NAME: Final = re.compile(
    r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]?(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d)(Z?)(?![\dA-Za-z])"
    r"(?![-+]\d\d:?\d\d(?!\d))"
)
"""Day and time in a name, as recorders write them; with a Z in UTC, else by the clocks at the road. What may be an
offset behind it, or a counter, leaves it in doubt."""


def parse_start_time(said: str | datetime, site: "SiteFile", where: str) -> datetime:
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


@dataclass(frozen=True)
class RecordingLimits:
    """Precision of the times of recordings."""

    inexact_s: float = 1.0
    """Largest overlap of two recordings, seconds. Recorders name files by whole seconds."""
    reported_s: float = 0.05
    """Shift of a recording that is reported, seconds."""
    time_digits: int = 6
    """Digits of times: microseconds, so that a moment has one number in all recordings."""


RECORDING_LIMITS: Final = RecordingLimits()

_LONGEST_SPAN: Final = timedelta(days=31)
"""From the begin of the first recording to that of the last one: more is rather a mistake in a date."""


@dataclass(frozen=True, kw_only=True)
class SiteRecording:
    """One of several recordings, and where it lies in the report of all."""

    folder: Path
    """The folder of its tracks."""
    source: str
    """Name of its footage."""
    begin: datetime
    """Time of its own second 0, in the site's zone."""
    begin_s: float
    """Second of the report that its own second 0 is."""
    added: int
    """Number that is added to those of its tracks."""
    guessed: bool
    """Whether its begin is guessed from the name of its footage."""
    late_s: float
    """By how much it is taken to begin later than that says, so that it begins when the one before it has ended."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedTraffic:
    """Content of one or several recordings of a site."""

    tracks: tuple[Track, ...]
    observation: Observation
    start: datetime | None
    """Time of second 0; None where that of a single recording is not known."""
    recordings: tuple[SiteRecording, ...] = ()
    """The recordings, where there are several, in the order of time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Placed:
    """A recording with when it began, not yet among the others."""

    folder: Path
    observation: Observation
    begin: datetime
    guessed: bool

    def at(self, second: int) -> datetime:
        """Time at which its frames begin (0) or end (1)."""
        return _later(self.begin, self.observation.extent[second])


def read_recordings(
    folders: Sequence[Path], start_time: Sequence[str | datetime], site: "SiteFile", where: str
) -> RecordedTraffic:
    """Read the tracks of one or several recordings of a site.

    Args:
        folders: Folders that `skope eval track` wrote, in any order.
        start_time: Start of each recording, in the order of `folders`. If empty, `footage.json` has it, else the site
            file (for one recording) or the name of its footage (for several).
        site: The site.
        where: What messages call `start_time`.

    Raises:
        UserError: It is not known when one of several began, two overlap in time, or a file is missing or wrong.
    """
    if start_time and len(start_time) != len(folders):
        raise UserError(
            f"{where}: expected a time for each of {counted(len(folders), 'recording')}, in their order, got "
            f"{len(start_time)}"
        )
    said: list[datetime | None] = [parse_start_time(one, site, where) for one in start_time]
    said = said or [None] * len(folders)
    if len(folders) == 1:
        return _only(folders[0], said[0], site)
    placed = [_placed(folder, begin, site, where) for folder, begin in zip(folders, said, strict=True)]
    placed.sort(key=lambda one: (one.at(0).astimezone(UTC), str(one.folder)))
    _check(placed)
    recordings, parts, tracks = list[SiteRecording](), list[Observation](), list[Track]()
    added = 0
    for one, late_s in _one_after_the_other(placed):
        begin_s = _seconds(one.begin, recordings[0].begin if recordings else one.begin)
        recordings.append(
            SiteRecording(
                folder=one.folder,
                source=one.observation.source,
                begin=one.begin,
                begin_s=begin_s,
                added=added,
                guessed=one.guessed,
                late_s=late_s,
            )
        )
        parts.append(_in_report(one.observation, begin_s))
        own = read_tracks(one.folder / TRACKS_CSV)
        tracks += [replace(track, number=added + track.number, times_s=_at(track.times_s, begin_s)) for track in own]
        added += max((track.number for track in own), default=0)
    return RecordedTraffic(
        tracks=tuple(tracks),
        observation=_together(parts),
        start=recordings[0].begin,
        recordings=tuple(recordings),
    )


def recording_lines(recordings: Sequence[SiteRecording], observation: Observation) -> Iterator[str]:
    """Sentences on how it is known when recordings began, and in what their cameras differ."""
    if guessed := [one for one in recordings if one.guessed]:
        first = guessed[0]
        yield (
            f"{len(guessed)} of {len(recordings)} recordings are taken to begin when the names of their footage say "
            f"({first.source!r}: {first.begin.isoformat(timespec='seconds')}): a guess, which --start-time replaces"
        )
    if late := [one for one in recordings if one.late_s >= RECORDING_LIMITS.reported_s]:
        yield (
            f"{len(late)} of {len(recordings)} recordings begin up to {max(one.late_s for one in late):.2f} s before "
            f"the one before has ended ({late[0].folder} is the first): they are taken to follow it"
        )
    parts = observation.parts
    known = [part.common_scale_sigma for part in parts if part.common_scale_sigma is not None]
    if 0 < len(known) < len(parts):
        yield f"speeds: how well the camera is known is said of {len(known)} of {len(parts)} recordings alone"
    elif len(set(known)) > 1:
        yield (
            f"speeds: the camera is known to {min(known):.2%} in one recording and to {max(known):.2%} in another: "
            "the intervals of all have the larger error"
        )
    cameras = [part.camera for part in parts if part.camera is not None]
    if any(one.to_dict() != cameras[0].to_dict() for one in cameras):
        yield (
            "recordings have other calibrations of the camera: places have the errors of their own; who is too small "
            "to be seen is told by the one that shows a gate the smallest"
        )


def _only(folder: Path, said: datetime | None, site: "SiteFile") -> RecordedTraffic:
    observation = read_observation(folder)
    start = begin_of(said, observation, site) or local_start(site)
    return RecordedTraffic(tracks=tuple(read_tracks(folder / TRACKS_CSV)), observation=observation, start=start)


def begin_of(said: datetime | None, observation: Observation, site: "SiteFile") -> datetime | None:
    """Time at which a recording begins, in the site's zone.

    Args:
        said: Begin as somebody says it; None: nobody does.
        observation: What the footage says of itself.
        site: Its zone is that of the result.

    Returns:
        What somebody says, else what the footage says; None: neither does.
    """
    return local_time(observation.start_time, site) if said is None and observation.start_time is not None else said


def _placed(folder: Path, said: datetime | None, site: "SiteFile", where: str) -> _Placed:
    observation = read_observation(folder)
    begin = begin_of(said, observation, site)
    guess = begin_in_name(observation.source, site) if begin is None else None
    if begin is None and guess is None:
        zone = "" if site.time_zone else f", and {site.path} has no time_zone"
        raise UserError(
            f"{folder}: not known when it begins: {where} says it once for each recording, in their order "
            f"(the name of the footage, {observation.source!r:.60}, does not tell it for sure{zone})"
        )
    known = begin or guess
    assert known is not None
    return _Placed(folder=folder, observation=observation, begin=known, guessed=guess is not None)


def _check(placed: Sequence[_Placed]) -> None:
    """Raise UserError where recordings, in order of time, cannot be of one report."""
    folders, contents = dict[Path, Path](), dict[str, Path]()
    for one in placed:
        if not len(one.observation.times_s) + len(one.observation.moved_s):
            raise UserError(f"{one.folder / FOOTAGE_FILE}: times_s: holds no frame")
        if one.folder.resolve() in folders:
            raise UserError(f"{one.folder}: is given twice")
        folders[one.folder.resolve()] = one.folder
        path = one.folder / TRACKS_CSV
        if _has_rows(path):
            same = contents.setdefault(sha256_of(path), path)
            if same != path:
                raise UserError(f"{path}: holds the same tracks as {same}")
        if one.begin.astimezone(UTC) - placed[0].begin.astimezone(UTC) > _LONGEST_SPAN:
            raise UserError(
                f"{one.folder}: begins at {one.begin.isoformat(timespec='seconds')}, more than {_LONGEST_SPAN.days} "
                f"days after {placed[0].folder}: make a report of each"
            )


def _has_rows(path: Path) -> bool:
    """Whether a file has a line after its first one; that it can be read is seen when it is."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return len(list(islice(file, 2))) == 2


def _one_after_the_other(placed: Sequence[_Placed]) -> Iterator[tuple[_Placed, float]]:
    """The recordings, none before the last one has ended, and by how much each was moved for that, seconds.

    Raises UserError where two overlap by more than their begins are known to.
    """
    before: _Placed | None = None
    for one in placed:
        late_s = 0.0 if before is None else max(0.0, _seconds(before.at(1), one.at(0)))
        if before is not None and late_s > RECORDING_LIMITS.inexact_s:
            start_time, ends = (time.isoformat(timespec="seconds") for time in (one.at(0), before.at(1)))
            raise UserError(
                f"{one.folder}: begins at {start_time}, before {before.folder} has ended ({ends}): recordings of one "
                "report may not overlap"
            )
        before = replace(one, begin=_later(one.begin, late_s))
        yield before, late_s


def _together(parts: Sequence[Observation]) -> Observation:
    """The observation of all recordings; of what their cameras differ in, what is least certain."""
    sigmas = [math.inf if part.common_scale_sigma is None else part.common_scale_sigma for part in parts]
    return Observation(
        times_s=np.concatenate([part.times_s for part in parts]),
        source=f"{parts[0].source} to {parts[-1].source}",
        common_scale_sigma=max(sigmas) if math.isfinite(max(sigmas)) else None,
        moved_s=np.concatenate([part.moved_s for part in parts]),
        visibility_samples=np.concatenate([part.visibility_samples for part in parts]),
        parts=tuple(parts),
    )


def _in_report(observation: Observation, begin_s: float) -> Observation:
    """A recording's observation in seconds of the report."""
    visibility_samples = observation.visibility_samples.copy()
    visibility_samples[:, 0] = _at(visibility_samples[:, 0], begin_s)
    return replace(
        observation,
        times_s=_at(observation.times_s, begin_s),
        moved_s=_at(observation.moved_s, begin_s),
        turned=tuple((from_s + begin_s, camera) for from_s, camera in observation.turned),
        visibility_samples=visibility_samples,
        start_time=None,
    )


def _at(times_s: Array, begin_s: float) -> Array:
    return np.asarray(np.round(times_s + begin_s, RECORDING_LIMITS.time_digits))


def _later(time: datetime, seconds: float) -> datetime:
    """So many seconds later, through UTC: on the day of a change the clock does not go on by itself."""
    return (time.astimezone(UTC) + timedelta(seconds=seconds)).astimezone(time.tzinfo)


def _seconds(time: datetime, since: datetime) -> float:
    return (time.astimezone(UTC) - since.astimezone(UTC)).total_seconds()
