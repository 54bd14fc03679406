"""Time of each stage of a detector on the frames of a video, at several numbers of road users.

    python scripts/bench_stages.py crossing.mp4 --checkpoint road33-lite --min-size 540 --peer yolo11n.xml

The rows of a frame's stages, milliseconds: `decode` reads a frame of the open file; `resize` also normalises it;
`pyramid` is the backbone with its feature pyramid and the proposals' head; `proposals` decodes boxes and suppresses
overlapping ones; `pooling` cuts regions out of the feature maps; `box head` runs in one or two passes; `selection`
suppresses overlapping detections; `peaks` reads the heat maps; `other` is the rest of the call; `motion` measures
camera shake; `write` stores the results of the frame. `detector` is the whole call, from the frame in memory to its
detections.

The number of road users is fixed: the detector keeps the best N detections, whatever their scores. Numbers and rounds
alternate. Each cell is the minimum and the median over the rounds of the mean over the frames.

`--peer` adds a row for an OpenVINO model (IR) with one image input, for example a YOLO11n in int8 without its
suppression: the time to resize a frame and to run the model. Weights hardly affect time, so they may be random.
"""

import argparse
import itertools
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from benchmark import machine, print_head, print_row, timed

from skope.camera.motion.camera_shake import CameraShakeEstimator
from skope.dataset import coco
from skope.detector import detect as detection
from skope.detector.network_settings import BACKEND_CHOICES, PRECISION_CHOICES, Settings
from skope.detector.predictor import Predictor
from skope.files.progress import Progress
from skope.schema import AnyResult, Image
from skope.terminal.console import Console
from skope.types import Pixels
from skope.video.footage import FrameRange, open_footage

# After `skope.detector`, as in the commands: it limits for how long torch's threads spin.
import torch  # isort: skip

MODULES: Final = {
    "resize": ("transform",),
    "pyramid": ("backbone",),
    "proposals": ("rpn",),
    "pooling": ("roi_heads.box_roi_pool", "roi_heads.keypoint_roi_pool"),
    "box head": ("roi_heads.box_head", "roi_heads.box_predictor"),
    "keypoint head": ("roi_heads.keypoint_head", "roi_heads.keypoint_predictor"),
}
"""Modules of each stage. The proposals' head belongs to the pyramid where a runtime computes both."""


