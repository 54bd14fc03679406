"""Worker processes of this machine, which simulate and render a dataset's recordings, and the queue of their jobs."""

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
    """Size of a job, and how often workers are listened to."""

    frames_per_job: int = 8
    """Frames per job: small enough that no worker idles long at the end."""
    listen_s: float = 0.2
    """Interval at which messages of workers are read, seconds."""


WORKER_TIMES: Final = WorkerTimes()


@dataclass(frozen=True)
class RenderJobSpec:
    """Specification on how a dataset's frames are drawn, labelled and written."""

    renderer: str
    """"gl" or "pybullet"."""
    driver: str
    """The means by which the renderer must draw, or bytes would differ: the name that `choose_renderer` gives."""
    rules: Rules
    encoding: Encoding


@dataclass(frozen=True)
class RenderJob:
    """Some frames of a recording, which one worker renders in one go."""

    recording: RecordingInfo
    frames: tuple[int, ...]


class WorkerPool(Protocol):
    """One or more workers that simulate and render into a store. What they yield is already written."""

    def simulate(self, store: Store, simulations: Iterable[Sequence[RecordingPlan]]) -> Iterator[int]:
        """Make the recordings of each simulation; yields how many are done since the last time."""
        ...

    def render(
        self,
        store: Store,
        missing: Mapping[RecordingInfo, list[int]],
        spec: RenderJobSpec,
        on_light: Callable[[str], None],
    ) -> Iterator[int]:
        """Render the `missing` frames of each recording; yields how many frames are done since the last time.

        `on_light` is called with the site whose light a worker begins to work out, for each part of it. Workers of a
        Ray cluster have no way to say so.
        """
        ...


class JobQueue:
    """Frames to render, handed out so that workers seldom change recording and town.

    A worker is given the rest of its own recording first, then a recording that no worker has had, and then a part of
    the one that has most left. Recordings of a town follow each other, and a worker keeps the towns in memory that it
    has loaded. So the next new recording is the one after its last, or else the middle of the longest run of
    recordings that no worker has had; there it begins with a town, where so many `views` in a row share one.
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
        self._place = {recording: place for place, recording in enumerate(self._order)}
        self._views = views
        self._untouched = {0: len(self._order)} if self._order else {}
        """Runs of recordings that no worker has had: places in `_order`, first: last + 1."""

    def __bool__(self) -> bool:
        return bool(self._left)

    def next_for(self, holding: RecordingInfo | None) -> RenderJob:
        """The next job of a worker whose last job was of the recording `holding` (None: it has had none)."""
        recording = holding
        if recording not in self._left:
            if self._untouched:
                recording = self._order[self._claim_place(0 if recording is None else self._place[recording] + 1)]
            else:
                recording = max(self._left, key=lambda t: len(self._left[t]))
        assert recording is not None
        job = self._left[recording].popleft()
        if not self._left[recording]:
            del self._left[recording]
        return job

    def _claim_place(self, wanted: int) -> int:
        """Take a recording out of `_untouched`: the one at `wanted` if a run begins there, else one in the middle of
        the longest run. Returns its place in `_order`."""
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
        """Place of the first recording of the town that the one at `middle` shows; `middle` if `first` shows it too."""

        def town(place: int) -> tuple[str, int]:
            recording = self._order[place]
            return recording.site, int(recording.name) // self._views

        if self._views == 0 or town(first) == town(middle):
            return middle
        return next(place for place in range(first, middle + 1) if town(place) == town(middle))

    def put_back(self, job: RenderJob) -> None:
        """Hand a job out again, because the worker that had it was lost."""
        self._left.setdefault(job.recording, deque()).appendleft(job)


# --------------------------------------------------------------------------------------------------- what a worker does


def simulate_job(root: Path, plans: Sequence[RecordingPlan]) -> int:
    """Simulate recordings that share their traffic, and write them to the dataset folder `root`.

    Returns how many they are. Those that are there already stay.
    """
    store = Store(root)
    for plan, recording in zip(plans, simulate_together(plans), strict=True):
        if not store.recorded(plan.info):
            store.write_recording(plan.info, recordings.packed_recording(recording))
    return len(plans)


def render_job(root: Path, spec: RenderJobSpec, job: RenderJob, on_light: Callable[[str], None]) -> int:
    """Render and write a job's frames to the dataset folder `root`; returns how many they are."""
    store = Store(root)
    path = store.recording_path(job.recording)
    source, renderer = _open_recording(path, path.stat().st_mtime_ns, spec.renderer, on_light)
    for frame in frames_of(source, renderer, spec.rules, spec.encoding, job.frames):
        store.write_frame(frame)
    return len(job.frames)


def _render_in_worker(root: Path, spec: RenderJobSpec, job: RenderJob) -> int:
    """`render_job` of a worker process, which tells the main process what it lights."""
    return render_job(root, spec, job, _tell_lighting)


def _tell_lighting(site: str) -> None:
    _lit_sites.put(site)


_lit_sites: "SimpleQueue[str]"
"""Of a worker process: where it tells the sites whose light it works out."""


@lru_cache(maxsize=1)
def _open_recording(
    path: Path, _changed: int, renderer: str, on_light: Callable[[str], None]
) -> tuple[Recording, Renderer]:
    """A recording and its renderer, kept until a job is of another one, or of a file written since (`_changed`, ns)."""
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
    """One worker process, and the recording that it has open."""

    pool: ProcessPoolExecutor
    recording: RecordingInfo | None = None


class ProcessPool:
    """A pool of `count` worker processes of this machine, one thread each."""

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
        """Give every idle worker the job that `next_for` names while `left` is true; yields what jobs return.

        `on_light` is called with the sites that workers tell meanwhile.
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
                "a worker process was killed, perhaps for want of memory (try fewer --workers); "
                "the same command goes on from here"
            ) from None

    def close(self, *, now: bool) -> None:
        """Stop the worker processes; with `now`, without waiting for the jobs they are at."""
        for worker in self._workers:
            if now:
                for process in list((worker.pool._processes or {}).values()):
                    process.terminate()
            worker.pool.shutdown(wait=not now, cancel_futures=now)


@contextmanager
def local_pool(workers: int) -> Iterator[WorkerPool]:
    """A pool of `workers` processes of this machine; for one worker, this process itself."""
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
    """Keep OpenCV to one thread in this process: there is a worker for each core."""
    import cv2

    cv2.setNumThreads(1)


def _start_worker(number: int, lit_sites: "SimpleQueue[str]") -> None:
    """Set a worker process up: one thread, Ctrl-C left to the parent, and an end when the parent ends."""
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
    """The number of `--workers`; a UserError below 1."""
    if workers < 1:
        raise UserError(f"--workers: expected a whole number from 1, got {workers}")
    return workers
