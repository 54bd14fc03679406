"""Speed of detectors and their evaluation: metrics against loops, inference against torchvision, parts by backbone.

    python scripts/bench_detector.py metrics
    python scripts/bench_detector.py inference --checkpoint RUN --data DIR        # split `hard`, or --split
    python scripts/bench_detector.py backbones                                    # fastest backend and number format
    python scripts/bench_detector.py backbones --variants road33,resnet18-128-4x128 --rounds 20

`metrics`: 3,000 images of 6 vehicles, all four IoU thresholds in both protocols, without AP (which pycocotools
computes in any case). The peer is a plain loop over images, thresholds and vehicles, with IoU from pycocotools.

`inference`: images per second against torchvision's own model call, image by image, with at most 100 detections above
0.05 per image; --floor 0 always gives 100, as in crowded scenes.

`backbones`: the time of each part of a network, by backbone and widths, with the backend of `skope eval predict`.
Weights are random; apart from the suppression of proposals, they hardly affect the time. The stages are the pyramid
and the proposals' head; the proposals; the box head on all of them, and again on the vehicles (`box_passes` 2); the
keypoint head on the vehicles; the peaks of its heat maps. A head includes its pooling of regions. Resizing and decoding
of images are not included. The variants alternate, and the shortest time of each stage is reported. Ratios are relative
to the first variant, by default the network of `road33`.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from benchmark import in_turn, machine, print_head, print_row, timed
from pycocotools import mask as coco_mask
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.image_list import ImageList

from skope import keypoints
from skope.boxes import xyxy_to_xywh
from skope.dataset.folder import open_dataset, read_image
from skope.dataset.image_selection import take
from skope.detector import int8_ranges
from skope.detector.backends.prepare import prepare
from skope.detector.build import NETWORK_DEFAULTS, DetectorConfig, build
from skope.detector.checkpoint import find_checkpoint, load_weights
from skope.detector.detect import heatmap_peaks
from skope.detector.device import choose_device
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.pck_precision_recall import score_split
from skope.metrics.thresholds import PAPER_THRESHOLDS
from skope.schema import Annotation, AnnotationFile, Image, Result
from skope.terminal.console import Console

VEHICLES = 6
PART = 8
"""Number of images per turn; the contenders take turns."""


def synthetic_split(rng: np.random.Generator, count: int) -> tuple[AnnotationFile, list[Result]]:
    """Return vehicles at random positions, 90% of them detected with small errors, and a false detection per image."""
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
    """Compute the same figures with plain loops."""
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


class Stock:
    """torchvision's own model call, one image at a time."""

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


def _apart(stock: list[Result], ours: list[Result], score: float) -> str:
    """Describe how far the detections above `score` differ from the nearest ones in the same image."""
    stock_by_image, ours_by_image = (_by_image([r for r in results if r.score > score]) for results in (stock, ours))
    counts = [sum(map(len, each.values())) for each in (stock_by_image, ours_by_image)]
    if {k: len(v) for k, v in stock_by_image.items()} != {k: len(v) for k, v in ours_by_image.items()}:
        return f"{counts[0]} and {counts[1]} detections above {score:g}: different numbers"
    boxes = points = 0.0
    for image, found in stock_by_image.items():
        corners = np.array([r.bbox for r in ours_by_image[image]])
        nearest = [int(np.abs(corners - r.bbox).max(axis=1).argmin()) for r in found]
        if len(set(nearest)) < len(nearest):
            return f"the same number of detections above {score:g} in image {image}, but different ones"
        for first, second in zip(found, (ours_by_image[image][i] for i in nearest), strict=True):
            boxes = max(boxes, float(np.abs(np.subtract(first.bbox, second.bbox)).max()))
            points = max(points, float(np.abs(first.keypoints - second.keypoints)[:, :2].max()))
    return f"the same {counts[1]} detections above {score:g}; boxes {boxes:.1e}, points {points:.1e} px apart"


def _by_image(results: list[Result]) -> dict[int, list[Result]]:
    groups: dict[int, list[Result]] = {}
    for result in results:
        groups.setdefault(result.image_id, []).append(result)
    return groups


LIGHT: Final[Mapping[str, Any]] = {"keypoint_layers": 4, "keypoint_width": 128, "box_width": 256}
WIDE: Final[Mapping[str, Any]] = {"keypoint_layers": 8, "keypoint_width": 256, "box_width": 512}
VARIANTS: Final[Mapping[str, Mapping[str, Any]]] = {
    "road33": {},
    "resnet50-256-4x128": {**LIGHT},
    "resnet18-256-8x256": {"backbone": "resnet18", **WIDE},
    "resnet18-256-4x128": {"backbone": "resnet18", **LIGHT},
    "resnet18-128-8x256": {"backbone": "resnet18", "pyramid_width": 128, **WIDE},
    "resnet18-128-4x128": {"backbone": "resnet18", "pyramid_width": 128, **LIGHT},
    "resnet18-64-4x128": {"backbone": "resnet18", "pyramid_width": 64, **LIGHT},
    "mobilenet-128-4x128": {"backbone": "mobilenet_v3_large", "pyramid_width": 128, **LIGHT},
    "mobilenet-64-4x128": {"backbone": "mobilenet_v3_large", "pyramid_width": 64, **LIGHT},
}
"""Fields of `DetectorConfig` by name: backbone, channels of the pyramid, layers and width of the keypoint head."""
STAGES: Final = ("pyramid", "proposals", "box head", "keypoint head", "heat maps")
SMALLEST_PX: Final = 20
"""Side of the smallest vehicle; the largest one's is a quarter of the image's height."""


