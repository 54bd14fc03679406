"""Several recordings of one site on one time axis.

Second 0 is that of the earliest recording. Later recordings are placed by the clock, so the time between recordings is
a gap like any other. Positions keep the errors of the camera of their own recording. The start of a recording is given
or guessed from the name of its footage.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self
from zoneinfo import ZoneInfo

import numpy as np

from skope.errors import UserError
from skope.files.atomic import sha256_of
from skope.site.site_file import clock_problem
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
"""Date and time in a file name, as recorders write them. With a Z the time is UTC, otherwise local time at the road.
A time that is followed by a possible UTC offset, digits or letters does not match."""


def parse_start_time(given: str | datetime, site: "SiteFile", where: str) -> datetime:
    """Return the start time of footage as given by the user.

    Args:
        given: The time, with or without a zone.
        site: The site. Its zone applies to a time without a zone.
        where: Start of the error message.

    Returns:
        The time with its zone.

    Raises:
        UserError: `given` is not a time, a time zone is missing in both `given` and the site, or the local time is
            missing or ambiguous because of a clock change.
    """
    begin = given if isinstance(given, datetime) else time_of(given, where)
    if begin.tzinfo is not None:
        return local_time(begin, site)
    zone = _zone(site)
    if zone is None:
        raise UserError(
            f"{where}: expected a time with its UTC offset, like 2026-11-26T10:00:00+01:00, as {site.path} has no "
            f"time_zone; got {given}"
        )
    if problem := clock_problem(begin, zone):
        raise UserError(f"{where}: {given}: {problem}")
    return begin.replace(tzinfo=zone)


def begin_in_name(name: str, site: "SiteFile") -> datetime | None:
    """Return the time in a file name; None if the name has no time, or an ambiguous one.

    A time is ambiguous if the name has several, the site has no time zone, or the clocks change at that time.
    """
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
    return None if zone is None or clock_problem(begin, zone) else begin.replace(tzinfo=zone)


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
    """Decimal digits of times, seconds. Rounding gives the same moment the same number in all recordings."""


RECORDING_LIMITS: Final = RecordingLimits()

_LONGEST_SPAN: Final = timedelta(days=31)
"""Longest time between the starts of the first and the last recording. A longer time is probably a wrong date."""


@dataclass(frozen=True, kw_only=True)
class SiteRecording:
    """One of several recordings, with its position in the common report."""

    folder: Path
    """Folder of its tracks."""
    source: str
    """Name of its footage."""
    begin: datetime
    """Time of its own second 0, in the site's zone."""
    begin_s: float
    """Second of the report at its own second 0."""
    added: int
    """Offset that is added to the numbers of its tracks."""
    guessed: bool
    """Whether its start is guessed from the name of its footage."""
    late_s: float
    """Delay of its start so that it does not overlap the previous recording, seconds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedTraffic:
    """Tracks and observation of one or several recordings of a site."""

    tracks: tuple[Track, ...]
    observation: Observation
    start: datetime | None
    """Time of second 0; None if it is not known (only for a single recording)."""
    recordings: tuple[SiteRecording, ...] = ()
    """The recordings in order of time; empty for a single recording."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Placed:
    """Recording with its start time, before the recordings are ordered."""

    folder: Path
    observation: Observation
    begin: datetime
    guessed: bool

    def at(self, second: int) -> datetime:
        """Return the time at which its frames begin (`second` = 0) or end (1)."""
        return _later(self.begin, self.observation.extent[second])

    def until(self, time: datetime) -> Self:
        """Return the recording with its end at a time, if only the duration of its last frame is later."""
        end_s = _seconds(time, self.begin)
        if not self.observation.last_frame_s < end_s < self.observation.extent[1]:
            return self
        return replace(self, observation=replace(self.observation, end_s=end_s))


