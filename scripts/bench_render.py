"""Frames per second of `skope gen`, and of pybullet's renderers on the same scene in the same run.

skope writes whole frames (JPEG, depth, annotations). The peers draw colour, depth and ids of the whole scene with one
`getCameraImage` a frame, and for labels like skope's every vehicle once more by itself; nothing of theirs is written.
One process per core with one thread each, all at work at the same time, once each vehicle model has been built.
Run: make bench
"""

import argparse
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from skope.cpu_count import usable_processors
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.towns.sites import site

SITE = "t01_main_west"
DENSITY = 2
"""Times the site's own traffic, so that there are enough vehicles to choose from in each frame."""
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
    """The recording with `count` of the vehicles in each image, spread evenly from the nearest to the farthest.

    No other road users are left.
    """
    from skope.gen.render.pixel_windows import hull_of, window_of
    from skope.gen.vehicles.fleet import build_vehicle

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
            raise SystemExit(f"{SITE}: only {len(shown)} vehicles in the image of frame {frame}, {count} are asked for")
        keep += sorted(first + shown[k] for k in np.linspace(0, len(shown) - 1, count).round().astype(int))
    names = ("frame", "vehicle", "T_world_chassis", "T_world_wheels", "velocity", "lamps")
    return replace(recording, **{name: getattr(recording, name)[keep] for name in names})


# --------------------------------------------------------------------------------------------------------- contestants


class Skope:
    """What `skope gen` does for each frame, from the recording to the files."""

    def __init__(self, recording: Recording, folder: Path, renderer: str) -> None:
        from skope.gen.pipeline.dataset_store import Store
        from skope.gen.render.choose_renderer import make_renderer

        self.recording, self.store = recording, Store(folder)
        self.renderer = make_renderer(renderer, recording)

    def __call__(self, frame: int) -> None:
        from skope.gen.labels.annotate import Rules
        from skope.gen.output.frames import Encoding, frames_of

        for made in frames_of(self.recording, self.renderer, Rules(), Encoding(), [frame]):
            self.store.write_frame(made)


class Peer:
    """One pybullet client with the whole scene in it; vehicles are moved and everything is drawn anew."""

    def __init__(self, recording: Recording, renderer: str, labels: bool) -> None:
        from skope.gen.render.materials import Light
        from skope.gen.scenery.build import scenery
        from skope.gen.simulation.pybullet_engine import engine

        self.engine, self.recording, self.labels = engine(), recording, labels
        self.light = Light.of(recording.conditions)
        self.client = self.engine.connect(self.engine.DIRECT)
        self.renderer = self.engine.ER_TINY_RENDERER
        if renderer == "egl":
            from importlib.util import find_spec

            library = find_spec("eglRenderer")
            assert library is not None
            assert self.engine.loadPlugin(str(library.origin), "_eglRendererPlugin", physicsClientId=self.client) >= 0
            self.renderer = self.engine.ER_BULLET_HARDWARE_OPENGL
        self.add(scenery(recording.town).mesh)
        self.vehicles: dict[int, list[list[int]]] = {}

    def add(self, mesh: Any) -> list[int]:
        from skope.gen.render.materials import MATERIAL_COLORS

        bodies = []
        for material, part in mesh.by_material().items():
            # The EGL plugin draws meshes from files only.
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
        from skope.gen.render.tiny_renderer import quaternion

        away = np.eye(4)
        away[2, 3] = -1000
        for track, parts in self.vehicles.items():
            for bodies, T in zip(parts, present.get(track, [away] * 5), strict=True):
                for body in bodies:
                    self.engine.resetBasePositionAndOrientation(
                        body, T[:3, 3], quaternion(T[:3, :3]), physicsClientId=self.client
                    )

    def draw(self) -> None:
        from skope.gen.render.pixel_windows import WINDOW_LIMITS
        from skope.gen.render.tiny_renderer import TINY_LIMITS

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
        from skope.gen.vehicles.fleet import build_vehicle

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
    """A process: gets ready, waits for the others, draws its frames."""
    os.environ["LP_NUM_THREADS"] = "1"  # of the peers, if they draw with llvmpipe
    import cv2

    cv2.setNumThreads(1)
    try:
        recording = recordings.load(path)
        draw = make(recording)
        for frame in range(len(recording) if isinstance(draw, Skope) else 1):
            draw(frame)  # models are built and uploaded once
    except BaseException:
        start.abort()  # or the others would wait for this one
        raise
    start.wait()
    begun = time.perf_counter()
    for frame in range(frames):
        draw(frame % len(recording))
    out.put((begun, time.perf_counter()))


