"""Speed of detectors on footage: ways of running one, steps to tracks, accuracy against time, a live stream.

    skope gen video t06_plaza_opening --fps 10 --seconds 12 --out footage     # and other sites
    python scripts/bench_footage.py ways footage --frames 12
    python scripts/bench_footage.py ways footage --device cuda --sizes 1080 --ways torchvision,torch-bfloat16 --times 8
    python scripts/bench_footage.py steps crossing.mp4 --camera crossing.json
    python scripts/bench_footage.py curve runs/curve --rows road33@540@key,road33-lite@540@every
    python scripts/bench_footage.py live footage/t06_plaza_opening.mp4 --fps 10 --minutes 30

`ways`: torchvision's own call, image by image; skope's backends and number formats on every frame; and `video`, the
default of `skope eval predict`. Each runs in a process of its own. The clock starts after it has loaded the detector
and processed one batch; decoding is included. Use `--times` if a clip ends before the pipelines are full. Memory is
that of the process, or on a GPU that of the GPU. Every frame is scored at IoU 0.6 (research/footage_scores.py): the
confirmed detections that `skope eval predict` writes, and for torchvision's call the detections above 0.5.

`steps`: seconds of `skope eval predict`, `track` and `pose`, seconds of footage per second, and megabytes written.

`curve`: a row is a detector, the short side inside the network, and `key` (default of `skope eval predict` on a CPU)
or `every` (--every-frame). Missing clips (CLIPS) are generated: roads that no detector was trained on, in two groups.
Images per second are over all clips and include decoding, camera shake and writing of results, but not loading; memory
is the peak of the process. All frames are scored, and the tracks that `skope eval track` makes of them; figures of
tracks are means over the clips of a group. The folder keeps the measurements.

`live`: a simulated web camera sends the video repeatedly (MJPEG over HTTP, from JPEG files made in advance), and
`skope eval predict` reads it in a process of its own. The table has a row for each sixth of the time: lag from sending
a frame to its results, skipped frames, memory.
"""

import argparse
import contextlib
import io
import itertools
import json
import math
import re
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from benchmark import in_own_process, machine, print_head, print_row
from research.footage_scores import COLUMNS, Counts, Row, count, measure

from skope.cli import main as main_of_skope
from skope.dataset import coco
from skope.dataset.folder import FRAMES_FILE
from skope.dataset.image_selection import part
from skope.detections import apart, results_of
from skope.detector.checkpoint import load_weights
from skope.detector.detect import as_tensor
from skope.detector.network_settings import MIN_SCORE, Settings
from skope.detector.predictor import Predictor
from skope.files.json_files import read_json, write_json
from skope.footage.confirmation import CONFIRMATION_LIMITS, Confirmation
from skope.footage.predict_footage import Prediction, found_in
from skope.footage.predict_job import PredictJob, claim
from skope.schema import AnnotationFile, Image, Result
from skope.terminal.console import Console
from skope.types import Pixels
from skope.video.footage import Footage, FrameRange, open_footage

# After `skope.detector`, as in the commands: it limits for how long torch's threads spin.
import torch  # isort: skip

SCORE: Final = 0.5
WAYS: Final = {
    "torchvision": ("torch", "float32"),
    "torch-float32": ("torch", "float32"),
    "torch-bfloat16": ("torch", "bfloat16"),
    "onnx-float32": ("onnx", "float32"),
    "openvino-float32": ("openvino", "float32"),
    "openvino-bfloat16": ("openvino", "bfloat16"),
    "openvino-int8": ("openvino", "int8"),
    "video": ("auto", "auto"),
}
"""Backend and number format of each way."""


def predictor_of(options: argparse.Namespace, way: str, size: int) -> Predictor:
    backend, precision = WAYS[way]
    settings = Settings(
        device=options.device,
        backend=backend,
        precision=precision,
        min_size=size,
        min_score=CONFIRMATION_LIMITS.weak_score,
    )
    return Predictor.load(options.checkpoint, settings, Console(quiet=True))


