"""Worker processes of this machine, which simulate and render a dataset's recordings, and their job queue."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any, Final, Protocol

from skope.errors import UserError
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output.frames import Encoding, frames_of
from skope.gen.pipeline.dataset_store import Store
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import Renderer
from skope.gen.render.gl.context import WORKER_VARIABLE
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, RecordingInfo, RecordingPlan
from skope.gen.simulation.simulate import simulate_together


@dataclass(frozen=True)
class WorkerTimes:
    """Size of a job, and polling interval."""

    frames_per_job: int = 8
    """Number of frames per job; small, so that no worker is idle for long at the end."""
    listen_s: float = 0.2
    """Polling interval for messages of busy workers, seconds."""


WORKER_TIMES: Final = WorkerTimes()


@dataclass(frozen=True)
class RenderJobSpec:
    """Settings for rendering, labelling and writing a dataset's frames."""

    renderer: str
    """Renderer: "gl" or "pybullet"."""
    driver: str
    """Name of the required driver, from `choose_renderer`. The images would differ with another driver."""
    rules: Rules
    encoding: Encoding


@dataclass(frozen=True)
class RenderJob:
    """Some frames of a recording that one worker renders together."""

    recording: RecordingInfo
    frames: tuple[int, ...]


class WorkerPool(Protocol):
    """One or more workers that simulate and render into a store; everything that they report is already written."""

    def simulate(self, store: Store, simulations: Iterable[Sequence[RecordingPlan]]) -> Iterator[int]:
        """Make the recordings of each simulation; yield the number of new recordings after each job."""
        ...

    def render(
        self,
        store: Store,
        missing: Mapping[RecordingInfo, list[int]],
        spec: RenderJobSpec,
        on_light: Callable[[str], None],
    ) -> Iterator[int]:
        """Render the `missing` frames of each recording; yield the number of new frames after each job.

        `on_light` is called with the site of each part of a light that a worker begins to compute. Workers of a Ray
        cluster do not call it.
        """
        ...


