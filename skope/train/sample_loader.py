"""Load training samples in this process or in worker processes, without losing samples if a worker ends.

Workers pass images in shared memory, which is small in containers (64 MB): their number is limited accordingly. If a
worker ends or stops responding, fewer workers continue with the remaining samples.
"""

import itertools
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
from torch.utils.data import DataLoader, Sampler

from skope.errors import UserError
from skope.terminal.console import Console, disk_size
from skope.train.step import ignore_signals
from skope.train.training_samples import Draw, TrainingSample, TrainingSet

DrawGroup = Sequence[Draw]
"""Requests for the samples that are loaded together."""

SHARED_MEMORY: Final = Path("/dev/shm")


@dataclass(frozen=True)
class LoaderLimits:
    """Memory and waiting times of the loading processes."""

    prefetch: tuple[int, int] = (4, 2)
    """Number of batches that each process prepares: the usual value, and the value if memory is scarce."""
    memory_share: float = 0.8
    """Share of the free shared memory that is used."""
    poll_s: float = 5.0
    """Interval at which a stop is checked for while no batch arrives, seconds."""
    silent_s: float = 120.0
    """Time without a batch after which the loading processes count as lost, seconds."""


LOADER_LIMITS: Final = LoaderLimits()


class Loader:
    """Loader of groups of samples from a training set, in order."""

    def __init__(
        self,
        training_set: TrainingSet,
        *,
        workers: int,
        console: Console,
        pin: bool = False,
        stopping: Callable[[], bool] = lambda: False,
    ) -> None:
        """Create a loader.

        Args:
            training_set: The images.
            workers: Number of worker processes; 0: this process loads.
            console: Receives a warning if fewer workers run than requested.
            pin: Whether batches are in pinned memory, from which a GPU copies asynchronously.
            stopping: Returns whether to stop waiting for a batch, with a KeyboardInterrupt.
        """
        self.workers = workers
        self._training_set, self._console, self._pin, self._stopping = training_set, console, pin, stopping

    def batches(self, groups: Iterable[DrawGroup], largest: int) -> Iterator[list[TrainingSample]]:
        """Yield the samples of each group of requests. `largest` is the size of the largest group.

        Groups are requested when they are needed. They can span many epochs, without a restart of the workers.

        Raises:
            UserError: A file of the dataset is wrong.
        """
        left = iter(groups)
        asked = deque(itertools.islice(left, 1))
        prefetch = self._fit(largest)
        while asked:
            try:
                # First the samples that were requested but not received when processes were lost, then the others.
                for batch in self._loaded(_noted([*asked], left, asked), prefetch):
                    for item in batch:
                        if isinstance(item, UserError):
                            raise item
                    asked.popleft()
                    yield [item for item in batch if isinstance(item, TrainingSample)]
            except _LostError as lost:
                self.workers //= 2
                rest = f"{self.workers} continue" if self.workers else "this process loads them from here"
                self._console.warn(f"processes that load images {lost}: {rest} (--workers)")

    def _loaded(self, groups: Iterator[DrawGroup], prefetch: int) -> Iterator[list[TrainingSample | UserError]]:
        loader = DataLoader(
            self._training_set,
            batch_sampler=_Batches(groups),
            num_workers=self.workers,
            collate_fn=list,
            pin_memory=self._pin,
            prefetch_factor=prefetch if self.workers else None,
            worker_init_fn=_begin_loading,
            timeout=LOADER_LIMITS.poll_s if self.workers else 0,
        )
        batches = iter(loader)
        if self.workers and threading.current_thread() is threading.main_thread():
            # If a process is lost, torch raises an exception at an arbitrary place. Below, the loss is detected while
            # waiting.
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        since = time.monotonic()
        while True:
            try:
                batch = next(batches)
            except StopIteration:
                return
            except (RuntimeError, EOFError, ConnectionError) as error:
                # A process that ends while it transfers a batch breaks its connection.
                if isinstance(error, RuntimeError) and "DataLoader" not in str(error):
                    raise
                ended, silent = "timed out" not in str(error), time.monotonic() - since > LOADER_LIMITS.silent_s
                if not (ended or silent or self._stopping()):
                    continue
                for process in getattr(batches, "_workers", ()):  # they ignore the signal that torch would send
                    process.kill()
                if not (ended or silent):
                    raise KeyboardInterrupt from None
                how = (
                    "have ended: out of memory, or killed"
                    if ended
                    else f"have sent nothing for {LOADER_LIMITS.silent_s:.0f} s"
                )
                raise _LostError(how) from error
            yield batch
            since = time.monotonic()

    def _fit(self, images: int) -> int:
        """Reduce the number of processes to fit into shared memory; return the number of batches per process."""
        if not self.workers:
            return 0
        free, batch = free_shared_memory(), images * self._training_set.largest_image
        if free is None or not batch:
            return LOADER_LIMITS.prefetch[0]
        room = int(LOADER_LIMITS.memory_share * free / int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
        for prefetch in LOADER_LIMITS.prefetch:
            # One more is in preparation, and one is in use.
            if self.workers * (prefetch + 2) * batch <= room:
                return prefetch
        prefetch = LOADER_LIMITS.prefetch[-1]
        wanted, self.workers = self.workers, room // ((prefetch + 2) * batch)
        self._console.warn(
            f"{SHARED_MEMORY} has room for {disk_size(free)}, too little for {wanted} processes that load images of "
            f"{disk_size(batch)} a step: {self.workers or 'none beside this one'} will (in a container: docker run "
            "--shm-size=2g)"
        )
        return prefetch


def _noted(again: Sequence[DrawGroup], left: Iterator[DrawGroup], asked: deque[DrawGroup]) -> Iterator[DrawGroup]:
    """Yield groups that are requested again, then the remaining ones, which are recorded in `asked`."""
    yield from again
    for group in left:
        asked.append(group)
        yield group


class _Batches(Sampler[list[Draw]]):
    """Sampler for torch that yields groups of sample requests."""

    def __init__(self, groups: Iterator[DrawGroup]) -> None:
        self._groups = groups

    def __iter__(self) -> Iterator[list[Draw]]:
        return map(list, self._groups)


class _LostError(Exception):
    """Error for lost loading processes; the text describes the loss."""


def free_shared_memory() -> int | None:
    """Return the number of free bytes in shared memory; None if the system does not report it."""
    try:
        found = os.statvfs(SHARED_MEMORY)
    except (OSError, AttributeError):
        return None
    return found.f_bavail * found.f_frsize


def _begin_loading(worker: int) -> None:
    """Set up a loading process: no threads of OpenCV, because there is a process for each core."""
    ignore_signals(worker)
    # 0 and not 1: setting 1 waits for threads that exist only in the parent of the fork.
    cv2.setNumThreads(0)