class Variant:
    """A network prepared for a backend, and the image and vehicles that it processes."""

    def __init__(self, name: str, options: argparse.Namespace) -> None:
        height, width = options.size
        config = DetectorConfig(norm="frozen", norm_eps=1e-5, min_size=height, max_size=width, **VARIANTS[name])
        torch.manual_seed(0)
        self._model: KeypointRCNN = build(config).eval()
        self._model.rpn._post_nms_top_n["testing"] = options.proposals
        self.weights = sum(parameter.numel() for parameter in self._model.parameters())
        self._image = ImageList(torch.rand(1, 3, height, width), [(height, width)])
        self._vehicles = vehicles(options.vehicles, height, width)
        with int8_ranges.noted(self._model) as ranges:
            self.look()
        metadata = int8_ranges.to_metadata(self._model, ranges)
        self.number = prepare(
            self._model,
            metadata,
            torch.device("cpu"),
            backend=options.backend,
            precision=options.precision,
            console=Console(quiet=True),
        )
        self.look()  # compiles for this size

    @torch.inference_mode()
    def look(self) -> dict[str, float]:
        """Process the image once; returns the seconds of each stage."""
        heads, sizes = self._model.roi_heads, self._image.image_sizes
        spent: dict[str, float] = {}

        def stage_of(stage: str, work: Callable[[], Any]) -> Any:
            spent[stage], answer = timed(work)
            return answer

        def boxes() -> None:
            logits, offsets = heads.box_predictor(heads.box_head(heads.box_roi_pool(features, proposals, sizes)))
            heads.postprocess_detections(logits, offsets, proposals, sizes)
            heads.box_predictor(heads.box_head(heads.box_roi_pool(features, [self._vehicles], sizes)))

        def keypoints() -> torch.Tensor:
            regions = heads.keypoint_roi_pool(features, [self._vehicles], sizes)
            return heads.keypoint_predictor(heads.keypoint_head(regions))  # type: ignore[no-any-return]

        features = stage_of("pyramid", lambda: self._model.backbone(self._image.tensors))
        proposals, _ = stage_of("proposals", lambda: self._model.rpn(self._image, features))
        stage_of("box head", boxes)
        maps = stage_of("keypoint head", keypoints)
        stage_of("heat maps", lambda: heatmap_peaks(maps, self._vehicles))
        return spent


def vehicles(number: int, height: int, width: int) -> torch.Tensor:
    """Return boxes (number, 4) of varying size, in pixels inside the network."""
    rng = np.random.default_rng(0)
    sides = np.exp(rng.uniform(np.log(SMALLEST_PX), np.log(max(height / 4, SMALLEST_PX)), (number, 1))) * [1.2, 1.0]
    corners = rng.uniform(0, 1, (number, 2)) * (np.array([width, height]) - sides)
    return torch.tensor(np.concatenate([corners, corners + sides], axis=1), dtype=torch.float32)


