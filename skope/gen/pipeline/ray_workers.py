"""Workers of a Ray cluster, without a shared disk: recordings are sent to them, and they return frames."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from skope.errors import UserError
from skope.gen.output.frames import frames_of
from skope.gen.output.writers import FrameFiles
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.workers import JobQueue, RenderJob, RenderJobSpec, WorkerPool
from skope.gen.render.choose_renderer import choose_renderer, make_renderer
from skope.gen.render.frame import Renderer
from skope.gen.scene import recording as recordings
from skope.gen.scene.package_versions import versions
from skope.gen.scene.recording import Recording, RecordingInfo, RecordingPlan
from skope.gen.simulation.simulate import simulate_together
from skope.ray_cluster import ray_cluster

MOST_LOST_WORKERS: Final = 20
"""Maximum number of workers that may be lost before the run stops."""


class Worker:
    """Ray actor: one process of the cluster, which keeps its current recording open.

    Raises UserError if its libraries do not have the versions `same`, because the bytes of the output would differ.
    """

    def __init__(self, same: Mapping[str, str]) -> None:
        from skope.gen.pipeline.workers import one_thread

        one_thread()
        self._recording: RecordingInfo | None = None
        self._opened: tuple[Recording, Renderer] | None = None
        here = versions()
        for name, version in same.items():
            if here.get(name) != version:
                raise UserError(f"has {name} {here.get(name, 'not installed')}; this run uses {version}")

    def simulate(self, plans: Sequence[RecordingPlan]) -> list[bytes]:
        return [recordings.packed_recording(recording) for recording in simulate_together(plans)]

    def render(self, data: bytes, spec: RenderJobSpec, job: RenderJob) -> list[FrameFiles]:
        if self._recording != job.recording or self._opened is None:
            _, driver, _ = choose_renderer(spec.renderer)
            if driver != spec.driver:
                raise UserError(f"renders with {driver}; this run uses {spec.driver}")
            source = recordings.unpacked_recording(data, Path(f"{job.recording.site}_{job.recording.name}.npz"))
            self._opened, self._recording = (source, make_renderer(spec.renderer, source)), job.recording
        source, renderer = self._opened
        return list(frames_of(source, renderer, spec.rules, spec.encoding, job.frames))


class RayPool:
    """A pool of `count` workers of a Ray cluster; the job of a lost worker is given to another worker."""

    def __init__(self, ray: Any, count: int) -> None:
        self._ray, self._lost = ray, 0
        self._actor = ray.remote(num_cpus=1)(Worker)
        self._workers = [self._start_worker() for _ in range(count)]

    def _start_worker(self) -> Any:
        return self._actor.remote(versions())

    def simulate(self, store: Store, simulations: Iterable[Sequence[RecordingPlan]]) -> Iterator[int]:
        left = deque(simulations)
        for plans, made in self._keep_busy(
            left, lambda _: left.popleft(), left.appendleft, lambda worker, plans: worker.simulate.remote(plans)
        ):
            for plan, data in zip(plans, made, strict=True):
                if not store.recorded(plan.info):
                    store.write_recording(plan.info, data)
            yield len(plans)

    def render(
        self,
        store: Store,
        missing: Mapping[RecordingInfo, list[int]],
        spec: RenderJobSpec,
        on_light: Callable[[str], None],
    ) -> Iterator[int]:
        queue = JobQueue(missing, views=store.plan.parameters.variation.views)
        held, sent = dict[Any, RecordingInfo](), dict[RecordingInfo, Any]()

        def next_for(worker: Any) -> RenderJob:
            job = queue.next_for(held.get(worker))
            held[worker] = job.recording
            return job

        def begin(worker: Any, job: RenderJob) -> Any:
            if job.recording not in sent:
                # The cluster can free the memory of recordings that no worker uses any more.
                for recording in sent.keys() - set(held.values()):
                    del sent[recording]
                sent[job.recording] = self._ray.put(store.recording_path(job.recording).read_bytes())
            return worker.render.remote(sent[job.recording], spec, job)

        for _, frames in self._keep_busy(queue, next_for, queue.put_back, begin):
            for frame in frames:
                store.write_frame(frame)
            yield len(frames)

    def _keep_busy(
        self,
        left: Any,
        next_for: Callable[[Any], Any],
        put_back: Callable[[Any], None],
        begin: Callable[[Any, Any], Any],
    ) -> Iterator[tuple[Any, Any]]:
        idle, busy = list(self._workers), dict[Any, tuple[Any, Any]]()
        while left or busy:
            while left and idle:
                worker = idle.pop(0)
                task = next_for(worker)
                busy[begin(worker, task)] = worker, task
            done, _ = self._ray.wait(list(busy), num_returns=1)
            worker, task = busy.pop(done[0])
            try:
                result = self._ray.get(done[0])
            except self._ray.exceptions.RayActorError as error:
                put_back(task)
                idle.append(self._replace_worker(worker, error))
                continue
            except self._ray.exceptions.RayTaskError as error:
                if isinstance(error.cause, UserError):
                    raise UserError(f"a worker of the cluster {error.cause}") from None
                raise
            idle.append(worker)
            yield task, result

    def _replace_worker(self, worker: Any, error: Exception) -> Any:
        if "UserError" in str(error):  # the worker rejected the run at its start
            text = next(line for line in reversed(str(error).splitlines()) if "UserError" in line)
            raise UserError(f"a worker of the cluster {text.split('UserError: ')[-1]}") from None
        self._lost += 1
        if self._lost > MOST_LOST_WORKERS:
            raise UserError(
                f"{self._lost} workers of the cluster were lost, possibly for lack of memory; "
                "run the same command again to resume"
            ) from None
        self._workers[self._workers.index(worker)] = hired = self._start_worker()
        return hired


@contextmanager
def ray_pool(count: int | None, address: str | None) -> Iterator[WorkerPool]:
    """Start a pool of workers of a Ray cluster; use as a context manager.

    Args:
        count: Number of workers. Default: one per core of the cluster.
        address: Address of the cluster. Default: the cluster of this machine, or a new one on it.

    Raises:
        UserError: Ray is not installed, there is no cluster at `address`, or it has fewer cores than `count`.
    """
    with ray_cluster(address) as ray:
        cores = int(ray.cluster_resources().get("CPU", 0))
        if not 0 < (count or cores) <= cores:
            raise UserError(f"--workers {count or cores}: the Ray cluster has {cores} cores")
        yield RayPool(ray, count or cores)
