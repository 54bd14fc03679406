"""Speed of `skope gen`: frames against pybullet's renderers, whole datasets, and the stages of the preset `world`.

    python scripts/bench_gen.py frames                          # frames per second, and milliseconds by stage
    python scripts/bench_gen.py dataset --images 300            # simulation to finished dataset
    python scripts/bench_gen.py dataset --flat 100,1000,5000    # cost of an image in datasets of growing size
    python scripts/bench_gen.py world --frames 192 --sites t01_mill_corner,t05_market_first

`frames`: skope writes whole frames (JPEG, depth, annotations). The peers draw colour, depth and ids of the whole
scene with one `getCameraImage` per frame, and for labels each vehicle once more by itself; they write nothing. Each
core runs one process of one thread, all at the same time. The clock starts after each vehicle model has been built.

`dataset`: the peer is a plain loop over pybullet's camera on the same recording, with `getCameraImage` once more for
each vehicle (its whole silhouette, for box and occlusion), and JPEG and depth by OpenCV; one process per core.

`world`: first `skope gen` makes the dataset with one process per core. Then this process renders the same recordings
again, stage by stage, with an empty cache: it builds a vehicle's surfaces when it first draws the vehicle, a town for
each group of views, and light for each view. Processor time counts this process only; the rest of a stage's wall time
is waiting for the graphics card.
"""

import argparse
import multiprocessing
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from skope.cpu_count import usable_processors
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output import dataset_card
from skope.gen.output.frames import Encoding, files_of, frames_of
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.generate import spec_of
from skope.gen.pipeline.workers import RenderJobSpec
from skope.gen.render.choose_renderer import choose_renderer, make_renderer
from skope.gen.render.materials import MATERIAL_COLORS, Light
from skope.gen.render.pixel_windows import WINDOW_LIMITS, hull_of, may_be_seen, window_of
from skope.gen.render.tiny_renderer import TINY_LIMITS, quaternion
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, RecordingPlan, body_of
from skope.gen.scenery.build import scenery
from skope.gen.simulation.pybullet_engine import engine
from skope.gen.simulation.simulate import simulate
from skope.gen.towns.sites import site
from skope.gen.vehicles.fleet import build_vehicle
from skope.gen.vehicles.model import Body

SITE = "t01_main_west"
PEERS = {"tiny": "TinyRenderer", "egl": "EGL plugin (draws 1024x768, enlarges it)"}
DENSITY = 2
"""Factor on the traffic of the site, so that each frame has enough vehicles to choose from."""
STAGES = {
    "place and matrices": ["Placer.place"],
    "depth and ids": ["GLRenderer._draw_geometry", "renderer._put_vehicle"],
    "whole silhouettes": ["GLRenderer._draw_silhouette"],
    "shadow maps": ["GLRenderer._draw_shadows"],
    "vehicles' colour": ["Device.prepare", "GLRenderer._draw_vehicles"],
    "headlights": ["Beams.draw"],
    "mirror images": ["Reflections.draw"],
    "composition": ["GLRenderer._compose_picture", "GLRenderer._draw_color"],
    "contrast": ["GLRenderer._draw_behind", "GLRenderer._contrast"],
    "copies": ["GLRenderer.render"],
    "glare": ["Glare.spread"],
    "rain": ["Rain.fall"],
    "noise": ["camera_effects.with_noise"],
    "annotation": ["frames.annotate"],
    "JPEG": ["Encoding.encoded"],
    "depth PNG": ["frames.depth_png"],
    "files": ["Store.write_frame"],
}


def with_vehicles(recording: Recording, count: int) -> Recording:
    """Keep `count` of the vehicles in each image, spread evenly from the nearest to the farthest.

    Other road users are removed.
    """
    keep: list[int] = []
    for frame in range(len(recording)):
        moment = recording.moment(frame).labelled()
        first = int(np.searchsorted(recording.frame, frame))
        away = np.linalg.norm(moment.T_world_chassis[:, :3, 3] - recording.camera.position, axis=1)
        models = [build_vehicle(vehicle.model, vehicle.shape) for vehicle in moment.vehicles]
        hulls = [hull_of(model, moment.part_poses(i), recording.camera) for i, model in enumerate(models)]
        windows = [window_of(hull, recording.camera) for hull in hulls]
        shown = [i for i in away.argsort(kind="stable") if windows[i]]
        if len(shown) < count:
            raise SystemExit(f"{SITE}: only {len(shown)} of {count} requested vehicles in the image of frame {frame}")
        keep += sorted(first + shown[k] for k in np.linspace(0, len(shown) - 1, count).round().astype(int))
    names = ("frame", "vehicle", "T_world_chassis", "T_world_wheels", "velocity", "lamps")
    return replace(recording, **{name: getattr(recording, name)[keep] for name in names})


