"""Make a dataset: simulate, render and annotate, write, merge; by one process, several, or a cluster's, the same bytes.

The two halves go apart too: recordings travel to where the rendering is done.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from skope.console import Console, minutes
from skope.errors import UserError
from skope.gen.labels.annotate import Rules
from skope.gen.output import card
from skope.gen.output.frames import Encoding
from skope.gen.pipeline.config import Parameters
from skope.gen.pipeline.store import Store
from skope.gen.pipeline.workers import Crew, RenderJobSpec
from skope.gen.render.choose import choose_renderer
from skope.gen.scene import recording
from skope.gen.scene.versions import versions

Hire = Callable[[], AbstractContextManager[Crew]]


def produce(parameters: Parameters, root: Path, hire: Hire, console: Console) -> bool:
    """Make the dataset at `root`, or go on with it; False when it was complete already.

    Raises UserError when the folder cannot be written or was begun with other parameters.
    """
    store, begun = Store(root), time.perf_counter()
    with store.locked():
        store.begin(parameters.to_dict(), [plan.take for plan in parameters.plans()])
        if store.complete:
            return False
        with hire() as crew:
            _simulate(store, parameters, crew, console)
            _render(store, crew, console)
        _finish(store, console, begun)
    return True


def simulate_only(parameters: Parameters, root: Path, hire: Hire, console: Console) -> bool:
    """The first half of `produce`: what is left is rendering. False when there was nothing to do."""
    store = Store(root)
    with store.locked():
        open_ = parameters.to_dict() | {"renderer": "", "driver": ""}
        begun = store.begun()
        if begun and begun["parameters"]["renderer"]:
            open_ |= {name: begun["parameters"][name] for name in ("renderer", "driver")}
        store.begin(open_, [plan.take for plan in parameters.plans()])
        if store.complete or all(store.recorded(plan.take) for plan in parameters.plans()):
            return False
        with hire() as crew:
            _simulate(store, parameters, crew, console)
    return True


def render_only(root: Path, renderer: str, hire: Hire, console: Console) -> bool:
    """The second half of `produce`, of recordings that may come from another machine; False when it was complete."""
    store = Store(root)
    if store.begun() is None:
        raise UserError(f"{root}: holds no recordings; `skope gen simulate --out {root}` makes them")
    with store.locked():
        if store.complete:
            return False
        finish_rendering(store, renderer, hire, console)
    return True


def finish_rendering(store: Store, renderer: str, hire: Hire, console: Console) -> None:
    """Render what is missing of a begun dataset whose recordings are there, and complete it."""
    begun = time.perf_counter()
    _settle_renderer(store, renderer)
    absent = [store.recording_path(take) for take in store.takes() if not store.recorded(take)]
    if absent:
        raise UserError(f"{absent[0]}: is missing or broken ({len(absent)} recordings are); simulate it first")
    with hire() as crew:
        _render(store, crew, console)
    _finish(store, console, begun)


def _settle_renderer(store: Store, renderer: str) -> None:
    """Choose what the frames are drawn with when none is done; else it must be what those were drawn with."""
    begun = store.begun()
    assert begun is not None
    parameters = begun["parameters"]
    chosen, driver, _ = choose_renderer(parameters["renderer"] or renderer)
    here = {name: version for name, version in versions().items() if name in ("skope", "numpy", "opencv", "orjson")}
    if not parameters["renderer"]:
        store.settle({"renderer": chosen, "driver": driver, "versions": parameters["versions"] | here})
        return
    is_now = {"renderer": chosen, "driver": driver, "versions": parameters["versions"] | here}
    for name, value in is_now.items():
        if parameters[name] != value:
            raise UserError(
                f"{store.root}: its frames are drawn with {name} = {parameters[name]}, here it is {value}: "
                "the bytes would not be the same"
            )


def _simulate(store: Store, parameters: Parameters, crew: Crew, console: Console) -> None:
    todo = [plan for plan in parameters.plans() if not store.recorded(plan.take)]
    for path in (store.recording_path(plan.take) for plan in todo):
        if path.is_file() and not recording.sound(path):
            console.say(f"{path}: is broken, and is made again")
    for _ in console.bar(crew.simulate(store, todo), total=len(todo), unit="recording", label="simulating"):
        pass


def _render(store: Store, crew: Crew, console: Console) -> None:
    takes = store.takes()
    missing = {take: frames for take in takes if (frames := store.missing(take))}
    todo = sum(map(len, missing.values()))
    if not todo:
        return
    style = style_of(store)
    console.say(f"{todo} frames with {style.renderer}")
    total = sum(take.frames for take in takes)
    with console.bar(total=total, unit="image", label="rendering") as bar:
        bar.update(total - todo)
        for count in crew.render(store, missing, style):
            bar.update(count)


def style_of(store: Store) -> RenderJobSpec:
    """How the frames of a begun dataset are made."""
    begun = store.begun()
    assert begun is not None
    values = begun["parameters"]
    return RenderJobSpec(values["renderer"], values["driver"], Rules(**values["rules"]), Encoding(**values["encoding"]))


def _finish(store: Store, console: Console, begun: float) -> None:
    takes, values = store.takes(), store.begun()
    assert values is not None
    counts = store.merge(takes, values["parameters"]["format"])
    content = card.card(values["parameters"], values["takes"], counts)
    store.finish(content)
    size = sum(path.stat().st_size for path in store.root.rglob("*") if path.is_file())
    console.say(
        f"{counts.images} images, {content['counts']['ground_truth']} vehicles to learn and "
        f"{sum(content['counts']['ignored'].values())} ignored, {size / 1e9:.2f} GB, "
        f"in {minutes(time.perf_counter() - begun)}"
    )
