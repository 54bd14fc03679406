"""Track the complete windows of a station's streams, so that they become recordings."""

import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.errors import UserError
from skope.footage.predict_job import PROGRESS_FILE
from skope.station.station_file import StationCamera

Track = Callable[[Path, Path], Iterable[str]]
"""Function that tracks a folder of detections into another folder, as `skope eval track`."""


def complete_windows(camera: StationCamera) -> list[Path]:
    """Return the folders of the windows whose detections are complete, the earliest first."""
    return sorted(
        folder
        for folder in camera.seen.glob("[0-9]*")
        if (folder / FRAMES_FILE).is_file()
        and (folder / PREDICTIONS_FILE).is_file()
        and not (folder / PROGRESS_FILE).exists()
    )


def set_aside(camera: StationCamera, window: Path) -> Path:
    """Move the folder of a window that cannot be used to the folder `failed` of its camera; return its new path."""
    failed = camera.folder / "failed" / window.name
    failed.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(failed, ignore_errors=True)
    return window.rename(failed)


def track_windows(camera: StationCamera, track: Track) -> Iterator[str]:
    """Track each complete window, move its tracks to the recordings, and remove its detections.

    A window that cannot be tracked is moved to the folder `failed`, and a line on it is yielded. A run that is killed
    at any moment is repeated.
    """
    for seen in complete_windows(camera):
        finished = camera.tracks / seen.name
        if not finished.is_dir():
            shutil.rmtree(camera.tracking, ignore_errors=True)
            try:
                for _ in track(seen, camera.tracking / seen.name):
                    pass
            except UserError as error:
                yield f"{camera.name}: {seen.name}: not tracked: {error}; moved to {set_aside(camera, seen)}"
                continue
            camera.tracks.mkdir(parents=True, exist_ok=True)
            (camera.tracking / seen.name).rename(finished)
        shutil.rmtree(seen)
