"""Ignored vehicles count neither as vehicle nor as background; the keypoint head gets a bounded number of regions."""

import pytest
import torch
from torchvision.models.detection import KeypointRCNN

from skope import detector
from skope.detector import DetectorConfig
from skope.train import assign

VEHICLES = torch.tensor([[10.0, 10, 50, 40]])
IGNORED = torch.tensor([[100.0, 100, 160, 160]])
BOXES = torch.tensor(
    [
        [10.0, 10, 50, 40],  # the vehicle
        [200.0, 10, 240, 40],  # background
        [100.0, 100, 160, 160],  # the ignored vehicle
        [70.0, 100, 130, 160],  # exactly half on it
        [68.0, 100, 128, 160],  # a little less than half on it
        [90.0, 90, 260, 260],  # holds it, but lies outside for the most part
        [120.0, 120, 130, 130],  # a small part of it
    ]
)
LABELS = [1, 0, -1, -1, 0, 0, -1]
TARGET = {"boxes": VEHICLES, "labels": torch.ones(1, dtype=torch.int64), assign.KEY: IGNORED}
EMPTY = {"boxes": torch.zeros(0, 4), "labels": torch.zeros(0, dtype=torch.int64), assign.KEY: torch.zeros(0, 4)}


@pytest.fixture(scope="module")
def model() -> KeypointRCNN:
    model = detector.build(DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160))
    assign.prepare(model, regions=64, keypoint_regions=2)
    return model


def test_anchors(model: KeypointRCNN) -> None:
    labels, matched = model.rpn.assign_targets_to_anchors([BOXES, BOXES], [TARGET, EMPTY])
    assert labels[0].tolist() == LABELS
    assert labels[1].tolist() == [0] * len(BOXES)
    assert torch.equal(matched[0][0], VEHICLES[0])


def test_proposals(model: KeypointRCNN) -> None:
    model.roi_heads._ignored = [IGNORED, EMPTY[assign.KEY]]
    boxes, labels = ([target[key] for target in (TARGET, EMPTY)] for key in ("boxes", "labels"))
    _, assigned = model.roi_heads.assign_targets_to_proposals([BOXES, BOXES], boxes, labels)
    assert assigned[0].tolist() == LABELS
    assert assigned[1].tolist() == [0] * len(BOXES)


def test_a_vehicle_before_an_ignored_one_stays_a_vehicle() -> None:
    vehicle = torch.tensor([[105.0, 105, 155, 155]])
    boxes = torch.tensor([[106.0, 105, 156, 155], [100.0, 100, 120, 120]])
    assert assign.on_ignored(boxes, IGNORED, vehicle).tolist() == [False, True]


def test_an_image_of_ignored_vehicles_only() -> None:
    assert assign.on_ignored(BOXES, IGNORED, torch.zeros(0, 4)).tolist() == [label == -1 for label in LABELS]


def test_ignored_boxes_are_resized_with_the_image(model: KeypointRCNN) -> None:
    target = {**TARGET, "keypoints": torch.zeros(1, 33, 3)}
    _, (resized,) = model.train().transform([torch.zeros(3, 192, 256)], [target])
    torch.testing.assert_close(resized[assign.KEY], IGNORED / 2)
    torch.testing.assert_close(TARGET[assign.KEY], IGNORED)


def test_the_keypoint_head_gets_a_bounded_number_of_vehicles(model: KeypointRCNN) -> None:
    labels = torch.tensor([0, 1, 1, 0, 1, 1])
    matched, labelled = torch.tensor([0, 0, 1, 0, 1, 0]), torch.tensor([True, True])
    chosen = model.roi_heads._choose(labels, matched, labelled)
    assert len(chosen) == 2
    assert (labels[chosen] == 1).all()
    assert model.roi_heads._choose(torch.tensor([0, 1]), matched[:2], labelled).tolist() == [1]


def test_regions_of_vehicles_without_a_labelled_point_are_left_out(model: KeypointRCNN) -> None:
    labels, matched = torch.tensor([0, 1, 1, 0, 1, 1]), torch.tensor([0, 0, 1, 0, 0, 0])
    assert model.roi_heads._choose(labels, matched, torch.tensor([False, True])).tolist() == [2]
    assert not len(model.roi_heads._choose(labels * 0, matched, torch.zeros(0, dtype=torch.bool)))
