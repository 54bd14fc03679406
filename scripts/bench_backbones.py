"""What the parts of a detector cost on this machine, by backbone and widths, with the backend of `skope eval predict`.

    python scripts/bench_backbones.py                                  # fastest backend and number format
    python scripts/bench_backbones.py --precision bfloat16 --vehicles 30
    python scripts/bench_backbones.py --variants road33,resnet18-128-4x128 --rounds 20

Weights are random: time does not depend on them, except that of suppressing proposals, a little. The stages are the
pyramid with the proposals' head; the proposals; the box head on all of them, and once more on the vehicles
(`box_passes` 2); the keypoint head on the vehicles; the places of its heat maps' peaks. Pooling of regions counts with
the heads; resizing and decoding of images are not counted. Variants take turns, and of each stage the shortest time
counts: another program's work in between falls on all of them or is left out. Ratios are to the first variant: in the
default list that is the network of `road33`.
"""

import argparse
import os
import platform
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import torch
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.image_list import ImageList

from skope.detector import int8_ranges
from skope.detector.backends.prepare import prepare
from skope.detector.build import NETWORK_DEFAULTS, DetectorConfig, build
from skope.detector.detect import heatmap_peaks
from skope.terminal.console import Console

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
    """A network, handed over to a backend, and the image and vehicles that it looks at."""

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
        """Seconds of each stage of one look at the image."""
        heads, sizes = self._model.roi_heads, self._image.image_sizes
        spent: dict[str, float] = {}

        def timed(stage: str, work: Callable[[], Any]) -> Any:
            begun = time.perf_counter()
            answer = work()
            spent[stage] = time.perf_counter() - begun
            return answer

        def boxes() -> None:
            logits, offsets = heads.box_predictor(heads.box_head(heads.box_roi_pool(features, proposals, sizes)))
            heads.postprocess_detections(logits, offsets, proposals, sizes)
            heads.box_predictor(heads.box_head(heads.box_roi_pool(features, [self._vehicles], sizes)))

        def keypoints() -> torch.Tensor:
            regions = heads.keypoint_roi_pool(features, [self._vehicles], sizes)
            return heads.keypoint_predictor(heads.keypoint_head(regions))  # type: ignore[no-any-return]

        features = timed("pyramid", lambda: self._model.backbone(self._image.tensors))
        proposals, _ = timed("proposals", lambda: self._model.rpn(self._image, features))
        timed("box head", boxes)
        maps = timed("keypoint head", keypoints)
        timed("heat maps", lambda: heatmap_peaks(maps, self._vehicles))
        return spent


def vehicles(number: int, height: int, width: int) -> torch.Tensor:
    """(number, 4) boxes of many sizes, pixels inside the network."""
    rng = np.random.default_rng(0)
    sides = np.exp(rng.uniform(np.log(SMALLEST_PX), np.log(max(height / 4, SMALLEST_PX)), (number, 1))) * [1.2, 1.0]
    corners = rng.uniform(0, 1, (number, 2)) * (np.array([width, height]) - sides)
    return torch.tensor(np.concatenate([corners, corners + sides], axis=1), dtype=torch.float32)


def size(text: str) -> tuple[int, int]:
    """Height and width, multiples of 32."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal()) or int(height) % 32 or int(width) % 32:
        raise argparse.ArgumentTypeError(f"expected HEIGHTxWIDTH in multiples of 32, got {text!r}")
    return int(height), int(width)


def names(text: str) -> list[str]:
    """Some of the variants."""
    chosen = text.split(",")
    if unknown := [name for name in chosen if name not in VARIANTS]:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not one of {', '.join(VARIANTS)}")
    return chosen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=size, default=(544, 960), help="height and width inside the network, pixels")
    parser.add_argument("--vehicles", type=int, default=13)
    parser.add_argument(
        "--proposals", type=int, default=NETWORK_DEFAULTS.proposals, help="regions that the box head looks at"
    )
    parser.add_argument("--variants", type=names, default=list(VARIANTS), help="names, separated by commas")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--precision", default="auto")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each variant")
    options = parser.parse_args()
    made = {name: Variant(name, options) for name in options.variants}
    best = {name: dict.fromkeys(STAGES, float("inf")) for name in made}
    for _ in range(options.rounds):
        for name, variant in made.items():
            best[name] = {stage: min(best[name][stage], seconds) for stage, seconds in variant.look().items()}
    first = options.variants[0]
    print(f"{os.cpu_count()}-core {platform.machine()}, {made[first].number}, {torch.get_num_threads()} threads")
    print(f"{'x'.join(map(str, options.size))}, {options.vehicles} vehicles, {options.proposals} proposals; ms")
    print("| variant | weights, M | " + " | ".join(STAGES) + f" | together | times as fast as {first} |")
    print("|---" * (len(STAGES) + 4) + "|")
    base = sum(best[first].values())
    for name, stages in best.items():
        whole = sum(stages.values())
        cells = [f"{1000 * seconds:.1f}" for seconds in (*stages.values(), whole)]
        print(f"| {name} | {made[name].weights / 1e6:.1f} | " + " | ".join(cells) + f" | {base / whole:.2f} |")


if __name__ == "__main__":
    main()
