"""Run the detector over a split."""

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torchvision.models.detection import KeypointRCNN

from skope import boxes, dataset, detector
from skope.console import Console, minutes
from skope.schema import Annotation, AnnotationFile, Result

Pixels = NDArray[np.uint8]


class Predictor:
    """A checkpoint on a device.

    `given`: leave detection out and place the keypoints of the ground-truth vehicles inside their own boxes.
    """

    def __init__(self, checkpoint: Path, device: str, *, given: bool, console: Console) -> None:
        self._device = detector.choose_device(device)
        self._given = given
        self._console = console
        path = detector.find_checkpoint(checkpoint)
        self._model: KeypointRCNN
        self._model, config, _ = detector.load_weights(path, self._device)
        sides = f"short side {config.min_size}, long side at most {config.max_size} px"
        console.say(f"{path} on {self._device} ({sides})")

    def split(self, file: AnnotationFile, root: Path) -> tuple[Result, ...]:
        """Results for every image of `file`, whose file names are relative to `root`, in order of the images."""
        annotations = file.by_image()
        out: list[Result] = []
        bar = self._console.bar(total=len(file.images), unit="image", label=file.name)
        with bar:
            for i, image in enumerate(file.images):
                start = time.perf_counter()
                pixels = dataset.read_image(root / image.file_name, size=(image.width, image.height))
                if self._given:
                    out += self._on_boxes(image.id, pixels, annotations[image.id])
                else:
                    out += self._found(image.id, pixels)
                bar.update()
                # The first image also warms the libraries up: where there is a second one, that one tells.
                if i == min(1, len(file.images) - 1) and not self._console.quiet:
                    seconds = (time.perf_counter() - start) * len(file.images)
                    bar.write(f"{file.name}: about {minutes(seconds)} for {len(file.images)} images")
        return tuple(out)

    def _found(self, image_id: int, pixels: Pixels) -> list[Result]:
        (found,) = detector.detect(self._model, [pixels], self._device)
        rows = zip(boxes.xyxy_to_xywh(found.boxes_xyxy), found.scores, found.keypoints, strict=True)
        return [Result(image_id=image_id, bbox=box, score=float(s), keypoints=points) for box, s, points in rows]

    def _on_boxes(self, image_id: int, pixels: Pixels, annotations: list[Annotation]) -> list[Result]:
        # In order of id, so that of two vehicles with the same box each is matched to itself.
        truth = sorted((a for a in annotations if not a.ignored), key=lambda a: a.id)
        given = np.array([a.bbox for a in truth]).reshape(-1, 4)
        points = detector.detect_on_boxes(self._model, pixels, boxes.xywh_to_xyxy(given), self._device)
        rows = zip(truth, points, strict=True)
        return [Result(image_id=image_id, bbox=vehicle.bbox, score=1.0, keypoints=p) for vehicle, p in rows]