def clips(options: argparse.Namespace) -> list[tuple[Path, Footage]]:
    """Return the label files and their videos."""
    out = []
    for labels in sorted(options.footage.rglob("*.json")):
        times = [image.time_s or 0.0 for image in coco.read(labels).images]
        end = math.inf if options.frames >= len(times) else times[options.frames]
        out.append((labels, open_footage(str(labels.with_suffix(".mp4")), FrameRange(end_s=end))))
    return out


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Measure one way at one size, in this process."""
    way, size = options.only.split("@")
    predictor = predictor_of(options, way, int(size))
    all_clips = clips(options)
    _, first = all_clips[0]
    predictor.detections([pixels for _, pixels in itertools.islice(first.frames(), predictor.batch_size)])
    seconds, looked_at, total = 0.0, 0, Counts()
    for labels, footage in all_clips:
        truth = coco.read(labels)
        job = job_of(footage, way, options)
        begun = time.perf_counter()
        found = list(by_torchvision(predictor, job, options) if way == "torchvision" else ours(predictor, job, options))
        seconds += time.perf_counter() - begun
        rows = [(image, list(apart(each)[0])) for image, each in found]  # only vehicles are scored
        looked_at += len(rows)
        rows = rows[: len(rows) // options.times]
        score = SCORE if way == "torchvision" else 0.0
        total += count(first_frames(truth, len(rows)), kept(way, rows, job), score)
    on_gpu = torch.cuda.max_memory_allocated() / 2**20
    memory = on_gpu or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"rate": looked_at / seconds, "memory_mb": memory, "cells": total.cells()}


def first_frames(truth: AnnotationFile, number: int) -> AnnotationFile:
    return part(truth, truth.images[:number])


def job_of(footage: Footage, way: str, options: argparse.Namespace) -> PredictJob:
    settings = Settings(device=options.device)
    return PredictJob(footage=footage, checkpoint=Path(), out=Path(), settings=settings, every_frame=way != "video")


def ours(predictor: Predictor, job: PredictJob, options: argparse.Namespace) -> Iterator[tuple[Image, list[Result]]]:
    if job.key_every == 1:
        return predictor.each_ahead(frames(job, options))
    return ((image, found) for _ in range(options.times) for image, found, _ in found_in(job, predictor))


def frames(job: PredictJob, options: argparse.Namespace) -> Iterator[tuple[Image, Pixels]]:
    return itertools.chain.from_iterable(job.footage.frames() for _ in range(options.times))


def by_torchvision(
    predictor: Predictor, job: PredictJob, options: argparse.Namespace
) -> Iterator[tuple[Image, list[Result]]]:
    """Run the model with torchvision's defaults: 1000 proposals, and every detection above 0.05."""
    model, _, _ = load_weights(predictor.weights, options.device)
    config = predictor.config
    model.transform.min_size, model.transform.max_size = (config.min_size,), config.max_size
    model.rpn._post_nms_top_n["testing"] = 1000
    model.roi_heads.score_thresh, model.roi_heads.detections_per_img = MIN_SCORE, 100
    for image, pixels in frames(job, options):
        with torch.inference_mode():
            (found,) = model([as_tensor(pixels, options.device)])
        points = torch.cat([found["keypoints"][..., :2], found["keypoints_scores"].sigmoid()[..., None]], dim=-1)
        yield image, results_of(image.id, *(t.cpu() for t in (found["boxes"], found["scores"], points)))


def kept(way: str, rows: list[tuple[Image, list[Result]]], job: PredictJob) -> list[Result]:
    """Return the results that are scored."""
    if way == "torchvision":
        return [result for _, found in rows for result in found]
    confirmation = Confirmation(SCORE, every=job.key_every)
    for image, found in rows:
        confirmation.add(image.time_s or 0.0, found)
    stay = zip(rows, confirmation.confirmed(), strict=True)
    return [result for (_, found), flags in stay for result in itertools.compress(found, flags)]


def eval_seconds(*arguments: object) -> float:
    """Time a command of `skope eval`, without the start of the process."""
    sys.argv = ["skope", "eval", *map(str, arguments), "-q"]
    with contextlib.redirect_stdout(io.StringIO()):
        begun = time.perf_counter()
        with contextlib.suppress(SystemExit):
            main_of_skope()
        return time.perf_counter() - begun


@dataclass(frozen=True)
class ClipPlan:
    """A clip, and the conditions that it is generated with."""

    site: str
    weather: str
    hour: str
    group: str
    """`day`: seven clips by day, including rain. `other`: four clips at night, in fog and in snow."""

    @property
    def name(self) -> str:
        """Name of the clip's folder."""
        return f"{self.site}_{self.weather}_{self.hour}"