def size(text: str) -> tuple[int, int]:
    """Parse an image size: height and width, multiples of 32."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal()) or int(height) % 32 or int(width) % 32:
        raise argparse.ArgumentTypeError(f"expected HEIGHTxWIDTH in multiples of 32, got {text!r}")
    return int(height), int(width)


def names(text: str) -> list[str]:
    """Parse a list of variants."""
    chosen = text.split(",")
    if unknown := [name for name in chosen if name not in VARIANTS]:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not one of {', '.join(VARIANTS)}")
    return chosen


def bench_metrics(options: argparse.Namespace) -> None:
    """Compare the time and the figures of the metrics with those of plain loops."""
    images = options.images
    file, results = synthetic_split(np.random.default_rng(0), images)
    rounds = [timed(lambda: score_split(file, results, MetricOptions())["iou"]) for _ in range(5)]
    fast, ours = float(np.median([seconds for seconds, _ in rounds])), rounds[0][1]
    slow, peer = timed(lambda: loops(file, results))
    worst = 0.0
    for t, figures in peer.items():
        for name, value in figures.items():
            pairs = [(value, ours[t][name])] if name == "pck" else [(value[p], ours[t][name][p]) for p in value]
            worst = max(worst, *(abs(a - b) for a, b in pairs))
    print(f"metrics of {images} images x {VEHICLES} vehicles, {len(results)} results")
    print(f"  skope      {fast:8.3f} s")
    print(f"  loops      {slow:8.2f} s, {slow / fast:.0f} times as long; figures differ by at most {worst:.1e}")


def bench_inference(options: argparse.Namespace) -> None:
    """Compare the speed and the results of skope with those of torchvision's model call."""
    checkpoint, data, score, device = options.checkpoint, options.data, options.score, options.device
    file = take(open_dataset(data).read(options.split), options.images)
    where, quiet = choose_device(device), Console(quiet=True)

    def predictor(**settings: Any) -> Predictor:
        return Predictor.load(checkpoint, Settings(device=device, calibrated=False, **settings), quiet)

    ways: dict[str, Stock | Predictor] = {
        "torchvision": Stock(checkpoint, where, options.floor),
        "skope": predictor(),
        "skope --fast": predictor(min_score=score),
        "skope --fast, bfloat16": predictor(min_score=score, precision="bfloat16"),
    }
    parts = [take(replace(file, images=file.images[i : i + PART]), PART) for i in range(0, len(file.images), PART)]
    seconds = dict.fromkeys(ways, 0.0)
    found: dict[str, list[Result]] = {name: [] for name in ways}
    for way in ways.values():
        way.split(parts[0], data)  # warms up the libraries
    for part in parts:  # alternate, so that other load affects all ways equally
        for name, way in ways.items():
            begun = time.perf_counter()
            found[name] += way.split(part, data)
            if where.type == "cuda":
                torch.cuda.synchronize(where)
            seconds[name] += time.perf_counter() - begun
    print(f"{machine(where.type)}; inference on {len(file.images)} images of {data} ({options.split})")
    settings = MetricOptions(score=score)
    for name in ways:
        entry = score_split(file, found[name], settings)
        figures = entry["iou"]["0.6"]
        pck = "-" if figures["pck"] is None else f"{100 * figures['pck']:.2f}"
        rate, times = len(file.images) / seconds[name], seconds["torchvision"] / seconds[name]
        print(f"  {name:24}{rate:8.2f} images/s, {times:5.2f} times torchvision", end="; ")
        print(f"{len(found[name])} detections, {entry['detections']} above {score:g}", end=", ")
        print(f"PCK@0.1 at IoU 0.6 {pck} of {figures['labelled']}")
    for name in list(ways)[1:3]:
        print(f"  {name}: {_apart(found['torchvision'], found[name], score)}")
    # Rounding decides which vehicles score just above the threshold, so keypoints are also compared in ground-truth
    # boxes.
    shares = {}
    for precision in ("float32", "bfloat16"):
        found_in_given = predictor(given=True, precision=precision).split(file, data)
        figures = score_split(file, found_in_given, settings)["iou"]["0.6"]
        shares[precision] = figures["pck"]
    words = ", ".join(f"{name} {100 * pck:.2f}" for name, pck in shares.items())
    print(f"  PCK@0.1 on the ground truth's boxes ({figures['labelled']} keypoints): {words}")


def bench_backbones(options: argparse.Namespace) -> None:
    """Time each part of the variants, in milliseconds."""
    made = {name: Variant(name, options) for name in options.variants}
    looks = in_turn({name: variant.look for name, variant in made.items()}, options.rounds)
    best = {name: {stage: min(look[stage] for look in each) for stage in STAGES} for name, each in looks.items()}
    first = options.variants[0]
    print(f"{machine()}, {made[first].number}")
    print(f"{'x'.join(map(str, options.size))}, {options.vehicles} vehicles, {options.proposals} proposals; ms")
    print_head(("variant", "weights, M", *STAGES, "together", f"times as fast as {first}"))
    base = sum(best[first].values())
    for name, stages in best.items():
        whole = sum(stages.values())
        cells = [f"{1000 * seconds:.1f}" for seconds in (*stages.values(), whole)]
        print_row((name, f"{made[name].weights / 1e6:.1f}", *cells, f"{base / whole:.2f}"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    metrics = commands.add_parser("metrics", help="metrics against plain loops")
    metrics.add_argument("--images", type=int, default=3000, help="synthetic images that are scored")
    metrics.set_defaults(run=bench_metrics)
    inference = commands.add_parser("inference", help="inference against torchvision's call")
    inference.add_argument("--checkpoint", type=Path, default=Path("road33"))
    inference.add_argument("--data", type=Path, default=Path("data/skope"))
    inference.add_argument("--split", default="hard")
    inference.add_argument("--images", type=int, default=24)
    inference.add_argument("--score", type=float, default=0.9)
    inference.add_argument("--floor", type=float, default=0.05, help="torchvision's lowest score; 0: 100 per image")
    inference.add_argument("--device", default="auto")
    inference.set_defaults(run=bench_inference)
    backbones = commands.add_parser("backbones", help="parts of a network by backbone and widths")
    backbones.add_argument("--size", type=size, default=(544, 960), help="height and width inside the network, pixels")
    backbones.add_argument("--vehicles", type=int, default=13)
    backbones.add_argument("--proposals", type=int, default=NETWORK_DEFAULTS.proposals, help="regions for the box head")
    backbones.add_argument("--variants", type=names, default=list(VARIANTS), help="names, separated by commas")
    backbones.add_argument("--backend", default="auto")
    backbones.add_argument("--precision", default="auto")
    backbones.add_argument("--rounds", type=int, default=5, help="turns of each variant")
    backbones.set_defaults(run=bench_backbones)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
