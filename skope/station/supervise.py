"""Run a station: one process per stream, one that tracks and measures, and the publishers."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Final, Protocol

from skope.errors import UserError
from skope.files.atomic import hold_lock
from skope.station.health import CameraHealth, health_of
from skope.station.station_file import Station
from skope.terminal.console import Console


@dataclass(frozen=True)
class SupervisionLimits:
    """Waiting times of a station."""

    round_s: float = 5.0
    """Time between two rounds of supervision and publishing, seconds."""
    first_pause_s: float = 1.0
    """Time before a process that ended is started again, seconds; it doubles with each further end."""
    longest_pause_s: float = 60.0
    """Maximum of this time, seconds. A process that ran that long starts with the first pause again."""
    patience_s: float = 20.0
    """Maximum time to wait for a process at the end of the station, seconds; then it is killed."""


SUPERVISION_LIMITS: Final = SupervisionLimits()


class Publisher(Protocol):
    """Publishes the state of a station."""

    def publish(self, health: Sequence[CameraHealth]) -> None:
        """Publish the health of all cameras, and what was measured since the last call. Does not raise UserError."""

    def close(self) -> None:
        """End connections."""


@dataclass
class _Supervised:
    """A process that is started again when it ends."""

    name: str
    target: Callable[..., None]
    args: tuple[object, ...]
    process: SpawnProcess | None = None
    starts: int = 0
    begun_s: float = 0.0
    pause_s: float = field(default=SUPERVISION_LIMITS.first_pause_s)
    due_s: float = 0.0

    def look_after(self, console: Console) -> None:
        """Start the process if it is due. Report if it has ended."""
        now = time.monotonic()
        if self.process is not None and not self.process.is_alive():
            code = self.process.exitcode
            self.process = None
            long_lived = now - self.begun_s > SUPERVISION_LIMITS.longest_pause_s
            self.pause_s = SUPERVISION_LIMITS.first_pause_s if long_lived else self.pause_s
            self.due_s = now + self.pause_s
            console.warn(f"{self.name}: its process ended with code {code}; starting again in {self.pause_s:.0f} s")
            self.pause_s = min(2 * self.pause_s, SUPERVISION_LIMITS.longest_pause_s)
        if self.process is None and now >= self.due_s:
            self.process = multiprocessing.get_context("spawn").Process(target=self.target, args=self.args)
            self.process.start()
            self.starts, self.begun_s = self.starts + 1, now


@contextmanager
def held_station(station: Station) -> Iterator[None]:
    """Hold the lock of a station's folder; use as a context manager.

    Raises:
        UserError: Another process runs this station.
    """
    station.folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold_lock(station.folder / ".lock")
    except BlockingIOError:
        raise UserError(f"{station.path}: another process runs this station") from None
    with lock:
        yield


class Supervisor:
    """Keeps the processes of a station running until it is stopped."""

    def __init__(
        self,
        station: Station,
        watch: Callable[[Path, str], None],
        work: Callable[[Path], None],
        publishers: Sequence[Publisher],
        console: Console,
    ) -> None:
        """Prepare the processes.

        Args:
            station: The station.
            watch: Reads the stream of a camera of a station file; runs in a process of its own, as `work` does.
            work: Tracks and measures the recordings of a station file, for as long as it runs.
            publishers: Called in each round.
            console: Console for messages.
        """
        self._station, self._publishers, self._console = station, publishers, console
        self._cameras = {
            camera.name: _Supervised(camera.name, watch, (station.path, camera.name))
            for camera in station.cameras
            if camera.stream is not None
        }
        self._work = _Supervised("measuring", work, (station.path,))
        self._stopped = threading.Event()

    def health(self) -> list[CameraHealth]:
        """Return the health of all cameras."""
        restarts = {name: max(0, process.starts - 1) for name, process in self._cameras.items()}
        return [health_of(camera, restarts.get(camera.name, 0)) for camera in self._station.cameras]

    def run(self) -> None:
        """Run until SIGINT or SIGTERM, then end all processes: each writes what it has."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self._stopped.set())
        try:
            while not self._stopped.is_set():
                for process in self._processes:
                    process.look_after(self._console)
                for publisher in self._publishers:
                    publisher.publish(self.health())
                self._stopped.wait(SUPERVISION_LIMITS.round_s)
        finally:
            self._end()

    @property
    def _processes(self) -> list[_Supervised]:
        return [*self._cameras.values(), self._work]

    def _end(self) -> None:
        running = [process.process for process in self._processes if process.process is not None]
        for process in running:
            process.terminate()
        until = time.monotonic() + SUPERVISION_LIMITS.patience_s
        for process in running:
            process.join(max(0.1, until - time.monotonic()))
            if process.is_alive():
                process.kill()
        for publisher in self._publishers:
            publisher.close()


def end_with_parent() -> None:
    """Prepare a process of a station: SIGTERM and the end of its parent raise KeyboardInterrupt.

    SIGINT is ignored, because a terminal sends it to all processes at once.
    """

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def watch() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGTERM, interrupt)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()