# --------------------------------------------------------------------------------------------------------- contestants


class Skope:
    """The work of `skope gen` for each frame, from the recording to the files."""

    def __init__(self, recording: Recording, folder: Path, renderer: str) -> None:
        self.recording, self.store = recording, Store(folder)
        self.renderer = make_renderer(renderer, recording)

    def __call__(self, frame: int) -> None:
        for made in frames_of(self.recording, self.renderer, Rules(), Encoding(), [frame]):
            self.store.write_frame(made)


class Peer:
    """One pybullet client with the whole scene. Vehicles are moved, and everything is drawn again."""

    def __init__(self, recording: Recording, renderer: str, labels: bool) -> None:
        self.engine, self.recording, self.labels = engine(), recording, labels
        self.light = Light.of(recording.conditions)
        self.client = self.engine.connect(self.engine.DIRECT)
        self.renderer = self.engine.ER_TINY_RENDERER
        if renderer == "egl":
            library = find_spec("eglRenderer")
            assert library is not None
            assert self.engine.loadPlugin(str(library.origin), "_eglRendererPlugin", physicsClientId=self.client) >= 0
            self.renderer = self.engine.ER_BULLET_HARDWARE_OPENGL
        self.add(scenery(recording.town).mesh)
        self.vehicles: dict[int, list[list[int]]] = {}

    def add(self, mesh: Any) -> list[int]:
        bodies = []
        for material, part in mesh.by_material().items():
            # The EGL plugin can only draw meshes from files.
            with tempfile.NamedTemporaryFile("w", suffix=".obj") as file:
                np.savetxt(file, part.vertices, "v %.5f %.5f %.5f")
                np.savetxt(file, part.normals, "vn %.4f %.4f %.4f")
                np.savetxt(file, (part.triangles + 1).repeat(2, axis=1), "f %d//%d %d//%d %d//%d")
                file.flush()
                shape = self.engine.createVisualShape(
                    self.engine.GEOM_MESH,
                    fileName=file.name,
                    rgbaColor=[*MATERIAL_COLORS.get(material, (0.5, 0.5, 0.5)), 1],
                    physicsClientId=self.client,
                )
            bodies.append(self.engine.createMultiBody(0, -1, shape, physicsClientId=self.client))
        return bodies

    def move(self, present: dict[int, list[np.ndarray]]) -> None:
        away = np.eye(4)
        away[2, 3] = -1000
        for track, parts in self.vehicles.items():
            for bodies, T in zip(parts, present.get(track, [away] * 5), strict=True):
                for body in bodies:
                    self.engine.resetBasePositionAndOrientation(
                        body, T[:3, 3], quaternion(T[:3, :3]), physicsClientId=self.client
                    )

    def draw(self) -> None:
        camera = self.recording.camera
        width, height, f = camera.width, camera.height, camera.K[0, 0]
        projection = np.zeros((4, 4))
        projection[0, 0], projection[1, 1] = 2 * f / width, 2 * f / height
        projection[2, 2:] = (
            -(TINY_LIMITS.far_m + WINDOW_LIMITS.clip_depth_m) / (TINY_LIMITS.far_m - WINDOW_LIMITS.clip_depth_m),
            -2 * TINY_LIMITS.far_m * WINDOW_LIMITS.clip_depth_m / (TINY_LIMITS.far_m - WINDOW_LIMITS.clip_depth_m),
        )
        projection[3, 2] = -1
        view = np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.T_camera_world
        self.image = self.engine.getCameraImage(
            *(width, height, view.T.ravel().tolist(), projection.T.ravel().tolist()),
            lightDirection=list(self.light.direction),
            shadow=1,
            renderer=self.renderer,
            physicsClientId=self.client,
        )

    def __call__(self, frame: int) -> None:
        moment, present = self.recording.moment(frame).labelled(), {}
        for i, vehicle in enumerate(moment.vehicles):
            if vehicle.track_id not in self.vehicles:
                model = build_vehicle(vehicle.model, vehicle.shape)
                self.vehicles[vehicle.track_id] = [self.add(model.mesh), *(self.add(model.wheel) for _ in range(4))]
            present[vehicle.track_id] = [moment.T_world_chassis[i], *moment.T_world_wheels[i]]
        self.move(present)
        self.draw()
        if self.labels:
            for track in present:
                self.move({track: present[track]})
                self.draw()


