"""Measure the recordings of a station's cameras, day by day, and write the traffic into its database."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator
from datetime import date, datetime
from pathlib import Path
from typing import Final

from skope.errors import UserError
from skope.files.atomic import sha256_of
from skope.station.database import Database
from skope.station.station_file import Station, StationCamera
from skope.terminal.console import counted
from skope.tracks.csv_file import TRACKS_CSV
from skope.traffic.measure import measure
from skope.traffic.observation import FOOTAGE_FILE, read_observation
from skope.traffic.recordings import begin_in_name, begin_of, read_recordings
from skope.version import __version__

_TIME_KEY: Final = "start_time"


class StationWork:
    """Measures the days of a station whose recordings have changed."""

    def __init__(self, station: Station, database: Database) -> None:
        self._station, self._database = station, database
        self._begins: dict[tuple[Path, float], datetime | None] = {}
        """Start of each recording, by folder and time of its last change."""
        self._digests: dict[tuple[Path, float], str] = {}
        self._reported: set[Path] = set()
        """Recordings that were reported as left out."""

    def work_off(self) -> Iterator[str]:
        """Measure each day whose recordings are new or have changed, and yield a line for each.

        A recording without a start time, or that cannot be read, is left out. This is reported once.

        Raises:
            UserError: The database cannot be read or written.
        """
        for camera in self._station.cameras:
            measured = self._database.digests(camera.name)
            days = defaultdict[date, list[Path]](list)
            for folder in _recordings_of(camera):
                try:
                    begin = self._begin(folder, camera)
                except UserError as error:
                    yield from self._left_out(folder, f"{camera.name}: {error}; left out")
                    continue
                if begin is None:
                    yield from self._left_out(folder, f"{camera.name}: {folder}: its start time is not known; left out")
                else:
                    days[begin.date()].append(folder)
            for day, folders in sorted(days.items()):
                digest = self._digest(folders, camera)
                if measured.get(day) != digest:
                    yield from self._measure_day(camera, day, digest, folders)

    def _measure_day(self, camera: StationCamera, day: date, digest: str, folders: list[Path]) -> Iterator[str]:
        try:
            footage = read_recordings(folders, (), camera.site, _TIME_KEY)
            report = measure(
                footage.tracks, footage.observation, camera.site, footage.start, recordings=footage.recordings
            )
        except UserError as error:
            yield f"{camera.name}: {day}: not measured: {error}"
            return
        events = self._database.replace_day(camera.name, day, digest, len(folders), report)
        yield f"{camera.name}: {day}: {counted(len(folders), 'recording')}, {counted(events, 'event')}"

    def _left_out(self, folder: Path, line: str) -> Iterator[str]:
        if folder not in self._reported:
            self._reported.add(folder)
            yield line

    def _begin(self, folder: Path, camera: StationCamera) -> datetime | None:
        """Return the start of a recording, in the site's zone; None: not known."""
        key = (folder, (folder / FOOTAGE_FILE).stat().st_mtime)
        if key not in self._begins:
            observation = read_observation(folder)
            self._begins[key] = begin_of(None, observation, camera.site) or begin_in_name(
                observation.source, camera.site
            )
        return self._begins[key]

    def _digest(self, folders: list[Path], camera: StationCamera) -> str:
        """Return a digest of everything that determines the traffic of recordings."""
        parts = [__version__, camera.site_sha256]
        for file in (folder / name for folder in folders for name in (TRACKS_CSV, FOOTAGE_FILE)):
            key = (file, file.stat().st_mtime)
            if key not in self._digests:
                self._digests[key] = sha256_of(file)
            parts.append(self._digests[key])
        return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def _recordings_of(camera: StationCamera) -> list[Path]:
    """Return the folders of a camera's finished recordings, by name."""
    if not camera.tracks.is_dir():
        return []
    return sorted(
        folder
        for folder in camera.tracks.iterdir()
        if (folder / TRACKS_CSV).is_file() and (folder / FOOTAGE_FILE).is_file()
    )