class JobQueue:
    """Queue of frames to render, in an order in which workers seldom change recording and town.

    A worker first gets the rest of its own recording, then an unassigned recording, and then part of the recording with
    the most jobs left. Recordings of a town follow each other, and a worker keeps loaded towns in memory. The next
    recording of a worker is therefore the one after its last recording. If that is assigned, it is the middle of the
    longest run of unassigned recordings. If `views` recordings share a town, it is the first recording of that town.
    """

    def __init__(
        self, missing: Mapping[RecordingInfo, list[int]], chunk: int = WORKER_TIMES.frames_per_job, views: int = 0
    ) -> None:
        self._left = {
            recording: deque(RenderJob(recording, tuple(frames[i : i + chunk])) for i in range(0, len(frames), chunk))
            for recording, frames in missing.items()
            if frames
        }
        self._order = list(self._left)
        self._position = {recording: position for position, recording in enumerate(self._order)}
        self._views = views
        self._untouched = {0: len(self._order)} if self._order else {}
        """Runs of unassigned recordings as positions in `_order`: first position -> last position + 1."""

    def __bool__(self) -> bool:
        return bool(self._left)

    def next_for(self, holding: RecordingInfo | None) -> RenderJob:
        """Return the next job of a worker; `holding` is the recording of its last job, or None before the first."""
        recording = holding
        if recording not in self._left:
            if self._untouched:
                recording = self._order[self._claim_position(0 if recording is None else self._position[recording] + 1)]
            else:
                recording = max(self._left, key=lambda t: len(self._left[t]))
        assert recording is not None
        job = self._left[recording].popleft()
        if not self._left[recording]:
            del self._left[recording]
        return job

    def _claim_position(self, wanted: int) -> int:
        """Take a recording out of `_untouched` and return its position in `_order`.

        It is the recording at `wanted` if a run begins there, else one in the middle of the longest run.
        """
        at = begin = wanted
        if wanted not in self._untouched:
            begin = max(self._untouched, key=lambda begin: self._untouched[begin] - begin)
            at = self._begin_of_town(begin, (begin + self._untouched[begin]) // 2)
        end = self._untouched.pop(begin)
        for first, last in ((begin, at), (at + 1, end)):
            if first < last:
                self._untouched[first] = last
        return at

    def _begin_of_town(self, first: int, middle: int) -> int:
        """Return the position of the first recording of the town at `middle`; `middle` if `first` has the same town."""

        def town(position: int) -> tuple[str, int]:
            recording = self._order[position]
            return recording.site, int(recording.name) // self._views

        if self._views == 0 or town(first) == town(middle):
            return middle
        return next(position for position in range(first, middle + 1) if town(position) == town(middle))

    def put_back(self, job: RenderJob) -> None:
        """Return a job to the queue after its worker was lost."""
        self._left.setdefault(job.recording, deque()).appendleft(job)


# --------------------------------------------------------------------------------------------------- what a worker does


def simulate_job(root: Path, plans: Sequence[RecordingPlan]) -> int:
    """Simulate recordings that share their traffic, and write them to the dataset folder `root`.

    Returns the number of recordings. Existing recordings are kept.
    """
    store = Store(root)
    for plan, recording in zip(plans, simulate_together(plans), strict=True):
        if not store.recorded(plan.info):
            store.write_recording(plan.info, recordings.packed_recording(recording))
    return len(plans)


def render_job(root: Path, spec: RenderJobSpec, job: RenderJob, on_light: Callable[[str], None]) -> int:
    """Render a job's frames and write them to the dataset folder `root`; return their number."""
    store = Store(root)
    path = store.recording_path(job.recording)
    source, renderer = _open_recording(path, path.stat().st_mtime_ns, spec.renderer, on_light)
    for frame in frames_of(source, renderer, spec.rules, spec.encoding, job.frames):
        store.write_frame(frame)
    return len(job.frames)


def _render_in_worker(root: Path, spec: RenderJobSpec, job: RenderJob) -> int:
    """Run `render_job` in a worker process, which reports lights to the main process."""
    return render_job(root, spec, job, _tell_lighting)


def _tell_lighting(site: str) -> None:
    _lit_sites.put(site)


_lit_sites: "SimpleQueue[str]"
"""Queue of a worker process for site names: it adds a site when it starts to compute its light."""


@lru_cache(maxsize=1)
def _open_recording(
    path: Path, _changed: int, renderer: str, on_light: Callable[[str], None]
) -> tuple[Recording, Renderer]:
    """Return a recording and its renderer; both are kept until the recording or its file (`_changed`, ns) changes."""
    source = recordings.load(path)
    return source, make_renderer(renderer, source, partial(on_light, source.site))


# ------------------------------------------------------------------------------------------------------ on this machine


class InProcessPool:
    """A pool without worker processes: this process simulates and renders."""

    def simulate(self, store: Store, simulations: Iterable[Sequence[RecordingPlan]]) -> Iterator[int]:
        return (simulate_job(store.root, plans) for plans in simulations)

    def render(
        self,
        store: Store,
        missing: Mapping[RecordingInfo, list[int]],
        spec: RenderJobSpec,
        on_light: Callable[[str], None],
    ) -> Iterator[int]:
        queue, recording = JobQueue(missing, views=store.plan.parameters.variation.views), None
        while queue:
            job = queue.next_for(recording)
            recording = job.recording
            yield render_job(store.root, spec, job, on_light)


@dataclass
class _Worker:
    """One worker process, and the recording that it keeps open."""

    pool: ProcessPoolExecutor
    recording: RecordingInfo | None = None


class ProcessPool:
    """A pool of `count` worker processes on this machine, with one thread each."""

    def __init__(self, count: int) -> None:
        context = get_context("spawn")
        self._lit_sites: SimpleQueue[str] = context.SimpleQueue()
        self._workers = [
            _Worker(
                ProcessPoolExecutor(
                    1, mp_context=context, initializer=_start_worker, initargs=(number, self._lit_sites)
                )
            )
            for number in range(count)
        ]

    def simulate(self, store: Store, simulations: Iterable[Sequence[RecordingPlan]]) -> Iterator[int]:
        queue = deque(simulations)
        return self._keep_busy(queue, lambda worker: partial(simulate_job, store.root, queue.popleft()))

    def render(
        self,
        store: Store,
        missing: Mapping[RecordingInfo, list[int]],
        spec: RenderJobSpec,
        on_light: Callable[[str], None],
    ) -> Iterator[int]:
        queue = JobQueue(missing, views=store.plan.parameters.variation.views)
        for worker in self._workers:
            worker.recording = None

        def next_for(worker: _Worker) -> Callable[[], int]:
            job = queue.next_for(worker.recording)
            worker.recording = job.recording
            return partial(_render_in_worker, store.root, spec, job)

        return self._keep_busy(queue, next_for, on_light)

    def _keep_busy(
        self,
        left: Any,
        next_for: Callable[[_Worker], Callable[[], int]],
        on_light: Callable[[str], None] = lambda _: None,
    ) -> Iterator[int]:
        """Give each idle worker the job from `next_for` while `left` is true; yield the results of the jobs.

        `on_light` is called with the sites that workers report in the meantime.
        """
        idle, busy = list(self._workers), dict[Future[int], _Worker]()
        try:
            while left or busy:
                while left and idle:
                    worker = idle.pop(0)
                    busy[worker.pool.submit(next_for(worker))] = worker
                done, _ = wait(busy, timeout=WORKER_TIMES.listen_s, return_when=FIRST_COMPLETED)
                while not self._lit_sites.empty():
                    on_light(self._lit_sites.get())
                for future in done:
                    idle.append(busy.pop(future))
                    yield future.result()
        except BrokenProcessPool:
            raise UserError(
                "a worker process was killed, possibly for lack of memory (try fewer --workers); "
                'run the same command again to resume; a script must call this below `if __name__ == "__main__":`'
            ) from None

    def close(self, *, now: bool) -> None:
        """Stop the worker processes; with `now`, do not wait for their jobs."""
        for worker in self._workers:
            if now:
                for process in list((worker.pool._processes or {}).values()):
                    process.terminate()
            worker.pool.shutdown(wait=not now, cancel_futures=now)


@contextmanager
def local_pool(workers: int) -> Iterator[WorkerPool]:
    """Start a pool of `workers` processes on this machine; a single worker is this process itself."""
    if workers == 1:
        yield InProcessPool()
        return
    pool = ProcessPool(workers)
    try:
        yield pool
    except BaseException:
        pool.close(now=True)
        raise
    pool.close(now=False)


def one_thread() -> None:
    """Limit OpenCV to one thread in this process, since there is a worker for each core."""
    import cv2

    cv2.setNumThreads(1)


def _start_worker(number: int, lit_sites: "SimpleQueue[str]") -> None:
    """Set up a worker process: one thread, Ctrl-C left to the parent, and an exit when the parent exits."""
    import signal

    global _lit_sites
    _lit_sites = lit_sites
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_thread()
    os.environ[WORKER_VARIABLE] = str(number)
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def check_workers(workers: int) -> int:
    """Return the value of `--workers`. Raises UserError if it is below 1."""
    if workers < 1:
        raise UserError(f"--workers: expected a whole number from 1, got {workers}")
    return workers
