"""Ways of running a detector: images a second, memory, and how well each finds vehicles.

    skope gen video t06_plaza_opening --fps 10 --seconds 12 --out footage     # and other sites
    python scripts/bench_predict.py footage --frames 12
    python scripts/bench_predict.py footage --sizes 540 --ways torchvision,openvino-int8,video
    python scripts/bench_predict.py footage --stages                          # where the time of an image goes
    python scripts/bench_predict.py footage --device cuda --sizes 1080 --ways torchvision,torch-bfloat16 --times 8

The ways: torchvision's own call, image by image; skope's backends and number formats on every frame; and `video`, which
is what `skope eval predict` does by default. Each runs in a process of its own, which has loaded the detector and seen
one batch before the clock starts; decoding counts. `--times` takes each clip for a video that repeats it, where a clip
of some seconds is over before pipelines are full. Memory is the process's, on a GPU that of the GPU. Every frame is
scored at IoU 0.6: what `skope eval predict` writes, after frames have confirmed each other, and of torchvision's call
what scores above 0.5. Figures of `video_modes.py`.
"""

import argparse
import itertools
import json
import math
import os
import platform
import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch
from research.video_modes import COLUMNS, Counts, count

from skope.dataset import coco
from skope.detections import MIN_SCORE, apart, results_of
from skope.detector.checkpoint import load_weights
from skope.detector.detect import as_tensor
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.footage.confirmation import CONFIRMATION, Confirmation
from skope.footage.predict_footage import found_in
from skope.footage.predict_job import PredictJob
from skope.schema import AnnotationFile, Image, Result
from skope.terminal.console import Console
from skope.types import Pixels
from skope.video.footage import Cut, Footage, open_footage

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

STAGES: Final = {
    "resize": "transform",
    "pyramid": "backbone",
    "proposals' head": "rpn.head",
    "proposals": "rpn",
    "pooling for boxes": "roi_heads.box_roi_pool",
    "box head": "roi_heads.box_head",
    "box predictor": "roi_heads.box_predictor",
    "pooling for keypoints": "roi_heads.keypoint_roi_pool",
    "keypoint head": "roi_heads.keypoint_head",
    "heat maps": "roi_heads.keypoint_predictor",
}


def predictor_of(options: argparse.Namespace, way: str, size: int) -> Predictor:
    backend, precision = WAYS[way]
    settings = Settings(
        device=options.device, backend=backend, precision=precision, min_size=size, min_score=CONFIRMATION.weak_score
    )
    return Predictor.load(options.checkpoint, settings, Console(quiet=True))


def clips(options: argparse.Namespace) -> list[tuple[Path, Footage]]:
    """Label files and their footage."""
    out = []
    for labels in sorted(options.footage.rglob("*.json")):
        times = [image.time_s or 0.0 for image in coco.read(labels).images]
        end = math.inf if options.frames >= len(times) else times[options.frames]
        out.append((labels, open_footage(str(labels.with_suffix(".mp4")), Cut(end_s=end))))
    return out


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """One way at one size, in this process."""
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
        rows = [(image, list(apart(each)[0])) for image, each in found]  # vehicles alone are scored
        looked_at += len(rows)
        rows = rows[: len(rows) // options.times]
        score = SCORE if way == "torchvision" else 0.0
        total += count(first_frames(truth, len(rows)), kept(way, rows, job), score)
    on_gpu = torch.cuda.max_memory_allocated() / 2**20
    memory = on_gpu or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"rate": looked_at / seconds, "memory_mb": memory, "cells": total.cells()}


def first_frames(truth: AnnotationFile, number: int) -> AnnotationFile:
    images = truth.images[:number]
    ids = {image.id for image in images}
    return replace(truth, images=images, annotations=tuple(a for a in truth.annotations if a.image_id in ids))


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
    """The model as torchvision has it, with its 1000 proposals and every detection above 0.05."""
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
    """The results that count."""
    if way == "torchvision":
        return [result for _, found in rows for result in found]
    confirmation = Confirmation(SCORE, every=job.key_every)
    for image, found in rows:
        confirmation.add(image.time_s or 0.0, found)
    stay = zip(rows, confirmation.confirmed(), strict=True)
    return [one for (_, found), flags in stay for one in itertools.compress(found, flags)]


def stages(options: argparse.Namespace, way: str, size: int) -> dict[str, float]:
    """Seconds an image in each stage, of the first clip."""
    predictor = predictor_of(options, way, size)
    spent: dict[str, float] = defaultdict(float)
    begun: dict[str, float] = {}

    def now() -> float:
        if options.device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter()

    for stage, name in STAGES.items():
        module = predictor.model.get_submodule(name)
        module.register_forward_pre_hook(lambda *_, stage=stage: begun.update({stage: now()}))
        module.register_forward_hook(lambda *_, stage=stage: spent.update({stage: spent[stage] + now() - begun[stage]}))
    _, footage = clips(options)[0]
    frames = [pixels for _, pixels in footage.frames()]
    batches = [frames[i : i + predictor.batch_size] for i in range(0, len(frames), predictor.batch_size)]
    predictor.detections(batches[0])
    spent.clear()
    since = now()
    for batch in batches[1:]:
        predictor.detections(batch)
    whole = now() - since
    spent["proposals"] -= spent["proposals' head"]
    spent["the rest"] = whole - sum(spent.values())
    number = len(frames) - len(batches[0])
    return {name: seconds / number for name, seconds in {**spent, "together": whole}.items()}


def in_own_process(way: str, size: int) -> dict[str, Any]:
    command = [sys.executable, __file__, *sys.argv[1:], "--only", f"{way}@{size}"]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])  # type: ignore[no-any-return]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("footage", type=Path, help="folder of what `skope gen video` made")
    parser.add_argument("--checkpoint", type=Path, default=Path("road33"))
    parser.add_argument("--sizes", default="360,540,720", help="short sides of images inside the network, pixels")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--stages", action="store_true", help="where the time of an image goes instead")
    parser.add_argument("--frames", type=int, default=10**9, help="most frames of each clip")
    parser.add_argument(
        "--times", type=int, default=1, help="passes over each clip, as if it were so many times as long"
    )
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        print(json.dumps(measured(options)))
        return
    sizes, ways = [int(size) for size in options.sizes.split(",")], options.ways.split(",")
    machine = f"{os.cpu_count()}-core {platform.machine()}"
    if options.device != "cpu":
        machine += f", {torch.cuda.get_device_name(options.device)}"
    print(f"{machine}, torch {torch.__version__}, {options.checkpoint}")
    if options.stages:
        for way in ways:
            for size in sizes:
                found = stages(options, way, size)
                print(f"{way} at {size} px, ms: " + ", ".join(f"{k} {1000 * v:.3g}" for k, v in found.items()))
        return
    print("| way | short side | images/s | memory, MB | " + " | ".join(COLUMNS) + " |")
    print("|---" * (4 + len(COLUMNS)) + "|")
    for size in sizes:
        for way in ways:
            one = in_own_process(way, size)
            cells = [way, str(size), f"{one['rate']:.2f}", f"{one['memory_mb']:.0f}", *one["cells"]]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
