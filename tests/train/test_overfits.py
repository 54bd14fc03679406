"""Learning from random weights until the images are known by heart, with the whole network."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope import boxes
from skope.dataset.folder import open_dataset
from skope.detections import Detections
from skope.detector.checkpoint import load_weights
from skope.detector.detect import detect
from skope.schema import Annotation
from skope.train.augment import Augment
from skope.train.recipe import SHIPPED_RECIPES
from tests import samples
from tests.train.test_loop import CPU, train

SMALL = replace(
    SHIPPED_RECIPES["scratch"],
    min_size=128,
    max_size=256,
    regions=64,
    keypoint_regions=4,
    bfloat16=False,
    val_fraction=0.0,
)
BY_HEART = replace(SMALL, epochs=40, learning_rate=0.04, augment=Augment(flip=0.0), warmup_steps=8)
"""Knows one image afterwards."""


def pck(found: Detections, vehicles: list[Annotation], score: float = 0.9, iou: float = 0.6) -> float:
    """Share of all labelled keypoints that the best detection on their vehicle puts within a tenth of its size."""
    correct = labelled = 0
    sure = found.scores > score
    for vehicle in vehicles:
        visible = vehicle.keypoints[:, 2] == 2
        labelled += int(visible.sum())
        overlaps = boxes.iou(boxes.xywh_to_xyxy(vehicle.bbox), found.boxes_xyxy[sure])[0]
        if len(overlaps) and overlaps.max() >= iou:
            points = found.keypoints[sure][overlaps.argmax()]
            distances = np.hypot(*(points[:, :2] - vehicle.keypoints[:, :2]).T)
            correct += int((distances[visible] <= 0.1 * vehicle.bbox[2:].max()).sum())
    return correct / labelled


def scores_on_its_images(data: Path, checkpoint: Path) -> list[float]:
    model, _, _ = load_weights(checkpoint, CPU)
    dataset = open_dataset(data)
    file = dataset.read("train")
    vehicles = file.by_image()
    return [pck(detect(model, [dataset.image(image)], CPU)[0], vehicles[image.id]) for image in file.images]


@pytest.mark.slow
def test_overfits_one_image_from_random_weights(tmp_path: Path) -> None:
    """Targets, network and decoded coordinates agree from end to end; test_exports.py says so of a small network."""
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    assert scores_on_its_images(data, train(data, tmp_path / "run", BY_HEART))[0] > 0.9


@pytest.mark.slow
def test_overfits_four_images_with_flips(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=4, splits=("train",))
    checkpoint = train(data, tmp_path / "run", replace(SMALL, epochs=60))
    assert np.mean(scores_on_its_images(data, checkpoint)) > 0.9
