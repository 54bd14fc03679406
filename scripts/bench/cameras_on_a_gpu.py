"""Measure how many frames per second one GPU detects for several cameras: a process for each, or shared batches.

    python scripts/bench/cameras_on_a_gpu.py data/world/images --cameras 8 --checkpoint road33-lite

The images of the folder are dealt out to the cameras, and repeated. In the first way each camera has a process with a
detector of its own, which takes one image at a time, as in `skope eval station`. In the second way one process reads
the images of all cameras in threads, and detects in batches of one image per camera.
"""

import argparse
import itertools
import json
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

IMAGE_SUFFIXES: Final = (".jpg", ".png")
WARM_UP: Final = 6


def files_of(options: argparse.Namespace, camera: int) -> list[Path]:
    """Return the images of one camera."""
    files = sorted(path for path in options.images.rglob("*") if path.suffix in IMAGE_SUFFIXES)
    return files[camera :: options.cameras]


def loaded(options: argparse.Namespace) -> Any:
    """Return the detector."""
    import skope

    return skope.load_detector(options.checkpoint, device=options.device)


def memory_mb(options: argparse.Namespace) -> float:
    """Return the memory that torch holds on the GPU, MB."""
    import torch

    return torch.cuda.max_memory_reserved() / 1e6 if options.device != "cpu" else 0.0


def detect_alone(options: argparse.Namespace) -> None:
    """Detect in the images of one camera, one by one, after a line on standard input; print what was measured."""
    detector = loaded(options)
    files = itertools.cycle(files_of(options, options.camera))
    for _ in range(WARM_UP):
        detector(next(files))
    print("ready", flush=True)
    sys.stdin.readline()
    begun, count = time.monotonic(), 0
    while time.monotonic() - begun < options.seconds:
        detector(next(files))
        count += 1
    print(json.dumps([count / (time.monotonic() - begun), memory_mb(options)]), flush=True)


def measure_processes(options: argparse.Namespace) -> tuple[float, float]:
    """Return frames per second and memory (MB) of all cameras together, with a process for each."""
    processes = [
        subprocess.Popen(
            [sys.executable, *sys.argv, "--camera", str(camera)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for camera in range(options.cameras)
    ]
    for process in processes:
        assert process.stdout is not None
        process.stdout.readline()
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    rows = [json.loads(process.communicate()[0]) for process in processes]
    return sum(row[0] for row in rows), sum(row[1] for row in rows)


def measure_batches(options: argparse.Namespace) -> tuple[float, float]:
    """Return frames per second and memory (MB) of all cameras together, in shared batches."""
    import skope

    detector = loaded(options)
    frames: list[queue.Queue[Any]] = [queue.Queue(4) for _ in range(options.cameras)]

    def read(camera: int) -> None:
        for path in itertools.cycle(files_of(options, camera)):
            frames[camera].put(skope.read_image(path))

    for camera in range(options.cameras):
        threading.Thread(target=read, args=(camera,), daemon=True).start()
    for _ in range(WARM_UP):
        detector.detect_batch([source.get() for source in frames])
    begun, count = time.monotonic(), 0
    while time.monotonic() - begun < options.seconds:
        detector.detect_batch([source.get() for source in frames])
        count += options.cameras
    return count / (time.monotonic() - begun), memory_mb(options)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("images", type=Path, help="folder of images, all of one size")
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--checkpoint", default="road33-lite")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--camera", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.camera is not None:
        detect_alone(options)
        return
    for name, measured in (("a process for each", measure_processes), ("shared batches", measure_batches)):
        rate, memory = measured(options)
        print(f"{options.cameras} cameras, {name}: {rate:.1f} frames/s, {memory:.0f} MB of GPU memory", flush=True)


if __name__ == "__main__":
    main()
