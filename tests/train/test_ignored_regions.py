"""Ignored vehicles count neither as vehicle nor as background; the keypoint head gets a bounded number of regions."""

import pytest
import torch
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.image_list import ImageList

from skope.detector.build import DetectorConfig, build
from skope.train import ignored_regions

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
TARGET = {"boxes": VEHICLES, "labels": torch.ones(1, dtype=torch.int64), ignored_regions.KEY: IGNORED}
EMPTY = {
    "boxes": torch.zeros(0, 4),
    "labels": torch.zeros(0, dtype=torch.int64),
    ignored_regions.KEY: torch.zeros(0, 4),
}


@pytest.fixture(scope="module")
def model() -> KeypointRCNN:
    model = build(DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160))
    ignored_regions.prepare(model, regions=64, keypoint_regions=2)
    return model


def test_anchors(model: KeypointRCNN) -> None:
    labels, matched = model.rpn.assign_targets_to_anchors([BOXES, BOXES], [TARGET, EMPTY])
    assert labels[0].tolist() == LABELS
    assert labels[1].tolist() == [0] * len(BOXES)
    assert torch.equal(matched[0][0], VEHICLES[0])


def test_proposals(model: KeypointRCNN) -> None:
    model.roi_heads._ignored = [IGNORED, EMPTY[ignored_regions.KEY]]
    boxes, labels = ([target[key] for target in (TARGET, EMPTY)] for key in ("boxes", "labels"))
    _, assigned = model.roi_heads.assign_targets_to_proposals([BOXES, BOXES], boxes, labels)
    assert assigned[0].tolist() == LABELS
    assert assigned[1].tolist() == [0] * len(BOXES)


def test_an_ignored_car_yields_no_negative_anchor_on_itself(model: KeypointRCNN) -> None:
    """Of all anchors of an image; without the rule hundreds of them would be background."""
    image = torch.zeros(1, 3, 256, 256)
    features = [torch.zeros(1, 256, 256 // stride, 256 // stride) for stride in (4, 8, 16, 32, 64)]
    anchors = model.rpn.anchor_generator(ImageList(image, [(256, 256)]), features)
    (labels,), _ = model.rpn.assign_targets_to_anchors(anchors, [TARGET])
    nothing = {**TARGET, ignored_regions.KEY: torch.zeros(0, 4)}
    (without,), _ = model.rpn.assign_targets_to_anchors(anchors, [nothing])
    x0, y0, x1, y1 = anchors[0].T
    shared = (x1.clamp(max=160) - x0.clamp(min=100)).clamp(min=0) * (y1.clamp(max=160) - y0.clamp(min=100)).clamp(min=0)
    on_it = shared >= 0.5 * (x1 - x0) * (y1 - y0)
    assert (labels[on_it] == -1).all()
    assert (without[on_it] == 0).sum() > 100
    assert torch.equal(labels[~on_it], without[~on_it])


def test_what_is_too_small_inside_the_network_is_ignored() -> None:
    model = build(DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160))
    ignored_regions.prepare(model, regions=64, keypoint_regions=2, ignore_below=8.0)
    # Inside the network the image has half the size.
    boxes = torch.tensor([[10.0, 10, 40, 25], [50, 50, 90, 67], [100, 20, 114, 100]])
    target = {
        "boxes": boxes,
        "labels": torch.ones(3, dtype=torch.int64),
        "keypoints": torch.arange(3 * 33 * 3, dtype=torch.float32).reshape(3, 33, 3),
        ignored_regions.KEY: torch.tensor([[0.0, 0, 20, 20]]),
    }
    _, (seen,) = model.transform.train()([torch.zeros(3, 192, 256)], [target])
    assert seen["boxes"].tolist() == [[25, 25, 45, 33.5]]
    assert seen[ignored_regions.KEY].tolist() == [[0, 0, 10, 10], [5, 5, 20, 12.5], [50, 10, 57, 50]]
    assert len(seen["labels"]) == 1
    assert seen["keypoints"][0, 0].tolist() == [99 / 2, 100 / 2, 101]


def test_points_without_a_label_are_never_negative(model: KeypointRCNN) -> None:
    """A vehicle of which one point is labelled moves nothing in the predictor but that point's channel."""
    points = torch.zeros(1, 33, 3)
    points[0, 5] = torch.tensor([30.0, 25, 2])
    image = torch.rand(3, 96, 128, generator=torch.Generator().manual_seed(0))
    losses = model.train()([image], [{**TARGET, "keypoints": points}])
    model.zero_grad()
    losses["loss_keypoint"].backward()
    moved = model.roi_heads.keypoint_predictor.kps_score_lowres.weight.grad.abs().amax(dim=(0, 2, 3))
    assert torch.nonzero(moved).flatten().tolist() == [5]


def test_proposals_keep_their_precision_in_bfloat16(model: KeypointRCNN) -> None:
    """Boxes around 600 px would otherwise lie on a grid of 4 px."""
    seen = []
    hook = model.rpn.register_forward_hook(lambda *parts: seen.extend(parts[2][0]))
    with torch.autocast("cpu", torch.bfloat16):
        losses = model.train()([torch.rand(3, 96, 160)], [{**TARGET, "keypoints": torch.zeros(1, 33, 3)}])
    hook.remove()
    assert seen[0].dtype == torch.float32
    assert (seen[0] != seen[0].bfloat16().float()).any()
    assert all(loss.dtype == torch.float32 for loss in losses.values())


def test_a_vehicle_before_an_ignored_one_stays_a_vehicle() -> None:
    vehicle = torch.tensor([[105.0, 105, 155, 155]])
    boxes = torch.tensor([[106.0, 105, 156, 155], [100.0, 100, 120, 120]])
    assert ignored_regions.on_ignored(boxes, IGNORED, vehicle).tolist() == [False, True]


def test_an_image_of_ignored_vehicles_only() -> None:
    assert ignored_regions.on_ignored(BOXES, IGNORED, torch.zeros(0, 4)).tolist() == [label == -1 for label in LABELS]


def test_ignored_boxes_are_resized_with_the_image(model: KeypointRCNN) -> None:
    target = {**TARGET, "keypoints": torch.zeros(1, 33, 3)}
    _, (resized,) = model.train().transform([torch.zeros(3, 192, 256)], [target])
    torch.testing.assert_close(resized[ignored_regions.KEY], IGNORED / 2)
    torch.testing.assert_close(TARGET[ignored_regions.KEY], IGNORED)


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
