"""Who does the work: worker processes of this machine, each with a recording of its own as long as there are enough."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Protocol

from skope.errors import UserError
from skope.gen.labels.annotate import Rules
from skope.gen.output.frames import Encoding, frames_of
from skope.gen.pipeline.store import Store
from skope.gen.render.choose import make_renderer
from skope.gen.render.frame import Renderer
from skope.gen.render.gl.context import WORKER
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, RecordingPlan, Take
from skope.gen.simulation.simulate import simulate

CHUNK = 8
"""Frames per job: small enough that no worker idles long at the end."""


@dataclass(frozen=True)
class RenderJobSpec:
    """How a dataset's frames are drawn, labelled and written."""

    renderer: str
    driver: str
    rules: Rules
    encoding: Encoding


@dataclass(frozen=True)
class RenderJob:
    """Some frames of a take."""

    take: Take
    frames: tuple[int, ...]


class Crew(Protocol):
    """Simulates and renders; what is done is in the store when it is yielded."""

    def simulate(self, store: Store, plans: Iterable[RecordingPlan]) -> Iterator[int]:
        """Yields 1 for each recording that is done."""
        ...

    def render(self, store: Store, missing: Mapping[Take, list[int]], style: RenderJobSpec) -> Iterator[int]:
        """Yields how many more of the frames of each take are done."""
        ...


class Backlog:
    """Frames to do. A hand goes on with its take, then takes one that nobody has had, then helps with the longest.

    Takes of a town stand together and a worker keeps the towns that it has met, so hands spread over the takes: each
    goes on from its last take, or from the middle of the longest stretch that is untouched.
    """

    def __init__(self, missing: Mapping[Take, list[int]], chunk: int = CHUNK) -> None:
        self._left = {
            take: deque(RenderJob(take, tuple(frames[i : i + chunk])) for i in range(0, len(frames), chunk))
            for take, frames in missing.items()
            if frames
        }
        self._order = list(self._left)
        self._place = {take: place for place, take in enumerate(self._order)}
        self._untouched = {0: len(self._order)} if self._order else {}
        """Ends of the stretches of takes that no hand has had, by their beginnings."""

    def __bool__(self) -> bool:
        return bool(self._left)

    def next_for(self, holding: Take | None) -> RenderJob:
        """The next job of a hand that has last worked on a take."""
        take = holding
        if take not in self._left:
            if self._untouched:
                take = self._order[self._begun(0 if take is None else self._place[take] + 1)]
            else:
                take = max(self._left, key=lambda t: len(self._left[t]))
        assert take is not None
        job = self._left[take].popleft()
        if not self._left[take]:
            del self._left[take]
        return job

    def _begun(self, wanted: int) -> int:
        """A place in the order, the wanted one if it is the first of a stretch; it is untouched no more."""
        at = begin = wanted
        if wanted not in self._untouched:
            begin = max(self._untouched, key=lambda begin: self._untouched[begin] - begin)
            at = (begin + self._untouched[begin]) // 2
        end = self._untouched.pop(begin)
        for first, last in ((begin, at), (at + 1, end)):
            if first < last:
                self._untouched[first] = last
        return at

    def put_back(self, job: RenderJob) -> None:
        """A job whose hand was lost."""
        self._left.setdefault(job.take, deque()).appendleft(job)


# --------------------------------------------------------------------------------------------------- what a worker does


def simulate_one(root: Path, plan: RecordingPlan) -> int:
    """Simulate into a dataset folder."""
    Store(root).keep_recording(plan.take, recordings.packed(simulate(plan)))
    return 1


def render_job(root: Path, style: RenderJobSpec, job: RenderJob) -> int:
    """Render frames of a dataset folder's recording into it."""
    store = Store(root)
    path = store.recording_path(job.take)
    source, renderer = _opened(path, path.stat().st_mtime_ns, style.renderer)
    for frame in frames_of(source, renderer, style.rules, style.encoding, job.frames):
        store.keep(frame)
    return len(job.frames)


