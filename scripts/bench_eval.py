"""Evaluation against its peers: the metrics against plain loops, inference against torchvision as it is.

    python scripts/bench_eval.py                                   # metrics
    python scripts/bench_eval.py --checkpoint RUN --data DIR       # inference too, on split `hard` or --split

Metrics: 3,000 images (--metric-images) of 6 vehicles, all four IoU thresholds in both protocols, without AP (which is
pycocotools' own in any case), against a straightforward loop over images, thresholds and vehicles that takes IoU from
pycocotools.
Inference: images a second against the stock model call of torchvision, image by image, with its at most 100 detections
above 0.05 an image; --floor 0 makes them 100, as crowded scenes do. Run: make bench
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from pycocotools import mask as coco_mask

from skope import keypoints
from skope.boxes import xyxy_to_xywh
from skope.dataset.folder import open_dataset, read_image
from skope.dataset.image_selection import take
from skope.detector.checkpoint import find_checkpoint, load_weights
from skope.detector.device import choose_device
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.metrics.keypoint_outcomes import Options
from skope.metrics.pck_precision_recall import score_split
from skope.metrics.thresholds import PAPER_THRESHOLDS
from skope.schema import Annotation, AnnotationFile, Image, Result
from skope.terminal.console import Console

T = TypeVar("T")

VEHICLES = 6
PART = 8
"""Images that each way of running gets in turn."""


def synthetic_split(rng: np.random.Generator, count: int) -> tuple[AnnotationFile, list[Result]]:
    """Vehicles in random places, found nine times of ten and some pixels off, and a false detection per image."""
    images = tuple(Image(id=i, file_name=f"{i}.jpg", width=1920, height=1080) for i in range(count))
    annotations, results = [], []
    for image in images:
        for _ in range(VEHICLES):
            box = np.concatenate([rng.uniform(0, [1700, 900]), rng.uniform([60, 40], [220, 160])])
            points = np.concatenate(
                [box[:2] + rng.random((keypoints.K, 2)) * box[2:], np.zeros((keypoints.K, 1))], axis=1
            )
            points[:, 2] = rng.choice([1, 2], keypoints.K)
            crowd = int(rng.random() < 0.2)
            annotations.append(
                Annotation(id=len(annotations), image_id=image.id, bbox=box, keypoints=points, area=1.0, iscrowd=crowd)
            )
            if rng.random() < 0.9:
                near = points + np.concatenate([rng.normal(0, 6, (keypoints.K, 2)), np.zeros((keypoints.K, 1))], axis=1)
                near[:, 2] = rng.random(keypoints.K)
                shift = rng.normal(0, 5, 4)
                score = float(rng.uniform(0.8, 1))
                results.append(Result(image_id=image.id, score=score, bbox=box + shift, keypoints=near))
        lost = np.concatenate([rng.uniform(0, 800, (keypoints.K, 2)), np.ones((keypoints.K, 1))], axis=1)
        results.append(Result(image_id=image.id, score=0.95, bbox=np.array([5.0, 5, 99, 70]), keypoints=lost))
    return AnnotationFile(images=images, annotations=tuple(annotations)), results


def loops(file: AnnotationFile, results: list[Result]) -> dict[str, Any]:
    """The table's figures as one would first write them down."""
    truth: dict[int, list[Annotation]] = {image.id: [] for image in file.images}
    ignored: dict[int, list[Annotation]] = {image.id: [] for image in file.images}
    found: dict[int, list[Result]] = {image.id: [] for image in file.images}
    for annotation in file.annotations:
        (ignored if annotation.iscrowd else truth)[annotation.image_id].append(annotation)
    for result in results:
        if result.score > 0.9:
            found[result.image_id].append(result)
    out = {}
    for t in PAPER_THRESHOLDS.iou:
        matched = labelled = labelled_all = correct = left_out = vehicles = detections = 0
        paper: list[tuple[float, float, float, float]] = []
        for image in file.images:
            here = sorted(found[image.id], key=lambda r: -r.score)
            cars = sorted(truth[image.id], key=lambda a: a.id)
            boxes, places = [r.bbox.tolist() for r in here], [a.bbox.tolist() for a in cars]
            table = coco_mask.iou(boxes, places, [0] * len(places)) if boxes and places else None
            away = [a.bbox.tolist() for a in ignored[image.id]]
            inside = coco_mask.iou(boxes, away, [1] * len(away)) if boxes and away else None
            taken: set[int] = set()
            image_correct = 0
            for d, result in enumerate(here):
                best, choice = t, -1
                for g in range(len(cars)):
                    if g not in taken and table[d][g] >= best and (choice < 0 or table[d][g] > best):
                        best, choice = table[d][g], g
                if choice < 0:
                    left_out += inside is not None and any(share >= 0.5 for share in inside[d])
                    continue
                taken.add(choice)
                car = cars[choice]
                reach = 0.1 * max(car.bbox[2], car.bbox[3])
                for (x, y, v), (px, py, _) in zip(car.keypoints, result.keypoints, strict=True):
                    if v == 2:
                        labelled += 1
                        image_correct += ((x - px) ** 2 + (y - py) ** 2) ** 0.5 <= reach
            for car in cars:
                labelled_all += sum(1 for _, _, v in car.keypoints if v == 2)
            matched += len(taken)
            correct += image_correct
            vehicles += len(cars)
            detections += len(here)
            if cars:
                hit = len(taken)
                paper.append(
                    (
                        hit / len(here) if here else 0.0,
                        hit / len(cars),
                        image_correct / (33 * hit) if hit else 0.0,
                        1.0 if hit else 0.0,
                    )
                )
        judged = detections - left_out
        means = np.mean(paper, axis=0)
        out[f"{t:g}"] = {
            "pck": correct / labelled,
            "box_precision": {"paper": means[0], "pooled": matched / judged},
            "box_recall": {"paper": means[1], "pooled": matched / vehicles},
            "keypoint_precision": {"paper": means[2], "pooled": correct / (33 * judged)},
            "keypoint_recall": {"paper": means[3], "pooled": correct / labelled_all},
        }
    return out


