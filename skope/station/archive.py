"""Work off the archives of a station: each file in a folder of videos becomes a recording."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

from skope.errors import UserError
from skope.files import safe_names
from skope.station.station_file import Station, StationCamera

VIDEO_SUFFIXES: Final = (".mp4", ".mkv", ".avi", ".mov", ".ts", ".m4v", ".webm", ".asf")

Record = Callable[[Path, str, Path], None]
"""Function that detects and tracks a video: station file, name of the camera, video. It raises UserError."""
Engine = Callable[[Record, list[tuple[Path, str, Path]]], Iterator[tuple[Path, str]]]
"""Function that calls a `Record` for each task, and yields the video and the error (or "") of each, as it is done."""


def videos_left(camera: StationCamera) -> list[Path]:
    """Return the videos of a camera's archive that are no recordings yet, by name.

    Raises:
        UserError: The folder is missing.
    """
    if camera.videos is None:
        return []
    if not camera.videos.is_dir():
        raise UserError(f"{camera.videos}: no such folder (videos of camera {camera.name})")
    found = [path for path in camera.videos.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES]
    return [path for path in sorted(found, key=safe_names.counting_order) if not (camera.tracks / path.stem).is_dir()]


def record_archives(station: Station, record: Record, engine: Engine) -> Iterator[str]:
    """Make recordings of all videos that are none yet; yield a line for each.

    Raises:
        UserError: An archive cannot be read.
    """
    tasks = [(station.path, camera.name, video) for camera in station.cameras for video in videos_left(camera)]
    for number, (video, problem) in enumerate(engine(record, tasks), 1):
        yield f"{number} of {len(tasks)}: {video}: {f'not recorded: {problem}' if problem else 'recorded'}"


def in_this_process(record: Record, tasks: list[tuple[Path, str, Path]]) -> Iterator[tuple[Path, str]]:
    """Record one video after the other: an `Engine`."""
    for task in tasks:
        yield task[2], _problem_of(record, *task)


def _problem_of(record: Record, file: Path, name: str, video: Path) -> str:
    try:
        record(file, name, video)
    except UserError as error:
        return str(error)
    return ""


def on_ray(cluster: Callable[[], AbstractContextManager[Any]], threads: int) -> Engine:
    """Return an `Engine` whose tasks run on a Ray cluster; the machines share the disk.

    The task of a worker that was lost is repeated.

    Args:
        cluster: Connects to the cluster.
        threads: Number of processor cores of a task.
    """

    def engine(record: Record, tasks: list[tuple[Path, str, Path]]) -> Iterator[tuple[Path, str]]:
        with cluster() as ray:
            task_of = ray.remote(num_cpus=threads, max_retries=5)(_problem_of)
            left = {task_of.remote(record, *map(_whole, task)): task[2] for task in tasks}
            while left:
                (done,), _ = ray.wait(list(left), num_returns=1)
                video = left.pop(done)
                try:
                    yield video, ray.get(done)
                except ray.exceptions.RayError as error:
                    yield video, str(error).strip().splitlines()[-1]

    return engine


def _whole(value: Any) -> Any:
    """Return a path independent of the working folder, which workers do not share."""
    return value.resolve() if isinstance(value, Path) else value