def frames_per_second(
    make: Callable[[Recording], Callable[[int], None]], path: Path, processes: int, frames: int
) -> float:
    """All processes' frames over the time from the first one's start to the last one's end."""
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
    """Seconds by stage of what is drawn within; waiting for the device after each, their sum is a little larger."""
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
    """Milliseconds a frame by stage."""
    recording = recordings.load(path)
    draw = Skope(recording, folder, "gl")
    for frame in range(len(recording)):
        draw(frame)
    with timed_stages() as spent:
        for frame in range(frames):
            draw(frame % len(recording))
    return {stage: 1e3 * seconds / frames for stage, seconds in spent.items()}


# ---------------------------------------------------------------------------------------------------------------- main


def simulated(path: Path, size: tuple[int, int], frames: int, light: str) -> None:
    from skope.gen.simulation.simulate import simulate

    weather, hour = light.split()
    busy = replace(site(SITE), vehicles_per_hour=DENSITY * site(SITE).vehicles_per_hour)
    place = replace(busy, weather=weather, time_of_day=hour)
    plan = RecordingPlan(site=place, index=0, frames=frames, interval=0.5, size=size, fov_deg=110, seed=0)
    recordings.save(path, simulate(plan))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--light", default="clear noon", help="weather and hour, such as 'rain night'")
    parser.add_argument("--vehicles", default="6,12,20")
    parser.add_argument("--frames", type=int, default=24, help="of each of skope's processes")
    parser.add_argument("--processes", type=int, default=usable_processors())
    parser.add_argument("--recording", type=Path, help="a recording of that site, instead of simulating one")
    parser.add_argument("--skope-only", action="store_true", help="leave pybullet's renderers out")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    counts = [int(count) for count in options.vehicles.split(",")]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        full = options.recording
        if full is None:
            full = folder / "full.npz"
            simulated(full, (width, height), 8, options.light)
        paths = {count: folder / f"{count}.npz" for count in counts}
        for count, path in paths.items():
            recordings.save(path, with_vehicles(recordings.load(full), count))
        print(
            f"{SITE}, {options.light}, {width}x{height}, {options.processes} processes of one thread;",
            "frames per second",
            flush=True,
        )
        ours = {}
        for count, path in paths.items():

            def skope(recording: Recording, count: int = count) -> Callable[[int], None]:
                return Skope(recording, folder / f"{count}_{os.getpid()}", "gl")

            ours[count] = frames_per_second(skope, path, options.processes, options.frames)
            print(f"  skope, gl, to disk, {count:2} vehicles   {ours[count]:7.2f}", flush=True)
        middle = counts[len(counts) // 2]
        with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
            table = pool.submit(stage_table, paths[middle], folder / "stages", options.frames).result()
        print(f"milliseconds a frame by stage, {middle} vehicles, one process")
        for stage, milliseconds in table.items():
            print(f"  {stage:<20} {milliseconds:7.1f}")
        print(f"  {'sum':<20} {sum(table.values()):7.1f}", flush=True)
        if options.skope_only:
            return
        print(f"pybullet on the same recording, {middle} vehicles; how many times as fast skope, gl, to disk, is")
        for renderer, title in (("tiny", "TinyRenderer"), ("egl", "EGL plugin (draws 1024x768, enlarges it)")):
            for labels, what in ((False, "colour, depth, ids"), (True, "and each vehicle alone")):

                def peer(recording: Recording, renderer: str = renderer, labels: bool = labels) -> Peer:
                    return Peer(recording, renderer, labels)

                frames = 2 if labels or renderer == "tiny" else 8
                rate = frames_per_second(peer, paths[middle], options.processes, frames)
                print(f"  {title:<42} {what:<24} {rate:7.3f}   x{ours[middle] / rate:.1f}", flush=True)


if __name__ == "__main__":
    main()