def timed(function: Callable[[], T], repeats: int) -> tuple[float, T]:
    """The median time of a call, seconds, and what it returned."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        value = function()
        times.append(time.perf_counter() - begun)
    return float(np.median(times)), value


def bench_metrics(images: int) -> None:
    file, results = synthetic_split(np.random.default_rng(0), images)
    fast, ours = timed(lambda: score_split(file, results, Options())["iou"], 5)
    slow, peer = timed(lambda: loops(file, results), 1)
    worst = 0.0
    for t, figures in peer.items():
        for name, value in figures.items():
            pairs = [(value, ours[t][name])] if name == "pck" else [(value[p], ours[t][name][p]) for p in value]
            worst = max(worst, *(abs(a - b) for a, b in pairs))
    print(f"metrics of {images} images x {VEHICLES} vehicles, {len(results)} results")
    print(f"  skope      {fast:8.3f} s")
    print(f"  loops      {slow:8.2f} s, {slow / fast:.0f} times as long; apart by at most {worst:.1e}")


class Stock:
    """torchvision's own call, image by image, as its users write it."""

    def __init__(self, checkpoint: Path, device: torch.device, floor: float) -> None:
        self._model, _, _ = load_weights(find_checkpoint(checkpoint), device)
        self._model.roi_heads.score_thresh = floor
        self._model.roi_heads.detections_per_img = 100
        self._device = device

    def split(self, file: AnnotationFile, root: Path) -> tuple[Result, ...]:
        out = []
        for image in file.images:
            pixels = read_image(root / image.file_name)
            tensor = torch.as_tensor(pixels, device=self._device).permute(2, 0, 1).float() / 255
            with torch.inference_mode():
                (found,) = self._model([tensor])
            scores = found["keypoints_scores"].double().sigmoid()
            points = torch.cat([found["keypoints"][..., :2].double(), scores[..., None]], dim=-1).cpu().numpy()
            boxes = xyxy_to_xywh(found["boxes"].cpu().numpy())
            rows = zip(boxes, points, found["scores"].tolist(), strict=True)
            out += [Result(image_id=image.id, bbox=box, keypoints=p, score=score) for box, p, score in rows]
        return tuple(out)