def read_recordings(
    folders: Sequence[Path], start_time: Sequence[str | datetime], site: "SiteFile", where: str
) -> RecordedTraffic:
    """Read the tracks of one or several recordings of a site.

    Args:
        folders: Folders that `skope eval track` wrote, in any order.
        start_time: Start of each recording, in the order of `folders`. If empty, `footage.json` has it, else the site
            file (for one recording) or the name of its footage (for several).
        site: The site.
        where: Name of `start_time` in messages.

    Raises:
        UserError: The start of one of several recordings is not known, two recordings overlap in time, or a file is
            missing or invalid.
    """
    if start_time and len(start_time) != len(folders):
        raise UserError(
            f"{where}: expected one time for each of {counted(len(folders), 'recording')}, in their order; got "
            f"{len(start_time)}"
        )
    starts: list[datetime | None] = [parse_start_time(given, site, where) for given in start_time]
    starts = starts or [None] * len(folders)
    if len(folders) == 1:
        return _only(folders[0], starts[0], site)
    placed = [_placed(folder, begin, site, where) for folder, begin in zip(folders, starts, strict=True)]
    placed.sort(key=lambda recording: (recording.at(0).astimezone(UTC), str(recording.folder)))
    _check(placed)
    recordings, parts, tracks = list[SiteRecording](), list[Observation](), list[Track]()
    added = 0
    for recording, late_s in _without_overlap(placed):
        begin_s = _seconds(recording.begin, recordings[0].begin if recordings else recording.begin)
        recordings.append(
            SiteRecording(
                folder=recording.folder,
                source=recording.observation.source,
                begin=recording.begin,
                begin_s=begin_s,
                added=added,
                guessed=recording.guessed,
                late_s=late_s,
            )
        )
        parts.append(_in_report(recording.observation, begin_s))
        recording_tracks = read_tracks(recording.folder / TRACKS_CSV)
        tracks += [
            replace(track, number=added + track.number, times_s=_at(track.times_s, begin_s))
            for track in recording_tracks
        ]
        added += max((track.number for track in recording_tracks), default=0)
    return RecordedTraffic(
        tracks=tuple(tracks),
        observation=_together(parts),
        start=recordings[0].begin,
        recordings=tuple(recordings),
    )


def recording_lines(recordings: Sequence[SiteRecording], observation: Observation) -> Iterator[str]:
    """Yield sentences on guessed or shifted start times, and on differences between the cameras."""
    if guessed := [recording for recording in recordings if recording.guessed]:
        first = guessed[0]
        yield (
            f"{len(guessed)} of {len(recordings)} recordings: the start is guessed from the name of the footage "
            f"({first.source!r}: {first.begin.isoformat(timespec='seconds')}); --start-time replaces the guess"
        )
    if late := [recording for recording in recordings if recording.late_s >= RECORDING_LIMITS.reported_s]:
        yield (
            f"{len(late)} of {len(recordings)} recordings begin up to "
            f"{max(recording.late_s for recording in late):.2f} s before the previous recording ends (first: "
            f"{late[0].folder}): they were shifted to begin at its end"
        )
    parts = observation.parts
    known = [part.common_scale_sigma for part in parts if part.common_scale_sigma is not None]
    if 0 < len(known) < len(parts):
        yield (
            f"speeds: only {len(known)} of {len(parts)} recordings have a camera with covariance; the intervals "
            "exclude the calibration error"
        )
    elif len(set(known)) > 1:
        yield (
            f"speeds: the calibration error is {min(known):.2%} in one recording and {max(known):.2%} in another: all "
            "intervals use the larger error"
        )
    cameras = [part.camera for part in parts if part.camera is not None]
    if any(camera.to_dict() != cameras[0].to_dict() for camera in cameras):
        yield (
            "recordings differ in the calibration of the camera: positions have the errors of their own recording; the "
            "recording with the smallest image of a gate decides which road users are too small there"
        )


def _only(folder: Path, given: datetime | None, site: "SiteFile") -> RecordedTraffic:
    observation = read_observation(folder)
    start = begin_of(given, observation, site) or local_start(site)
    return RecordedTraffic(tracks=tuple(read_tracks(folder / TRACKS_CSV)), observation=observation, start=start)


def begin_of(given: datetime | None, observation: Observation, site: "SiteFile") -> datetime | None:
    """Return the start time of a recording.

    Args:
        given: Start time given by the user; None: not given.
        observation: The recording, which may have its own start time.
        site: The site. The recording's own start time is converted to its zone.

    Returns:
        `given`, else the recording's own start time, else None.
    """
    return local_time(observation.start_time, site) if given is None and observation.start_time is not None else given


def _placed(folder: Path, given: datetime | None, site: "SiteFile", where: str) -> _Placed:
    observation = read_observation(folder)
    begin = begin_of(given, observation, site)
    guess = begin_in_name(observation.source, site) if begin is None else None
    if begin is None and guess is None:
        zone = "" if site.time_zone else f", and {site.path} has no time_zone"
        raise UserError(
            f"{folder}: the start time is not known: give {where} once for each recording, in their order "
            f"(the name of the footage, {observation.source!r:.60}, has no unambiguous time{zone})"
        )
    known = begin or guess
    assert known is not None
    return _Placed(folder=folder, observation=observation, begin=known, guessed=guess is not None)