class StageClock:
    """Seconds of each stage of the calls of a model."""

    def __init__(self, predictor: Predictor) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        begun: dict[str, float] = {}
        for stage, names in MODULES.items():
            for module in map(predictor.model.get_submodule, names):
                module.register_forward_pre_hook(lambda *_, stage=stage: begun.update({stage: now()}))
                module.register_forward_hook(lambda *_, stage=stage: self._add(stage, now() - begun[stage]))
        heads: Any = predictor.model.roi_heads
        heads.postprocess_detections = self._timed("selection", heads.postprocess_detections)
        detection.heatmap_peaks = self._timed("peaks", detection.heatmap_peaks)

    def _add(self, stage: str, seconds: float) -> None:
        self.spent[stage] += seconds

    def _timed(self, stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            begun = now()
            answer = work(*arguments)
            self._add(stage, now() - begun)
            return answer

        return run


def now() -> float:
    """Return the time at which the device has finished its work so far, seconds."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def of_detector(
    predictor: Predictor, clock: StageClock, frames: list[Pixels], number: int, device: str
) -> dict[str, float]:
    """Return the seconds per frame of each stage of the detector, if it keeps the best `number` road users."""
    clock.spent.clear()
    begun = now()
    for pixels in frames:
        detection.detect(
            predictor.model,
            [pixels],
            device,
            min_score=0.0,
            max_detections=number,
            categories=predictor.categories,
        )
    whole = now() - begun
    stages = {**clock.spent, "other": whole - sum(clock.spent.values()), "detector": whole}
    return {stage: seconds / len(frames) for stage, seconds in stages.items()}


def of_footage(video: Path, frames: list[Pixels], found: Sequence[AnyResult]) -> dict[str, float]:
    """Return the seconds per frame of decoding, camera shake and writing, if each frame has the results `found`."""
    count = len(frames)
    ahead = open_footage(str(video), FrameRange()).frames()
    next(ahead)  # opens the file
    decode, decoded = timed(lambda: list(itertools.islice(ahead, count)))
    height, width = frames[0].shape[:2]
    images = [Image(id=i, file_name=f"{i}.jpg", width=width, height=height, time_s=i / 10) for i in range(count)]
    motion, _ = timed(lambda: list(CameraShakeEstimator(frames[0]).watch(iter(zip(images, frames, strict=True)))))

    def write() -> None:
        with tempfile.TemporaryDirectory() as folder:
            progress = Progress(Path(folder) / "progress", ("image", "results"))
            for image in images:
                rows = list(map(coco.result_to_dict, found))
                progress.add({"image": coco.image_to_dict(image), "results": rows})

    return {"decode": decode / max(1, len(decoded)), "motion": motion / count, "write": timed(write)[0] / count}


def read(video: Path, count: int) -> list[tuple[Image, Pixels]]:
    """Return the first frames of a video."""
    footage = open_footage(str(video), FrameRange())
    return [frame for _, frame in zip(range(count), footage.frames(), strict=False)]


def peer_of(path: Path) -> Callable[[Pixels], Any]:
    """Return a function that resizes an image for an OpenVINO model and runs it."""
    import openvino

    hints = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": torch.get_num_threads()}
    model = openvino.Core().compile_model(str(path), "CPU", hints)
    _, _, height, width = model.inputs[0].shape

    def run(pixels: Pixels) -> Any:
        small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_LINEAR)
        planes = np.ascontiguousarray(small.transpose(2, 0, 1)[None], dtype=np.float32)
        return model(np.multiply(planes, 1 / 255, out=planes))

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path, help="footage whose first frames are used")
    parser.add_argument("--checkpoint", type=Path, default=Path("road33"), help="detector (default: road33)")
    parser.add_argument(
        "--min-size", type=int, help="short side inside the network, pixels (default: the checkpoint's)"
    )
    parser.add_argument("--device", default="cpu", help="device of the network (default: cpu)")
    parser.add_argument("--backend", choices=BACKEND_CHOICES, default="auto")
    parser.add_argument("--precision", choices=PRECISION_CHOICES, default="auto")
    parser.add_argument("--numbers", default="1,7,15,35", help="numbers of road users (default: 1,7,15,35)")
    parser.add_argument("--frames", type=int, default=10, help="number of frames (default: 10)")
    parser.add_argument("--rounds", type=int, default=10, help="number of rounds (default: 10)")
    parser.add_argument("--peer", type=Path, help="OpenVINO model to time beside the detector")
    options = parser.parse_args()
    settings = Settings(
        device=options.device, backend=options.backend, precision=options.precision, min_size=options.min_size
    )
    predictor = Predictor.load(options.checkpoint, settings, Console(quiet=True))
    frames = [pixels for _, pixels in read(options.video, options.frames)]
    numbers = [int(number) for number in options.numbers.split(",")]
    clock = StageClock(predictor)
    found = predictor.reporting(0.0).detections(frames[:1])[0].all_results(1)
    peer = peer_of(options.peer) if options.peer else None
    rounds: dict[int, list[dict[str, float]]] = {number: [] for number in numbers}
    for turn in range(options.rounds + 1):  # the first warms up
        for number in numbers:
            row = {
                **of_footage(options.video, frames, found[:number]),
                **of_detector(predictor, clock, frames, number, options.device),
            }
            if peer:
                row[options.peer.stem] = timed(lambda: [peer(pixels) for pixels in frames])[0] / len(frames)
            rounds[number] += [row] if turn else []
    height, width = frames[0].shape[:2]
    print(f"{machine(options.device)}, {predictor.described(options.precision)}, frames of {width}x{height}")
    print_head(["stage, ms", *(f"{number} road users" for number in numbers)])
    for stage in rounds[numbers[0]][0]:
        cells = [[1000 * row[stage] for row in rounds[number]] for number in numbers]
        print_row([stage, *(f"{min(cell):.1f}, {np.median(cell):.1f}" for cell in cells)])


if __name__ == "__main__":
    main()