def bench_inference(
    checkpoint: Path, data: Path, split: str, images: int, score: float, floor: float, device: str
) -> None:
    dataset = open_dataset(data)
    file = take(dataset.read(split), images)
    where, quiet = choose_device(device), Console(quiet=True)

    def predictor(**settings: Any) -> Predictor:
        return Predictor.load(checkpoint, Settings(device=device, calibrated=False, **settings), quiet)

    ways: dict[str, Stock | Predictor] = {
        "torchvision": Stock(checkpoint, where, floor),
        "skope": predictor(),
        "skope --fast": predictor(min_score=score),
        "skope --fast, bfloat16": predictor(min_score=score, precision="bfloat16"),
    }
    parts = [take(replace(file, images=file.images[i : i + PART]), PART) for i in range(0, len(file.images), PART)]
    seconds = dict.fromkeys(ways, 0.0)
    found: dict[str, list[Result]] = {name: [] for name in ways}
    for way in ways.values():
        way.split(parts[0], data)  # warms the libraries up
    for part in parts:  # in turn, so that what else the machine does falls on all of them
        for name, way in ways.items():
            begun = time.perf_counter()
            found[name] += way.split(part, data)
            if where.type == "cuda":
                torch.cuda.synchronize(where)
            seconds[name] += time.perf_counter() - begun
    print(f"inference on {len(file.images)} images of {data} ({split}), {where}, {torch.get_num_threads()} threads")
    options = Options(score=score)
    for name in ways:
        entry = score_split(file, found[name], options)
        figures = entry["iou"]["0.6"]
        pck = "-" if figures["pck"] is None else f"{100 * figures['pck']:.2f}"
        rate, times = len(file.images) / seconds[name], seconds["torchvision"] / seconds[name]
        print(f"  {name:24}{rate:8.2f} images/s, {times:5.2f} times torchvision", end="; ")
        print(f"{len(found[name])} detections, {entry['detections']} above {score:g}", end=", ")
        print(f"PCK@0.1 at IoU 0.6 {pck} of {figures['labelled']}")
    for name in list(ways)[1:3]:
        print(f"  {name}: {_apart(found['torchvision'], found[name], score)}")
    # Which vehicles score just above the threshold differs with any rounding; where their keypoints lie is told apart.
    shares = {}
    for precision in ("float32", "bfloat16"):
        figures = score_split(file, predictor(given=True, precision=precision).split(file, data), options)["iou"]["0.6"]
        shares[precision] = figures["pck"]
    words = ", ".join(f"{name} {100 * pck:.2f}" for name, pck in shares.items())
    print(f"  PCK@0.1 on the ground truth's boxes ({figures['labelled']} keypoints): {words}")


def _apart(stock: list[Result], ours: list[Result], score: float) -> str:
    """How far the detections above `score` are from the nearest ones of the same image."""
    theirs, own = (_by_image([r for r in results if r.score > score]) for results in (stock, ours))
    counts = [sum(map(len, each.values())) for each in (theirs, own)]
    if {k: len(v) for k, v in theirs.items()} != {k: len(v) for k, v in own.items()}:
        return f"{counts[0]} and {counts[1]} detections above {score:g}: not the same"
    boxes = points = 0.0
    for image, found in theirs.items():
        corners = np.array([r.bbox for r in own[image]])
        nearest = [int(np.abs(corners - r.bbox).max(axis=1).argmin()) for r in found]
        if len(set(nearest)) < len(nearest):
            return f"as many detections above {score:g} in image {image}, but not the same"
        for one, other in zip(found, (own[image][i] for i in nearest), strict=True):
            boxes = max(boxes, float(np.abs(np.subtract(one.bbox, other.bbox)).max()))
            points = max(points, float(np.abs(one.keypoints - other.keypoints)[:, :2].max()))
    return f"the same {counts[1]} detections above {score:g}; boxes {boxes:.1e}, points {points:.1e} px apart"


def _by_image(results: list[Result]) -> dict[int, list[Result]]:
    groups: dict[int, list[Result]] = {}
    for result in results:
        groups.setdefault(result.image_id, []).append(result)
    return groups


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--metric-images", type=int, default=3000, help="made-up images that the metrics score")
    parser.add_argument("--checkpoint", type=Path, help="run inference too")
    parser.add_argument("--data", type=Path, default=Path("data/skope"))
    parser.add_argument("--split", default="hard")
    parser.add_argument("--images", type=int, default=24)
    parser.add_argument("--score", type=float, default=0.9)
    parser.add_argument("--floor", type=float, default=0.05, help="torchvision's own: 0 fills its 100 of every image")
    parser.add_argument("--device", default="auto")
    flags = parser.parse_args()
    bench_metrics(flags.metric_images)
    if flags.checkpoint:
        bench_inference(flags.checkpoint, flags.data, flags.split, flags.images, flags.score, flags.floor, flags.device)


if __name__ == "__main__":
    main()