CLIPS: Final = (
    ClipPlan("t05_third_median", "clear", "noon", "day"),
    ClipPlan("t06_plaza_opening", "clear", "noon", "day"),
    ClipPlan("t06_willow_turn", "overcast", "noon", "day"),
    ClipPlan("t02_elm_corner", "clear", "dusk", "day"),
    ClipPlan("t06_harlan_long", "clear", "noon", "day"),
    ClipPlan("t02_cedar_pole", "rain", "noon", "day"),
    ClipPlan("t05_park_pole", "overcast", "noon", "day"),
    ClipPlan("t06_plaza_opening", "clear", "night", "other"),
    ClipPlan("t03_circle_mast", "rain", "night", "other"),
    ClipPlan("t02_elm_corner", "fog", "noon", "other"),
    ClipPlan("t05_park_pole", "snow", "noon", "other"),
)
SECONDS, FPS, SIZE = 12.0, 10.0, "1280x720"
CURVE_COLUMNS: Final = (
    *("detector", "short side", "frames", "images/s", "memory, MB", "clips", "precision", "recall"),
    *("of those in their first second", "PCK %", "tracked", "switches", "HOTA", "IDF1"),
)


def make(clip: ClipPlan, folder: Path, options: argparse.Namespace) -> Path:
    """Return the label file of a clip, generated if it is missing. The video lies beside it."""
    labels = folder / "clips" / clip.name / f"{clip.site}.json"
    if not labels.is_file():
        words = f"gen video {clip.site} --road-users --fov 80 -q --seconds {options.seconds} --fps {FPS} --seed 0"
        words += f" --size {options.size} --weather {clip.weather} --time-of-day {clip.hour}"
        subprocess.run(
            [sys.executable, "-m", "skope", *words.split(), "--out", str(labels.parent)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
    return labels


def folder_of(row: str, folder: Path) -> Path:
    """Return the folder of a row's results."""
    return folder / "rows" / row.replace("/", "_")


def look(row: str, clips: Sequence[Path], out: Path) -> dict[str, float]:
    """Run a detector on all clips in this process; returns its rate and memory."""
    checkpoint, short, way = row.rsplit("@", 2)
    settings = Settings(device="cpu", backend="auto", precision="auto", min_size=int(short))
    console, looked_at, seconds = Console(quiet=True), 0, 0.0
    predictor = Predictor.load(Path(checkpoint), settings, console)
    for labels in clips:
        job = PredictJob(
            footage=open_footage(str(labels.with_suffix(".mp4"))),
            checkpoint=Path(checkpoint),
            out=out / labels.parent.name,
            settings=settings,
            every_frame=way == "every",
        )
        ready = predictor.reporting(job.least_score)
        if not looked_at:  # the first batch warms up what later batches use
            ready.detections([pixels for _, (_, pixels) in zip(range(1), job.footage.frames(), strict=False)])
        begun = time.perf_counter()
        claim(job, predictor.files)
        prediction = Prediction(job, ready)
        looked_at += sum(1 for _ in prediction.frames())
        prediction.write(console)
        seconds += time.perf_counter() - begun
    return {"rate": looked_at / seconds, "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def figures(clips: Sequence[Path], out: Path) -> dict[str, Any]:
    """Compute the accuracy of detections and tracks in the clips of a group."""
    total, rows = Counts(), []
    for labels in clips:
        truth = coco.read(labels)
        results = coco.read_results(out / labels.parent.name / "predictions.json")
        total += count(truth, results)
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(truth, results, Path(folder)))
    _, precision, _, recall, entered, pck, _ = total.cells()
    tracked = f"{sum(row.tracked for row in rows)} of {sum(row.vehicles for row in rows)}"
    cells = [precision, recall, entered, pck, tracked, str(sum(row.switches for row in rows))]
    return {"cells": [*cells, *(_mean(rows, name) for name in ("HOTA", "IDF1"))]}


def _mean(rows: Sequence[Row], name: str) -> str:
    values = [row.scores[name] for row in rows if name in row.scores]
    return f"{np.mean(values):.3f}" if values else "-"


def row_figures(row: str, clips: Sequence[tuple[ClipPlan, Path]], folder: Path) -> dict[str, Any]:
    """Return the figures of a row, measured unless the folder already has them."""
    out = folder_of(row, folder)
    kept = out / "figures.json"
    if not kept.is_file():
        speed = in_own_process("--look", row, "--paths", *(str(path) for _, path in clips))
        by_group = {
            group: figures([path for clip, path in clips if clip.group == group], out)
            for group in dict.fromkeys(clip.group for clip, _ in clips)
        }
        write_json(kept, {**speed, "groups": by_group})
    return dict(read_json(kept))


PARTS: Final = 6
_LOOK_S: Final = 0.02
_MEMORY_EVERY_S: Final = 2.0


@dataclass
class Camera:
    """A simulated web camera that repeats a video."""

    jpegs: list[bytes]
    fps: float
    sent_s: list[float] = field(default_factory=list)
    """Time at which each frame of the newest connection was sent."""

    def serve(self, server: socket.socket) -> None:
        """Serve one client at a time until the server is closed."""
        with contextlib.suppress(OSError):
            while True:
                client = server.accept()[0]
                with client, contextlib.suppress(OSError):
                    client.recv(4096)
                    self._send(client)

    def _send(self, client: socket.socket) -> None:
        client.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n")
        self.sent_s = []
        begun = time.monotonic()
        while True:
            jpeg = self.jpegs[len(self.sent_s) % len(self.jpegs)]
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
            time.sleep(max(0.0, begun + len(self.sent_s) / self.fps - time.monotonic()))
            self.sent_s.append(time.monotonic())
            client.sendall(head + jpeg + b"\r\n")


@dataclass
class Seen:
    """Results and memory of a run on the stream."""

    frames: list[tuple[int, float, float]] = field(default_factory=list)
    """Frame number, time of its results, and their delay after the frame was sent, seconds."""
    memory: list[tuple[float, float]] = field(default_factory=list)
    """Time, and resident memory of the process in megabytes."""


def watch(process: subprocess.Popen[bytes], progress: Path, camera: Camera) -> Seen:
    """Record the progress and the memory of a run."""
    seen, rest, at, asked = Seen(), b"", 0, 0.0
    while process.poll() is None:
        time.sleep(_LOOK_S)
        now = time.monotonic()
        if now - asked > _MEMORY_EVERY_S:
            asked = now
            with contextlib.suppress(OSError):
                status = Path(f"/proc/{process.pid}/status").read_text()
                seen.memory += [(now, int(kib) / 1024) for kib in re.findall(r"VmRSS:\s+(\d+)", status)]
        with contextlib.suppress(FileNotFoundError), progress.open("rb") as file:
            file.seek(at)
            data = file.read()
            at += len(data)
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                number = json.loads(line)["image"]["frame_index"]
                seen.frames.append((number, now, now - camera.sent_s[number]))
    return seen


def stream_rows(seen: Seen) -> Iterator[Sequence[str]]:
    """Yield a row of cells for each part of the time."""
    if not seen.frames:
        return
    begun, end = seen.frames[0][1], seen.frames[-1][1]
    for k in range(PARTS):
        since, until = (begun + (end - begun) * j / PARTS for j in (k, k + 1))
        part = [(number, lag) for number, when, lag in seen.frames if since <= when <= until]
        memory = [megabytes for when, megabytes in seen.memory if since <= when <= until]
        if len(part) < 2:
            continue
        lags = sorted(lag for _, lag in part)
        passed = 1 - (len(part) - 1) / (part[-1][0] - part[0][0])
        yield (
            f"{(since - begun) / 60:.1f} to {(until - begun) / 60:.1f}",
            f"{(len(part) - 1) / (until - since):.2f}",
            f"{passed:.0%}",
            f"{statistics.median(lags):.2f}",
            f"{lags[round(0.95 * (len(lags) - 1))]:.2f}",
            f"{lags[-1]:.2f}",
            f"{max(memory):.0f}" if memory else "-",
        )


def bench_ways(options: argparse.Namespace) -> None:
    """Compare the speed, memory and accuracy of the ways to run a detector."""
    if options.only:
        print(json.dumps(measured(options)))
        return
    sizes, ways = [int(size) for size in options.sizes.split(",")], options.ways.split(",")
    print(f"{machine(options.device)}, {options.checkpoint}")
    print_head(("way", "short side", "images/s", "memory, MB", *COLUMNS))
    for size, way in itertools.product(sizes, ways):
        result = in_own_process("--only", f"{way}@{size}")
        print_row((way, size, f"{result['rate']:.2f}", f"{result['memory_mb']:.0f}", *result["cells"]))


def bench_steps(options: argparse.Namespace) -> None:
    """Time the steps from videos to metric tracks, and measure the size of the results."""
    print("video                 step      seconds  footage s/s      MB")
    for video in options.videos:
        with tempfile.TemporaryDirectory() as name:
            folder, seen = Path(name), Path(name) / "predict"
            call = (video, "--camera", options.camera, "--checkpoint", options.checkpoint)
            steps = {"predict": eval_seconds("predict", *call, "--out", seen)}
            for step in ("track", "pose"):
                steps[step] = eval_seconds(step, seen, "--out", folder / step)
            times = [image.time_s or 0.0 for image in coco.read(seen / FRAMES_FILE).images]
            for step, seconds in steps.items():
                size = sum(path.stat().st_size for path in (folder / step).rglob("*") if path.is_file())
                pace = (times[-1] - times[0]) / seconds
                print(f"{video.name:20s}  {step:8s} {seconds:8.1f} {pace:12.2f} {size / 1e6:7.2f}")


def bench_curve(options: argparse.Namespace) -> None:
    """Compare the accuracy and speed of each row, by group of clips."""
    if options.look:
        print(json.dumps(look(options.look, options.paths, folder_of(options.look, options.folder))))
        return
    clips = [(clip, make(clip, options.folder, options)) for clip in CLIPS[: options.clips]]
    print(machine())
    print_head(CURVE_COLUMNS)
    for row in options.rows.split(","):
        found = row_figures(row, clips, options.folder)
        checkpoint, short, way = row.rsplit("@", 2)
        for group, group_figures in found["groups"].items():
            rate, memory = f"{found['rate']:.2f}", f"{found['memory_mb']:.0f}"
            print_row((Path(checkpoint).stem, short, way, rate, memory, group, *group_figures["cells"]))


def bench_live(options: argparse.Namespace) -> None:
    """Measure the lag, the skipped frames and the memory of `skope eval predict` on a live stream."""
    capture, jpegs = cv2.VideoCapture(str(options.video)), []
    while (frame := capture.read()[1]) is not None:
        jpegs.append(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    camera = Camera(jpegs, options.fps)
    with tempfile.TemporaryDirectory() as folder, socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=camera.serve, args=(server,), daemon=True).start()
        words = f"eval predict http://127.0.0.1:{server.getsockname()[1]}/camera.mjpg --out {folder} --quiet"
        words += f" --end {60 * options.minutes} --checkpoint {options.checkpoint} --min-size {options.min_size}"
        process = subprocess.Popen([sys.executable, "-m", "skope", *words.split()])
        seen = watch(process, Path(folder) / ".predict.jsonl", camera)
    print_head(("minutes", "images/s", "skipped", "lag, s: median", "95%", "max", "memory, MB"))
    for cells in stream_rows(seen):
        print_row(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    ways = commands.add_parser("ways", help="ways to run a detector")
    ways.add_argument("footage", type=Path, help="folder of videos and labels of `skope gen video`")
    ways.add_argument("--checkpoint", type=Path, default=Path("road33"))
    ways.add_argument("--sizes", default="360,540,720", help="short sides of images inside the network, pixels")
    ways.add_argument("--device", default="cpu")
    ways.add_argument("--ways", default=",".join(WAYS))
    ways.add_argument("--frames", type=int, default=10**9, help="maximum number of frames of each clip")
    ways.add_argument("--times", type=int, default=1, help="passes over each clip, as if it were longer")
    ways.add_argument("--only", help=argparse.SUPPRESS)
    ways.set_defaults(run=bench_ways)
    steps = commands.add_parser("steps", help="from a video to metric tracks")
    steps.add_argument("videos", nargs="+", type=Path)
    steps.add_argument("--camera", type=Path, required=True, help="camera file of the videos")
    steps.add_argument("--checkpoint", default="road33", help="as `skope eval predict` takes it")
    steps.set_defaults(run=bench_steps)
    curve = commands.add_parser("curve", help="accuracy of detectors against their time")
    curve.add_argument("folder", type=Path, help="folder that keeps clips and figures")
    curve.add_argument("--rows", default="road33@540@key,road33-lite@540@every,road33-lite@540@key")
    curve.add_argument("--seconds", type=float, default=SECONDS, help="length of each clip")
    curve.add_argument("--size", default=SIZE, help="image size of the clips")
    curve.add_argument("--clips", type=int, default=len(CLIPS), help="use this many of them")
    curve.add_argument("--look", help=argparse.SUPPRESS)
    curve.add_argument("--paths", type=Path, nargs="*", help=argparse.SUPPRESS)
    curve.set_defaults(run=bench_curve)
    live = commands.add_parser("live", help="a live stream")
    live.add_argument("video", type=Path)
    live.add_argument("--fps", type=float, default=10.0)
    live.add_argument("--minutes", type=float, default=30.0)
    live.add_argument("--checkpoint", default="road33")
    live.add_argument("--min-size", type=int, default=540)
    live.set_defaults(run=bench_live)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
