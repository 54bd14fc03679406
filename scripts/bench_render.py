"""Seconds a frame of `skope gen`'s renderers against the loop that one would write with pybullet directly.

All draw the same recording and yield colour, depth and instance ids; the peer draws the whole scene
with one `getCameraImage` a frame and, for the labels, every vehicle once more by itself. Run: make bench
"""

import argparse
import time

import numpy as np

from skope.gen.bullet import engine
from skope.gen.recording import Recording
from skope.gen.render import make_renderer
from skope.gen.render.materials import MATERIALS, Light
from skope.gen.render.tiny import FAR, quaternion
from skope.gen.render.windows import NEAR
from skope.gen.simulate import RecordingPlan, simulate
from skope.gen.towns import site
from skope.gen.towns.scenery import scenery
from skope.gen.vehicles import build


class Peer:
    """One pybullet client with the whole scene in it; vehicles are moved and everything is drawn anew."""

    def __init__(self, recording: Recording) -> None:
        self.engine, self.recording, self.light = engine(), recording, Light.of(recording)
        self.client = self.engine.connect(self.engine.DIRECT)
        self.add(scenery(recording.town).mesh)
        self.vehicles: dict[int, list[list[int]]] = {}

    def add(self, mesh) -> list[int]:
        bodies = []
        for material, part in mesh.by_material().items():
            shape = self.engine.createVisualShape(
                self.engine.GEOM_MESH,
                vertices=part.vertices.tolist(),
                indices=part.triangles.ravel().tolist(),
                normals=part.normals.tolist(),
                rgbaColor=[*MATERIALS.get(material, (0.5, 0.5, 0.5)), 1],
                physicsClientId=self.client,
            )
            bodies.append(self.engine.createMultiBody(0, -1, shape, physicsClientId=self.client))
        return bodies

    def move(self, bodies: list[int], T: np.ndarray) -> None:
        orientation = quaternion(T[:3, :3])
        for body in bodies:
            self.engine.resetBasePositionAndOrientation(body, T[:3, 3], orientation, physicsClientId=self.client)

    def draw(self) -> None:
        camera = self.recording.camera
        width, height, f = camera.width, camera.height, camera.K[0, 0]
        projection = np.zeros((4, 4))
        projection[0, 0], projection[1, 1] = 2 * f / width, 2 * f / height
        projection[2, 2:] = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
        projection[3, 2] = -1
        view = np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.T_camera_world
        self.engine.getCameraImage(
            *(width, height, view.T.ravel().tolist(), projection.T.ravel().tolist()),
            lightDirection=list(self.light.direction),
            shadow=1,
            renderer=self.engine.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )

    def render(self, frame: int, silhouettes: bool) -> None:
        moment = self.recording.moment(frame)
        far = np.eye(4)
        far[2, 3] = -1000
        present = {}
        for i, vehicle in enumerate(moment.vehicles):
            if vehicle.track_id not in self.vehicles:
                model = build(vehicle.model, vehicle.shape)
                parts = [self.add(model.mesh), *(self.add(model.wheel) for _ in range(4))]
                self.vehicles[vehicle.track_id] = parts
            present[vehicle.track_id] = [moment.T_world_chassis[i], *moment.T_world_wheels[i]]
        for track, parts in self.vehicles.items():
            for bodies, T in zip(parts, present.get(track, [far] * 5), strict=True):
                self.move(bodies, T)
        self.draw()
        if silhouettes:
            for track in present:
                for other, parts in self.vehicles.items():
                    for bodies, T in zip(parts, present.get(other, [far] * 5), strict=True):
                        self.move(bodies, T if other == track else far)
                self.draw()


def seconds(draw, frames: int) -> float:
    """Median seconds a frame."""
    times = []
    for frame in range(frames):
        begun = time.perf_counter()
        draw(frame)
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--site", default="t01_main_west")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    recording = simulate(
        RecordingPlan(
            site=site(options.site),
            index=0,
            frames=options.frames,
            interval=0.5,
            size=(width, height),
            fov_deg=110,
            seed=0,
        )
    )
    peer = Peer(recording)
    plain = seconds(lambda frame: peer.render(frame, silhouettes=False), options.frames)
    labels = seconds(lambda frame: peer.render(frame, silhouettes=True), 2)
    vehicles = len(recording.frame) / len(recording)
    print(f"{options.site} at {options.size}, {vehicles:.0f} vehicles near the camera, one process")
    print(f"{'peer, TinyRenderer, whole scene':<34} {plain:7.3f} s a frame, with silhouettes {labels:7.3f} s")
    for name in ("gl", "pybullet"):
        begun = time.perf_counter()
        renderer = make_renderer(name, recording)
        setup = time.perf_counter() - begun
        ours = seconds(renderer.render, options.frames)
        print(
            f"{'skope, ' + name + ', with silhouettes':<34} {ours:7.3f} s a frame (+ {setup:.1f} s once); "
            f"the peer takes {plain / ours:.1f} x and with silhouettes {labels / ours:.0f} x as long"
        )


if __name__ == "__main__":
    main()