# ----------------------------------------------------------------------------------------------------------- processes


def work(make: Callable[[Recording], Callable[[int], None]], path: Path, start: Any, frames: int, out: Any) -> None:
    """Run one process: prepare, wait for the other processes, then draw the frames."""
    os.environ["LP_NUM_THREADS"] = "1"  # for peers that draw with llvmpipe
    cv2.setNumThreads(1)
    try:
        recording = recordings.load(path)
        draw = make(recording)
        for frame in range(len(recording) if isinstance(draw, Skope) else 1):
            draw(frame)  # build and upload the models once
    except BaseException:
        start.abort()  # otherwise the other processes would wait for this one
        raise
    start.wait()
    begun = time.perf_counter()
    for frame in range(frames):
        draw(frame % len(recording))
    out.put((begun, time.perf_counter()))


def frames_per_second(
    make: Callable[[Recording], Callable[[int], None]], path: Path, processes: int, frames: int
) -> float:
    """Return the frames of all processes over the time from the first start to the last end."""
    context = multiprocessing.get_context("fork")
    start, out = context.Barrier(processes), context.Queue()
    workers = [context.Process(target=work, args=(make, path, start, frames, out)) for _ in range(processes)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0, "a process died"
    times = [out.get() for _ in workers]
    return processes * frames / (max(end for _, end in times) - min(begun for begun, _ in times))


@contextmanager
def timed_stages() -> Iterator[dict[str, float]]:
    """Measure the seconds per stage of the drawing in this context.

    It waits for the device after each stage, which makes the sum slightly larger.
    """
    from skope.gen.output import frames as made
    from skope.gen.pipeline.dataset_store import Store
    from skope.gen.render import camera_effects
    from skope.gen.render.gl import renderer as gl
    from skope.gen.render.gl.ground_lights import Beams
    from skope.gen.render.gl.wet_ground import Reflections
    from skope.gen.render.glare import Glare
    from skope.gen.render.rain_and_snow import Rain

    classes = (gl.GLRenderer, gl.Placer, gl.Device, Beams, Reflections, Glare, Rain, Store, made.Encoding)
    modules = {"renderer": gl, "camera_effects": camera_effects, "frames": made}
    owners = {owner.__name__: owner for owner in classes} | modules
    spent, inner = dict.fromkeys(STAGES, 0.0), [0.0]

    def timed(function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def run(*args: Any, **keywords: Any) -> Any:
            begun = time.perf_counter()
            inner.append(0.0)
            value = function(*args, **keywords)
            gl.device().context.finish()
            taken = time.perf_counter() - begun
            spent[stage] += taken - inner.pop()
            inner[-1] += taken
            return value

        return run

    undo = []
    for stage, names in STAGES.items():
        for name in names:
            path, last = name.split(".")
            owner = owners[path]
            undo.append((owner, last, getattr(owner, last)))
            setattr(owner, last, timed(getattr(owner, last), stage))
    yield spent
    for owner, name, function in undo:
        setattr(owner, name, function)


def stage_table(path: Path, folder: Path, frames: int) -> dict[str, float]:
    """Return the milliseconds per frame of each stage."""
    recording = recordings.load(path)
    draw = Skope(recording, folder, "gl")
    for frame in range(len(recording)):
        draw(frame)
    with timed_stages() as spent:
        for frame in range(frames):
            draw(frame % len(recording))
    return {stage: 1e3 * seconds / frames for stage, seconds in spent.items()}


class Writer(Peer):
    """The peer, which also writes its files."""

    def __init__(self, recording: Recording, renderer: str, folder: Path) -> None:
        super().__init__(recording, renderer, labels=True)
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def __call__(self, frame: int) -> None:
        super().__call__(frame)
        _, _, rgba, depth, _ = self.image
        rgb = np.reshape(rgba, (self.recording.camera.height, self.recording.camera.width, 4))[..., :3]
        cv2.imwrite(str(self.folder / f"{frame}.jpg"), rgb.astype(np.uint8)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        metres = np.reshape(depth, rgb.shape[:2])
        cv2.imwrite(str(self.folder / f"{frame}.png"), (metres * 65535).astype(np.uint16))


def recorded_vehicles(dataset: Path) -> float:
    """Return the mean number of vehicles per frame; traffic builds up in a long recording."""
    (path,) = (dataset / "recordings").iterdir()
    recording = recordings.load(path)
    return float(np.mean([len(recording.moment(frame).labelled().vehicles) for frame in range(len(recording))]))


STAGES_OF_WORLD = ("vehicle meshes", "town", "light", "drawing", "labels", "encoding, writing", "end of the run")


class Stages:
    """Seconds of each stage of a run."""

    def __init__(self) -> None:
        self.wall = dict.fromkeys(STAGES_OF_WORLD, 0.0)
        self.processor = dict.fromkeys(STAGES_OF_WORLD, 0.0)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of this context to a stage."""
        wall, processor = time.perf_counter(), time.process_time()
        yield
        self.wall[stage] += time.perf_counter() - wall
        self.processor[stage] += time.process_time() - processor


def skope(*words: str) -> float:
    """Run `skope gen` with these arguments; returns its seconds."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "skope", "gen", *words, "--quiet"], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begun


def render_by_stages(root: Path, stages: Stages) -> int:
    """Render the recordings of a dataset folder and complete it; returns the number of vehicles built."""
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


def simulated(path: Path, size: tuple[int, int], frames: int, light: str) -> None:
    """Simulate a recording of `SITE` with dense traffic."""
    weather, hour = light.split()
    busy = replace(site(SITE), vehicles_per_hour=DENSITY * site(SITE).vehicles_per_hour)
    lit_site = replace(busy, weather=weather, time_of_day=hour)
    plan = RecordingPlan(site=lit_site, index=0, frames=frames, interval=0.5, size=size, fov_deg=110, seed=0)
    recordings.save(path, simulate(plan))


def bench_frames(options: argparse.Namespace, folder: Path) -> None:
    """Measure the frames per second, the stages of a frame, and the peers."""
    width, height = map(int, options.size.split("x"))
    counts = [int(count) for count in options.vehicles.split(",")]
    full = options.recording
    if full is None:
        full = folder / "full.npz"
        simulated(full, (width, height), 8, options.light)
    paths = {count: folder / f"{count}.npz" for count in counts}
    for count, path in paths.items():
        recordings.save(path, with_vehicles(recordings.load(full), count))
    print(f"{SITE}, {options.light}, {width}x{height}, {options.processes} processes of one thread; frames per second")
    ours = {}
    for count, path in paths.items():

        def ready(recording: Recording, count: int = count) -> Callable[[int], None]:
            return Skope(recording, folder / f"{count}_{os.getpid()}", "gl")

        ours[count] = frames_per_second(ready, path, options.processes, options.frames)
        print(f"  skope, gl, to disk, {count:2} vehicles   {ours[count]:7.2f}", flush=True)
    middle = counts[len(counts) // 2]
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        table = pool.submit(stage_table, paths[middle], folder / "stages", options.frames).result()
    print(f"milliseconds per frame by stage, {middle} vehicles, one process")
    for stage, milliseconds in (*table.items(), ("sum", sum(table.values()))):
        print(f"  {stage:<20} {milliseconds:7.1f}", flush=True)
    if options.skope_only:
        return
    print(f"pybullet on the same recording, {middle} vehicles; speed of skope, gl, to disk, relative to it")
    for renderer, title in PEERS.items():
        for labels, content in ((False, "colour, depth, ids"), (True, "and each vehicle alone")):

            def peer(recording: Recording, renderer: str = renderer, labels: bool = labels) -> Peer:
                return Peer(recording, renderer, labels)

            frames = 2 if labels or renderer == "tiny" else 8
            rate = frames_per_second(peer, paths[middle], options.processes, frames)
            print(f"  {title:<42} {content:<24} {rate:7.3f}   x{ours[middle] / rate:.1f}", flush=True)


def bench_dataset(options: argparse.Namespace, folder: Path) -> None:
    """Measure the images per second from simulation to finished dataset, for skope and the peers."""
    if options.flat:
        bench_growth(options, folder)
        return
    data, workers = folder / "d", ["--workers", str(options.processes)]
    words = ["--sites", SITE, "--frames", str(options.images), "--size", options.size, *workers]
    simulation = skope("simulate", "--out", str(data), *words)
    rendering = skope("render", str(data), *workers)
    ours = options.images / (simulation + rendering)
    (path,) = (data / "recordings").iterdir()
    print(f"{SITE}, {options.size}, {options.images} images, {recorded_vehicles(data):.1f} recorded vehicles in each,")
    print(f"{options.processes} processes; everything on disk, labels included")
    print(f"  skope: simulation {simulation:.1f} s, rendering {rendering:.1f} s (the scenery is lit only once):")
    print(f"  {ours:.3f} images/s", flush=True)
    for renderer, title in PEERS.items():

        def peer(recording: Recording, renderer: str = renderer) -> Callable[[int], None]:
            return Writer(recording, renderer, folder / f"{renderer}_{os.getpid()}")

        rate = frames_per_second(peer, path, options.processes, options.peer_frames)
        rate = 1 / (1 / rate + simulation / options.images)
        print(f"  pybullet, {title:<42} {rate:8.4f} images/s   x{ours / rate:.1f}", flush=True)


def bench_growth(options: argparse.Namespace, folder: Path) -> None:
    """Measure the time and memory of datasets of growing size."""
    size, workers = "320x180", str(options.processes)
    print(f"{SITE}, {size}, {workers} processes: cost of an image, after the scenery is lit")
    for count in (2, *map(int, options.flat.split(","))):
        data = folder / f"{count}_images"
        words = ["--sites", SITE, "--frames", str(count), "--size", size, "--workers", workers]
        seconds = skope("--out", str(data), *words)
        memory, vehicles = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024, recorded_vehicles(data)
        first = "  (fills the cache)" if count == 2 else ""
        print(
            f"  {count:6} images {1e3 * seconds / count:7.1f} ms per image of {vehicles:.1f} recorded vehicles, "
            f"{1e3 * seconds / count / vehicles:.1f} per vehicle, {memory:6.0f} MB{first}",
            flush=True,
        )


def bench_world(options: argparse.Namespace, folder: Path) -> None:
    """Measure the images per second of the preset `world`, and its stages in one process."""
    workers = ["--workers", str(options.processes)]
    words = ["--preset", "world", "--sites", options.sites, "--frames", str(options.frames), "--size", options.size]
    simulated_s = 0.0
    if options.recordings:
        shutil.copytree(options.recordings, folder / "world")
    else:
        simulated_s = skope("simulate", *words, "--no-depth", *workers, "--out", str(folder / "world"))
    shutil.copytree(folder / "world", folder / "stages")
    rendered_s = skope("render", str(folder / "world"), *workers)
    os.environ["SKOPE_CACHE"] = str(folder / "cache of the stages")  # empty, as in the first run
    stages = Stages()
    built = render_by_stages(folder / "stages", stages)
    plan = Store(folder / "stages").plan
    images, parameters = sum(info.frames for info in plan.recordings), plan.parameters
    print(f"world, {parameters.size}, {images} images of {','.join(parameters.sites)}, {options.processes} processes")
    print(f"  simulation {simulated_s:.1f} s, rendering {rendered_s:.1f} s: ", end="")
    print(f"{images / (simulated_s + rendered_s):.3f} images/s")
    print(f"  rendering in one process, {built} vehicles built: seconds, and processor time per image, ms")
    for stage in STAGES_OF_WORLD:
        print(f"    {stage:<18} {stages.wall[stage]:8.2f} {1e3 * stages.processor[stage] / images:8.1f}")
    total = sum(stages.wall.values())
    print(f"    {'all':<18} {total:8.2f} {1e3 * sum(stages.processor.values()) / images:8.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    frames = commands.add_parser("frames", help="frames per second")
    frames.add_argument("--light", default="clear noon", help="weather and hour, such as 'rain night'")
    frames.add_argument("--vehicles", default="6,12,20", help="vehicles in each image")
    frames.add_argument("--frames", type=int, default=24, help="frames per process of skope")
    frames.add_argument("--recording", type=Path, help="use this recording of that site instead of simulating one")
    frames.add_argument("--skope-only", action="store_true", help="skip pybullet's renderers")
    dataset = commands.add_parser("dataset", help="simulation to finished dataset")
    dataset.add_argument("--images", type=int, default=100)
    dataset.add_argument("--peer-frames", type=int, default=2, help="frames per process of the peers")
    dataset.add_argument("--flat", help="numbers of images, separated by commas: cost of an image, at 320x180")
    world = commands.add_parser("world", help="stages of the preset `world`")
    world.add_argument("--frames", type=int, default=96, help="frames per site; 96 are a group of four views")
    world.add_argument(
        "--sites", default="t01_mill_corner", help="sites of the split `train`, whose recordings share towns"
    )
    world.add_argument("--recordings", type=Path, help="folder of `skope gen simulate`, if SUMO is not installed")
    for command, run, size in (
        (frames, bench_frames, "1920x1080"),
        (dataset, bench_dataset, "1920x1080"),
        (world, bench_world, "1280x720"),
    ):
        command.add_argument("--size", default=size)
        command.add_argument("--processes", type=int, default=usable_processors())
        command.set_defaults(run=run)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.environ["SKOPE_CACHE"] = str(Path(name) / "cache")
        options.run(options, Path(name))


if __name__ == "__main__":
    main()