def _check(placed: Sequence[_Placed]) -> None:
    """Raise a UserError if the recordings, in order of time, cannot share one report."""
    folders, contents = dict[Path, Path](), dict[str, Path]()
    for recording in placed:
        if not len(recording.observation.times_s) + len(recording.observation.camera_moved_s):
            raise UserError(f"{recording.folder / FOOTAGE_FILE}: times_s: expected at least one frame, found none")
        if recording.folder.resolve() in folders:
            raise UserError(f"{recording.folder}: given twice; name each recording once")
        folders[recording.folder.resolve()] = recording.folder
        path = recording.folder / TRACKS_CSV
        if _has_rows(path):
            same = contents.setdefault(sha256_of(path), path)
            if same != path:
                raise UserError(f"{path}: contains the same tracks as {same}; name each recording once")
        if recording.begin.astimezone(UTC) - placed[0].begin.astimezone(UTC) > _LONGEST_SPAN:
            raise UserError(
                f"{recording.folder}: begins at {recording.begin.isoformat(timespec='seconds')}, more than "
                f"{_LONGEST_SPAN.days} days after {placed[0].folder}: check the dates, or make a separate report of "
                "each"
            )


def _has_rows(path: Path) -> bool:
    """Return whether a file has a line after its header. The content is checked when it is read."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return len(list(islice(file, 2))) == 2


def _without_overlap(placed: Sequence[_Placed]) -> Iterator[tuple[_Placed, float]]:
    """Yield the recordings without overlap, and the delay of each, seconds.

    Raises:
        UserError: Two recordings overlap by more than `RECORDING_LIMITS.inexact_s`.
    """
    before: _Placed | None = None
    before_late_s = 0.0
    for recording in placed:
        late_s = 0.0
        if before is not None:
            before = before.until(recording.at(0))
            late_s = max(0.0, _seconds(before.at(1), recording.at(0)))
            yield before, before_late_s
        if before is not None and late_s > RECORDING_LIMITS.inexact_s:
            start_time, ends = (time.isoformat(timespec="seconds") for time in (recording.at(0), before.at(1)))
            raise UserError(
                f"{recording.folder}: begins at {start_time}, before {before.folder} ends ({ends}): recordings of one "
                "report must not overlap"
            )
        before, before_late_s = replace(recording, begin=_later(recording.begin, late_s)), late_s
    if before is not None:
        yield before, before_late_s


def _together(parts: Sequence[Observation]) -> Observation:
    """Return the observation of all recordings, with the largest scale error of their cameras."""
    sigmas = [math.inf if part.common_scale_sigma is None else part.common_scale_sigma for part in parts]
    return Observation(
        times_s=np.concatenate([part.times_s for part in parts]),
        source=f"{parts[0].source} to {parts[-1].source}",
        common_scale_sigma=max(sigmas) if math.isfinite(max(sigmas)) else None,
        camera_moved_s=np.concatenate([part.camera_moved_s for part in parts]),
        visibility_samples=np.concatenate([part.visibility_samples for part in parts]),
        parts=tuple(parts),
    )


def _in_report(observation: Observation, begin_s: float) -> Observation:
    """Return a recording's observation in seconds of the report."""
    visibility_samples = observation.visibility_samples.copy()
    visibility_samples[:, 0] = _at(visibility_samples[:, 0], begin_s)
    return replace(
        observation,
        times_s=_at(observation.times_s, begin_s),
        camera_moved_s=_at(observation.camera_moved_s, begin_s),
        turned=tuple((from_s + begin_s, camera) for from_s, camera in observation.turned),
        visibility_samples=visibility_samples,
        start_time=None,
    )


def _at(times_s: Array, begin_s: float) -> Array:
    return np.asarray(np.round(times_s + begin_s, RECORDING_LIMITS.time_digits))


def _later(time: datetime, seconds: float) -> datetime:
    """Return a time some seconds later. UTC is used because local time is not continuous when clocks change."""
    return (time.astimezone(UTC) + timedelta(seconds=seconds)).astimezone(time.tzinfo)


def _seconds(time: datetime, since: datetime) -> float:
    return (time.astimezone(UTC) - since.astimezone(UTC)).total_seconds()