@lru_cache(maxsize=1)
def _opened(path: Path, _changed: int, renderer: str) -> tuple[Recording, Renderer]:
    source = recordings.load(path)
    return source, make_renderer(renderer, source)


# ------------------------------------------------------------------------------------------------------ on this machine


class Alone:
    """This process does it all."""

    def simulate(self, store: Store, plans: Iterable[RecordingPlan]) -> Iterator[int]:
        return (simulate_one(store.root, plan) for plan in plans)

    def render(self, store: Store, missing: Mapping[Take, list[int]], style: RenderJobSpec) -> Iterator[int]:
        backlog, take = Backlog(missing), None
        while backlog:
            job = backlog.next_for(take)
            take = job.take
            yield render_job(store.root, style, job)


@dataclass
class _Hand:
    """One worker process, and the take whose recording it has open."""

    pool: ProcessPoolExecutor
    take: Take | None = None


class Processes:
    """Worker processes, one thread each."""

    def __init__(self, count: int) -> None:
        context = get_context("spawn")
        self._hands = [
            _Hand(ProcessPoolExecutor(1, mp_context=context, initializer=_start_worker, initargs=(number,)))
            for number in range(count)
        ]

    def simulate(self, store: Store, plans: Iterable[RecordingPlan]) -> Iterator[int]:
        queue = deque(plans)
        return self._spread(queue, lambda hand: partial(simulate_one, store.root, queue.popleft()))

    def render(self, store: Store, missing: Mapping[Take, list[int]], style: RenderJobSpec) -> Iterator[int]:
        backlog = Backlog(missing)
        for hand in self._hands:
            hand.take = None

        def next_for(hand: _Hand) -> Callable[[], int]:
            job = backlog.next_for(hand.take)
            hand.take = job.take
            return partial(render_job, store.root, style, job)

        return self._spread(backlog, next_for)

    def _spread(self, left: Any, next_for: Callable[[_Hand], Callable[[], int]]) -> Iterator[int]:
        """Keep every hand busy with one job at a time while anything is left."""
        idle, busy = list(self._hands), dict[Future[int], _Hand]()
        try:
            while left or busy:
                while left and idle:
                    hand = idle.pop(0)
                    busy[hand.pool.submit(next_for(hand))] = hand
                done, _ = wait(busy, return_when=FIRST_COMPLETED)
                for future in done:
                    idle.append(busy.pop(future))
                    yield future.result()
        except BrokenProcessPool:
            raise UserError(
                "a worker process was killed, perhaps for want of memory (try fewer --workers); "
                "the same command goes on from here"
            ) from None

    def close(self, *, now: bool) -> None:
        """Let the workers go; `now` without waiting for what they do."""
        for hand in self._hands:
            if now:
                for process in list((hand.pool._processes or {}).values()):
                    process.terminate()
            hand.pool.shutdown(wait=not now, cancel_futures=now)


@contextmanager
def local(workers: int) -> Iterator[Crew]:
    """This process alone, or so many workers."""
    if workers == 1:
        yield Alone()
        return
    crew = Processes(workers)
    try:
        yield crew
    except BaseException:
        crew.close(now=True)
        raise
    crew.close(now=False)


def one_thread() -> None:
    """Keep to one thread in this process; others work beside it."""
    import cv2

    cv2.setNumThreads(1)


def _start_worker(number: int) -> None:
    """One thread per worker, Ctrl-C left to the parent, and no worker that outlives it."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_thread()
    os.environ[WORKER] = str(number)
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def default_workers() -> int:
    """As many workers as this process may use cores."""
    return max(1, len(os.sched_getaffinity(0)))


def check_workers(workers: int) -> int:
    if workers < 1:
        raise UserError(f"--workers: expected a whole number from 1, got {workers}")
    return workers
