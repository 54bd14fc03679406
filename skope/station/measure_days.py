"""Measure the recordings of a station's cameras, day by day, and write the traffic into its database."""

import hashlib
import shutil
import time
from collections import defaultdict
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Final

from skope.errors import UserError
from skope.files.atomic import sha256_of
from skope.station.database import Database, MeasuredDay, RecordingRow
from skope.station.station_file import Station, StationCamera
from skope.station.track_windows import Track, track_windows
from skope.terminal.console import counted
from skope.tracks.csv_file import TRACKS_CSV
from skope.traffic.measure import measure
from skope.traffic.observation import FOOTAGE_FILE, read_observation
from skope.traffic.recordings import RECORDING_LIMITS, begin_in_name, begin_of, read_recordings
from skope.version import __version__

_TIME_KEY: Final = "start_time"


@dataclass(frozen=True)
class MeasuringLimits:
    """Limits of the work of a station."""

    rest_factor: float = 20.0
    """A day that has grown is measured again after this many times the duration of its last measurement, so that the
    work on a camera takes at most a twentieth of a processor core."""


MEASURING_LIMITS: Final = MeasuringLimits()


class StationWork:
    """Tracks the windows of a station's streams, and measures the days whose recordings have changed."""

    def __init__(self, station: Station, database: Database, track: Track) -> None:
        """Prepare the work; `track` tracks a folder of detections."""
        self._station, self._database, self._track = station, database, track
        self._recordings: dict[tuple[Path, float], tuple[date, RecordingRow] | None] = {}
        """Each recording with its day, by folder and time of its last change; None: its start is not known."""
        self._digests: dict[tuple[Path, float], str] = {}
        self._reported: set[Path] = set()
        """Recordings that were reported as left out."""

    def work_off(self, *, rest: bool = True) -> Iterator[str]:
        """Track and measure what is new, and yield a line for each measured day and each problem.

        A recording without a start time, that cannot be read, or that overlaps an earlier one is left out. This is
        reported once.

        Args:
            rest: Whether a day that was measured shortly before waits (`MeasuringLimits.rest_factor`).

        Raises:
            UserError: The database cannot be read or written.
        """
        for camera in self._station.cameras:
            yield from track_windows(camera, self._track)
            measured = self._database.measured_days(camera.name)
            days = defaultdict[date, list[RecordingRow]](list)
            for folder in _recordings_of(camera):
                try:
                    dated = self._dated(folder, camera)
                except UserError as error:
                    yield from self._left_out(folder, f"{camera.name}: {error}; left out")
                    continue
                if dated is None:
                    yield from self._left_out(folder, f"{camera.name}: {folder}: its start time is not known; left out")
                else:
                    days[dated[0]].append(dated[1])
            yield from self._forget(camera, days)
            for day, recordings in sorted(days.items()):
                digest = self._digest(recordings, camera)
                last = measured.get(day)
                if last and (last.digest == digest or (rest and _rests(last))):
                    continue
                yield from self._measure_day(camera, day, digest, recordings)

    def _measure_day(
        self, camera: StationCamera, day: date, digest: str, recordings: list[RecordingRow]
    ) -> Iterator[str]:
        begun = time.monotonic()
        try:
            rows = yield from self._without_overlaps(camera, recordings)
            kept = [camera.tracks / row.folder for row in rows]
            footage = read_recordings(kept, (), camera.site, _TIME_KEY)
            # The database has no table of conflicts.
            report = measure(
                footage.tracks,
                footage.observation,
                camera.site,
                footage.start,
                search_conflicts=False,
                recordings=footage.recordings,
            )
        except UserError as error:
            yield f"{camera.name}: {day}: not measured: {error}"
            return
        took_s = time.monotonic() - begun
        events = self._database.replace_day(camera.name, day, MeasuredDay(digest, took_s), rows, report)
        yield f"{camera.name}: {day}: {counted(len(rows), 'recording')}, {counted(events, 'event')}"

    def _without_overlaps(
        self, camera: StationCamera, recordings: list[RecordingRow]
    ) -> Generator[str, None, list[RecordingRow]]:
        """Return the recordings that do not overlap an earlier one: a clock that is set back repeats times."""
        rows = list[RecordingRow]()
        for row in sorted(recordings, key=lambda row: (row.begin, row.folder)):
            last = rows[-1].end if rows else row.begin
            if (last - row.begin).total_seconds() > RECORDING_LIMITS.inexact_s:
                folder = camera.tracks / row.folder
                yield from self._left_out(folder, f"{camera.name}: {folder}: overlaps the one before it; left out")
            else:
                rows.append(row)
        return rows

    def _forget(self, camera: StationCamera, days: dict[date, list[RecordingRow]]) -> Iterator[str]:
        """Delete tracks, events and speeds of the days that are no longer kept; remove them from `days`.

        Folders of recordings that do not come from a stream of this station are kept.
        """
        keep_days = self._station.keep_days
        if keep_days is None:
            return
        first = datetime.now(UTC).date() - timedelta(days=keep_days)
        for day in [day for day in days if day < first]:
            recordings = days.pop(day)
            for recording in recordings if camera.stream is not None else ():
                shutil.rmtree(camera.tracks / recording.folder, ignore_errors=True)
        deleted = self._database.forget(camera.name, first)
        if deleted:
            yield f"{camera.name}: deleted {counted(deleted, 'event')} of the days before {first}"

    def _left_out(self, folder: Path, line: str) -> Iterator[str]:
        if folder not in self._reported:
            self._reported.add(folder)
            yield line

    def _dated(self, folder: Path, camera: StationCamera) -> tuple[date, RecordingRow] | None:
        """Return a recording with its day in the site's zone; None: its start is not known.

        Raises:
            UserError: It cannot be read.
        """
        key = (folder, (folder / FOOTAGE_FILE).stat().st_mtime)
        if key not in self._recordings:
            self._recordings[key] = _read_dated(folder, camera)
        return self._recordings[key]

    def _digest(self, recordings: list[RecordingRow], camera: StationCamera) -> str:
        """Return a digest of everything that determines the traffic of recordings."""
        parts = [__version__, camera.site_sha256]
        for file in (camera.tracks / row.folder / name for row in recordings for name in (TRACKS_CSV, FOOTAGE_FILE)):
            key = (file, file.stat().st_mtime)
            if key not in self._digests:
                self._digests[key] = sha256_of(file)
            parts.append(self._digests[key])
        return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def _read_dated(folder: Path, camera: StationCamera) -> tuple[date, RecordingRow] | None:
    observation = read_observation(folder)
    begin = begin_of(None, observation, camera.site) or begin_in_name(observation.source, camera.site)
    if begin is None:
        return None
    first, last = (begin.astimezone(UTC) + timedelta(seconds=second) for second in observation.extent)
    return begin.date(), RecordingRow(
        begin=first,
        end=last,
        folder=folder.name,
        frames=len(observation.times_s),
        observed_s=observation.observed_s,
        moved=bool(len(observation.camera_moved_s) or observation.turned),
    )


def _rests(last: MeasuredDay) -> bool:
    """Return whether a day was measured too shortly before to be measured again."""
    if last.measured is None:
        return False
    return datetime.now(UTC) < last.measured + timedelta(seconds=MEASURING_LIMITS.rest_factor * last.took_s)


def _recordings_of(camera: StationCamera) -> list[Path]:
    """Return the folders of a camera's finished recordings, by name."""
    if not camera.tracks.is_dir():
        return []
    return sorted(
        folder
        for folder in camera.tracks.iterdir()
        if (folder / TRACKS_CSV).is_file() and (folder / FOOTAGE_FILE).is_file()
    )
