"""Images per second of the preset `world`, simulation to finished dataset, and where one process's time goes.

In the first part `skope gen` makes the dataset, with one process per core. In the second this process renders the same
recordings again, stage by stage, with nothing in the cache: a vehicle's surfaces are built when it is first drawn in a
run, a town for each group of views, and light for each view. Processor time of a stage counts this process only; what
its wall time is longer by, it waited for the graphics card.
Run: python scripts/bench_world.py, or with --frames 192 --sites t01_mill_corner,t05_market_first for more groups
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from skope.cpu_count import usable_processors
from skope.gen.labels.annotate import annotate
from skope.gen.output import dataset_card
from skope.gen.output.frames import files_of
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.generate import spec_of
from skope.gen.pipeline.workers import RenderJobSpec
from skope.gen.render.choose_renderer import choose_renderer, make_renderer
from skope.gen.render.pixel_windows import may_be_seen
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, body_of
from skope.gen.scenery.build import scenery
from skope.gen.vehicles.model import Body

STAGES = ("vehicle meshes", "town", "light", "drawing", "labels", "encoding, writing", "end of the run")


class Stages:
    """Seconds of the stages of a run."""

    def __init__(self) -> None:
        self.wall = dict.fromkeys(STAGES, 0.0)
        self.processor = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Count what is done within to a stage."""
        wall, processor = time.perf_counter(), time.process_time()
        yield
        self.wall[stage] += time.perf_counter() - wall
        self.processor[stage] += time.process_time() - processor


def skope(*words: str) -> float:
    """Seconds of `skope gen` with some words."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "skope", "gen", *words, "--quiet"], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begun


def render_by_stages(root: Path, stages: Stages) -> int:
    """Render the recordings of a dataset folder and complete it; returns how many vehicles were built."""
    store, built = Store(root), set[Body]()
    with store.locked():
        renderer, driver, _ = choose_renderer("auto")
        store.fix_renderer(replace(store.plan.parameters, renderer=renderer, driver=driver))
        spec = spec_of(store)
        for info in store.plan.recordings:
            recording = recordings.load(store.recording_path(info))
            with stages.timed("vehicle meshes"):
                built |= build_vehicles(recording)
            with stages.timed("town"):
                scenery(recording.town)
            render_recording(store, recording, spec, stages)
        with stages.timed("end of the run"):
            store.finish(dataset_card.card(store.plan, store.merge()))
    return len(built)


def build_vehicles(recording: Recording) -> set[Body]:
    """Build the surfaces of all road users that a recording may show."""
    out = set[Body]()
    for frame in range(len(recording)):
        moment = recording.moment(frame)
        for i, recorded in enumerate(moment.vehicles):
            body = body_of(recorded)
            if may_be_seen(body, moment.part_poses(i), recording.camera):
                out.add(body)
    for body in out:
        _ = body.parts, body.interior, body.coarse
    return out


def render_recording(store: Store, recording: Recording, spec: RenderJobSpec, stages: Stages) -> None:
    """Render and write all frames of a recording."""
    with stages.timed("light"):
        renderer = make_renderer(spec.renderer, recording)
    for frame in range(len(recording)):
        with stages.timed("drawing"):
            view = renderer.render(frame)
        with stages.timed("labels"):
            annotations, tally = annotate(recording.moment(frame), view, recording.camera, spec.rules, image_id=0)
        with stages.timed("encoding, writing"):
            store.write_frame(files_of(recording, frame, view, annotations, tally, spec.encoding))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--frames", type=int, default=96, help="of each site; 96 are a group of four views")
    parser.add_argument("--sites", default="t01_mill_corner", help="of the split `train`, whose recordings share towns")
    parser.add_argument("--workers", type=int, default=usable_processors())
    parser.add_argument("--recordings", type=Path, help="folder that `skope gen simulate` made, where SUMO is missing")
    options = parser.parse_args()
    workers = ["--workers", str(options.workers)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["SKOPE_CACHE"] = str(folder / "cache")
        what = ["--preset", "world", "--sites", options.sites, "--frames", str(options.frames), "--size", options.size]
        simulated = 0.0
        if options.recordings:
            shutil.copytree(options.recordings, folder / "world")
        else:
            simulated = skope("simulate", *what, "--no-depth", *workers, "--out", str(folder / "world"))
        shutil.copytree(folder / "world", folder / "stages")
        rendered = skope("render", str(folder / "world"), *workers)
        # The second part begins with an empty cache too.
        os.environ["SKOPE_CACHE"] = str(folder / "cache of the stages")
        stages = Stages()
        built = render_by_stages(folder / "stages", stages)
        plan = Store(folder / "stages").plan
    images, parameters = sum(info.frames for info in plan.recordings), plan.parameters
    print(f"world, {parameters.size}, {images} images of {','.join(parameters.sites)}, {options.workers} processes")
    print(f"  simulation {simulated:.1f} s, rendering {rendered:.1f} s: {images / (simulated + rendered):.3f} images/s")
    print(f"  one process that renders, {built} vehicles built: seconds, and of these processor time an image, ms")
    for stage in STAGES:
        print(f"    {stage:<18} {stages.wall[stage]:8.2f} {1e3 * stages.processor[stage] / images:8.1f}")
    total = sum(stages.wall.values())
    print(f"    {'all':<18} {total:8.2f} {1e3 * sum(stages.processor.values()) / images:8.1f}", flush=True)


if __name__ == "__main__":
    main()
