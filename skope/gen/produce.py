"""Make a dataset: simulate, render and annotate, write, merge; in one process or several, with the same bytes."""

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from skope.console import Console, minutes
from skope.errors import UserError
from skope.gen import card, recording
from skope.gen.annotate import Rules, annotate, locate
from skope.gen.plan import Parameters
from skope.gen.recording import Recording, RecordingPlan
from skope.gen.render import Renderer, make_renderer
from skope.gen.simulate import simulate
from skope.gen.store import Store

A = TypeVar("A")
B = TypeVar("B")

CHUNK = 8
"""Frames per task: small enough that no worker idles long at the end."""


class Run(Protocol):
    """Applies a function to tasks, here or in worker processes, and yields the results as they come."""

    def __call__(self, function: Callable[[A], B], tasks: Iterable[A]) -> Iterator[B]: ...


def produce(parameters: Parameters, root: Path, workers: int, console: Console) -> bool:
    """Make the dataset at `root`, or go on with it; False when it was complete already.

    Raises UserError when the folder cannot be written or was begun with other parameters.
    """
    store, plans = Store(root), parameters.plans()
    with store.locked():
        store.begin(parameters.to_dict())
        if store.complete:
            return False
        with _pool(workers) as run:
            _simulate(store, plans, run, console)
            _render(store, plans, parameters, workers, run, console)
        counts = store.merge(plans)
        difference = _localizer_difference(store, plans)
        content = card.card(parameters, counts, difference)
        store.finish(content, card.readme(content))
    return True


def _simulate(store: Store, plans: list[RecordingPlan], run: Run, console: Console) -> None:
    todo = [(store.root, plan) for plan in plans if not store.recording_path(plan).is_file()]
    for _ in console.bar(run(_simulate_one, todo), total=len(todo), unit="recording", label="simulating"):
        pass


def _simulate_one(task: tuple[Path, RecordingPlan]) -> None:
    root, plan = task
    recording.save(Store(root).recording_path(plan), simulate(plan))


def _render(
    store: Store, plans: list[RecordingPlan], parameters: Parameters, workers: int, run: Run, console: Console
) -> None:
    missing = [(plan, store.missing(plan)) for plan in plans]
    todo = [(plan, frame) for plan, frames in missing for frame in frames]
    if not todo:
        return
    tasks = [
        (store.root, plan, frames[i : i + CHUNK], parameters.renderer, parameters.rules)
        for plan, frames in missing
        for i in range(0, len(frames), CHUNK)
    ]
    console.say(f"{len(todo)} frames with {parameters.renderer}, {_estimate(store, todo, tasks, parameters, workers)}")
    done = sum(plan.frames for plan in plans) - len(todo)
    with console.bar(total=len(todo) + done, unit="image", label="rendering") as bar:
        bar.update(done)
        for count in run(_render_chunk, tasks):
            bar.update(count)


def _estimate(store: Store, todo: list[Any], tasks: list[Any], parameters: Parameters, workers: int) -> str:
    """About how long rendering will take, from drawing the first missing frame here."""
    (plan, frame), begun = todo[0], time.perf_counter()
    renderer = make_renderer(parameters.renderer, recording.load(store.recording_path(plan)))
    ready = time.perf_counter()
    renderer.render(frame)
    each, setup = time.perf_counter() - ready, ready - begun
    busy = max(1, min(workers, len(tasks)))
    # Every process sets up each recording that it meets.
    setups = min(len(tasks), busy * len({task[1].site.name for task in tasks}))
    return f"about {minutes((each * len(todo) + setup * setups) / busy)} with {busy} workers"


Task = tuple[Path, RecordingPlan, list[int], str, Rules]


def _render_chunk(task: Task) -> int:
    root, plan, frames, renderer_name, rules = task
    store = Store(root)
    source, renderer = _opened(store.recording_path(plan), renderer_name)
    for frame in frames:
        view = renderer.render(frame)
        annotations, tally = annotate(source.moment(frame), view, source.camera, rules, image_id=0)
        store.add(plan, source, frame, view, annotations, tally)
    return len(frames)


@lru_cache(maxsize=1)
def _opened(path: Path, renderer: str) -> tuple[Recording, Renderer]:
    source = recording.load(path)
    return source, make_renderer(renderer, source)


def _localizer_difference(store: Store, plans: list[RecordingPlan]) -> dict[str, float | None]:
    """How far trilateration and the rigid transform are apart over all keypoints of all recorded frames, metres."""
    parts = []
    for plan in plans:
        source = recording.load(store.recording_path(plan))
        parts += [locate(source.moment(frame), "rigid").difference.ravel() for frame in range(len(source))]
    values = np.concatenate(parts)
    if not values.size:
        return {"median": None, "p99": None, "max": None}
    return {
        "median": round(float(np.median(values)), 6),
        "p99": round(float(np.quantile(values, 0.99)), 6),
        "max": round(float(values.max()), 6),
    }


# -------------------------------------------------------------------------------------------------------------- workers


@contextmanager
def _pool(workers: int) -> Iterator[Run]:
    if workers == 1:
        yield lambda function, tasks: iter(map(function, tasks))
        return
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_start_worker)

    def run(function: Callable[[A], B], tasks: Iterable[A]) -> Iterator[B]:
        for future in as_completed([pool.submit(function, task) for task in tasks]):
            yield future.result()

    try:
        yield run
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    pool.shutdown()


def _start_worker() -> None:
    """One thread per worker, Ctrl-C left to the parent, and no worker that outlives it."""
    import signal

    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("LP_NUM_THREADS", "1")  # llvmpipe's own threads
    cv2.setNumThreads(1)
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
