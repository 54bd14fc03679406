"""Images per second of `skope gen`, simulation to finished dataset, against a plain loop over pybullet's camera.

The peer is what one would write today: the same recording, `getCameraImage` for colour, depth and ids, once more for
every vehicle alone (its whole silhouette, for box and occlusion), JPEG and depth by OpenCV; one process per core.
With --flat: what an image costs, and the memory, of datasets of growing size.
Run: make bench, or python scripts/bench_gen.py --flat 100,1000,5000
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from bench_render import Peer, frames_per_second

from skope.cpu_count import usable_processors
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording

SITE = "t01_main_west"


class Writer(Peer):
    """The peer, with its files."""

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


def skope(out: Path, size: str, frames: int, workers: int, *more: str) -> tuple[float, float]:
    """Seconds of `skope gen`, and the largest memory of its processes, MB."""
    command = [sys.executable, "-m", "skope", "gen", *more, "--out", str(out), "--quiet"]
    command += ["--sites", SITE, "--frames", str(frames), "--size", size, "--workers", str(workers)]
    begun = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def recorded_vehicles(dataset: Path) -> float:
    """Of a frame, on average: traffic builds up in a long recording."""
    (path,) = (dataset / "recordings").iterdir()
    recording = recordings.load(path)
    return float(np.mean([len(recording.moment(frame).labelled().vehicles) for frame in range(len(recording))]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--images", type=int, default=100)
    parser.add_argument("--processes", type=int, default=usable_processors())
    parser.add_argument("--peer-frames", type=int, default=2, help="of each of the peers' processes")
    parser.add_argument("--flat", help="comma-separated numbers of images, at 320x180")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["SKOPE_CACHE"] = str(folder / "cache")
        if options.flat:
            print(f"{SITE}, 320x180, {options.processes} processes: what an image costs, after the scenery is lit")
            skope(folder / "warm", "320x180", 2, options.processes)
            for count in map(int, options.flat.split(",")):
                seconds, memory = skope(folder / str(count), "320x180", count, options.processes)
                vehicles = recorded_vehicles(folder / str(count))
                print(
                    f"  {count:6} images {1e3 * seconds / count:7.1f} ms an image of {vehicles:.1f} recorded", end=" "
                )
                print(f"vehicles, {1e3 * seconds / count / vehicles:.1f} a vehicle, {memory:6.0f} MB", flush=True)
            return
        halves = {}
        for half in ("simulate", "render"):
            begun = time.perf_counter()
            command = [sys.executable, "-m", "skope", "gen", half, "--quiet", "--workers", str(options.processes)]
            if half == "simulate":
                command += ["--out", str(folder / "d"), "--sites", SITE, "--frames", str(options.images)]
                command += ["--size", options.size]
            else:
                command += [str(folder / "d")]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            halves[half] = time.perf_counter() - begun
        ours = options.images / sum(halves.values())
        (path,) = (folder / "d" / "recordings").iterdir()
        vehicles = recorded_vehicles(folder / "d")
        print(f"{SITE}, {options.size}, {options.images} images, {vehicles:.1f} recorded vehicles in each,", end=" ")
        print(f"{options.processes} processes; everything on disk, labels included")
        print(f"  skope: simulation {halves['simulate']:.1f} s, rendering {halves['render']:.1f} s (of which lighting")
        print(f"  the scenery is done once): {ours:.3f} images/s", flush=True)
        for renderer, title in (("tiny", "TinyRenderer"), ("egl", "EGL plugin")):

            def peer(recording: Recording, renderer: str = renderer) -> Callable[[int], None]:
                return Writer(recording, renderer, folder / f"{renderer}_{os.getpid()}")

            rate = frames_per_second(peer, path, options.processes, options.peer_frames)
            rate = 1 / (1 / rate + halves["simulate"] / options.images)
            print(f"  pybullet, {title:<14} {rate:8.4f} images/s   x{ours / rate:.1f}", flush=True)


if __name__ == "__main__":
    main()
