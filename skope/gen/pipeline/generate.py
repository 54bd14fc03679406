"""Generate a dataset: simulate, render, annotate, write, merge. The bytes do not depend on the number of workers.

Simulation and rendering can run on different machines; only the folder with the recordings has to be copied.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from skope.errors import UserError
from skope.gen.output import dataset_card
from skope.gen.pipeline.config import DatasetRequest
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.workers import RenderJobSpec, WorkerPool
from skope.gen.render.choose_renderer import choose_renderer
from skope.gen.scene import recording
from skope.gen.scene.package_versions import versions
from skope.terminal.console import Console, counted, disk_size, minutes


def lighting_messages(console: Console) -> Callable[[str], None]:
    """Return a function that reports each site once, when its light is computed."""
    reported = set[str]()

    def say(site: str) -> None:
        if site not in reported:
            reported.add(site)
            console.say(f"computing the light of {site}")

    return say


PoolFactory = Callable[[], AbstractContextManager[WorkerPool]]
"""Function that starts the worker processes; they stop when the context ends."""


def generate_dataset(request: DatasetRequest, root: Path, start_pool: PoolFactory, console: Console) -> bool:
    """Make the dataset at `root`, or resume an interrupted run.

    Args:
        request: Requested dataset.
        root: Dataset folder: new, empty, or started with the same parameters.
        start_pool: Starts the workers, as `local_pool` or `ray_pool` do.
        console: Output for progress messages.

    Returns:
        False if the dataset was already complete.

    Raises:
        UserError: The folder is not writable, contains other files, or was started with other parameters.
    """
    store, begun = Store(root), time.perf_counter()
    with store.locked():
        store.begin(request.dataset_plan())
        if store.complete:
            return False
        with start_pool() as pool:
            _simulate(store, request, pool, console)
            _render(store, pool, console)
        _finish(store, console, begun)
    return True


def simulate_dataset(request: DatasetRequest, root: Path, start_pool: PoolFactory, console: Console) -> bool:
    """Make only the recordings of a dataset; `render_dataset` makes its frames, on this or another machine.

    Args:
        request: Requested dataset; renderer and driver stay undetermined until rendering.
        root: Dataset folder: new, empty, or started with the same parameters.
        start_pool: Starts the workers.
        console: Output for progress messages.

    Returns:
        False if all recordings existed already.

    Raises:
        UserError: The folder is not writable, contains other files, or was started with other parameters.
    """
    store = Store(root)
    with store.locked():
        begun, wanted = store.read_plan(), request.dataset_plan()
        drawn = begun.parameters if begun else None
        renderer, driver = (drawn.renderer, drawn.driver) if drawn else ("", "")
        store.begin(replace(wanted, parameters=replace(wanted.parameters, renderer=renderer, driver=driver)))
        if store.complete or all(store.recorded(plan.info) for plan in request.plans()):
            return False
        with start_pool() as pool:
            _simulate(store, request, pool, console)
    return True


def render_dataset(root: Path, renderer: str, start_pool: PoolFactory, console: Console) -> bool:
    """Render, annotate and complete a dataset with recordings from `simulate_dataset`, on this or another machine.

    Args:
        root: Dataset folder.
        renderer: "gl", "pybullet" or "auto". Existing frames must have been rendered with the same one.
        start_pool: Starts the workers.
        console: Output for progress messages.

    Returns:
        False if the dataset was already complete.

    Raises:
        UserError: The folder contains no recordings, a recording is missing or damaged, or the renderer or a library
            version differs from that of the existing frames.
    """
    store = Store(root)
    if store.read_plan() is None:
        raise UserError(f"{root}: contains no recordings; make them with `skope gen simulate --out {root}`")
    with store.locked():
        if store.complete:
            return False
        finish_rendering(store, renderer, start_pool, console)
    return True


def finish_rendering(store: Store, renderer: str, start_pool: PoolFactory, console: Console) -> None:
    """Render the missing frames of a dataset under construction, and complete it; see `render_dataset`."""
    begun = time.perf_counter()
    _fix_renderer(store, renderer)
    absent = [store.recording_path(info) for info in store.plan.recordings if not store.recorded(info)]
    if absent:
        raise UserError(f"{absent[0]}: is missing or damaged ({len(absent)} recordings are); simulate it first")
    with start_pool() as pool:
        _render(store, pool, console)
    _finish(store, console, begun)


def _fix_renderer(store: Store, renderer: str) -> None:
    """Choose and save the renderer of a dataset that has none yet; otherwise check that this machine has the same.

    Raises UserError if renderer, driver or a library version differs from that of the existing frames.
    """
    drawn = store.plan.parameters
    chosen, driver, _ = choose_renderer(drawn.renderer or renderer)
    here = {name: version for name, version in versions().items() if name in ("skope", "numpy", "opencv", "orjson")}
    now = replace(drawn, renderer=chosen, driver=driver, versions={**drawn.versions, **here})
    if not drawn.renderer:
        store.fix_renderer(now)
        return
    for name in ("renderer", "driver", "versions"):
        before, value = getattr(drawn, name), getattr(now, name)
        if before != value:
            raise UserError(
                f"{store.root}: its frames were made with {name} = {before}, but this machine has {value}; "
                "new frames would not have the same bytes"
            )


def _simulate(store: Store, request: DatasetRequest, pool: WorkerPool, console: Console) -> None:
    todo = [plans for plans in request.simulations() if not all(store.recorded(plan.info) for plan in plans)]
    for path in (store.recording_path(plan.info) for plans in todo for plan in plans):
        if path.is_file() and not recording.sound(path):
            console.say(f"{path}: is damaged, and is made again")
    with console.bar(total=sum(map(len, todo)), unit="recording", label="simulating") as bar:
        for count in pool.simulate(store, todo):
            bar.update(count)


def _render(store: Store, pool: WorkerPool, console: Console) -> None:
    infos = store.plan.recordings
    missing = {info: frames for info in infos if (frames := store.missing(info))}
    todo = sum(map(len, missing.values()))
    if not todo:
        return
    spec = spec_of(store)
    console.say(f"{todo} frames with {spec.renderer}")
    total = sum(info.frames for info in infos)
    with console.bar(total=total, unit="image", label="rendering") as bar:
        bar.update(total - todo)
        for count in pool.render(store, missing, spec, lighting_messages(console)):
            bar.update(count)


def spec_of(store: Store) -> RenderJobSpec:
    """Return how the frames of a dataset are rendered, labelled and written, according to its saved parameters."""
    parameters = store.plan.parameters
    return RenderJobSpec(parameters.renderer, parameters.driver, parameters.rules, parameters.encoding)


def _finish(store: Store, console: Console, begun: float) -> None:
    counts = store.merge()
    content = dataset_card.card(store.plan, counts)
    store.finish(content)
    size = sum(path.stat().st_size for path in store.root.rglob("*") if path.is_file())
    console.say(
        f"{counted(counts.images, 'image')}, {counted(content['counts']['ground_truth'], 'ground-truth vehicle')} and "
        f"{sum(content['counts']['ignored'].values())} ignored, {disk_size(size)}, "
        f"in {minutes(time.perf_counter() - begun)}"
    )
