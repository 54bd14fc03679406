"""Ignored vehicles count neither as vehicle nor as background; what a step learns from is drawn without preference."""

import pytest
import torch
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection._utils import Matcher
from torchvision.models.detection.image_list import ImageList
from torchvision.ops import box_iou

from skope import schema
from skope.detector.build import DetectorConfig, build
from skope.train.anchor_matching import anchor_iou, assign, sample_anchors
from skope.train.losses import LossSettings, detection_losses
from skope.train.target_batch import IGNORED_KEY, Target, TargetBatch

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
CPU = torch.device("cpu")


pytestmark = pytest.mark.usefixtures("small_detectors")


def target(boxes: torch.Tensor, ignored: torch.Tensor, label: int = 1) -> Target:
    labels = torch.full((len(boxes),), label)
    return {"boxes": boxes, "labels": labels, "keypoints": torch.zeros(len(boxes), 33, 3), IGNORED_KEY: ignored}


def batch(*targets: Target, size: tuple[int, int] = (256, 256), ignore_below: float = 0.0) -> TargetBatch:
    sizes = [size] * len(targets)
    return TargetBatch.of(targets, sizes, sizes, ignore_below=ignore_below, device=CPU)


def labels_of(boxes: torch.Tensor, of: TargetBatch) -> list[list[int]]:
    return assign(boxes, of, low=0.5, high=0.5, low_quality=False)[0].tolist()


TARGET, EMPTY = target(VEHICLES, IGNORED), target(torch.zeros(0, 4), torch.zeros(0, 4))


def model(categories: tuple[str, ...] = schema.VEHICLE_ALONE) -> KeypointRCNN:
    return build(DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160, categories=categories)).train()


def test_labels_of_anchors_and_of_proposals() -> None:
    for boxes in (BOXES, BOXES.expand(2, -1, -1)):
        labels, matched = assign(boxes, batch(TARGET, EMPTY), low=0.3, high=0.7, low_quality=True)
        assert labels.tolist() == [LABELS, [0] * len(BOXES)]
        assert matched[0, 0] == 0
    assert labels_of(BOXES, batch(target(VEHICLES, IGNORED, label=4))) == [[4, *LABELS[1:]]]


def test_matching_equals_torchvisions() -> None:
    """Of many random boxes, with as many images as are not compared all at once."""
    generator = torch.Generator().manual_seed(1)
    corners = torch.rand(4, 60, 2, generator=generator) * 200
    boxes = torch.cat([corners, corners + 5 + 60 * torch.rand(4, 60, 2, generator=generator)], dim=2)
    truths = [boxes[i, : 3 * i] + 2 for i in range(4)]
    together = batch(*(target(each, torch.zeros(0, 4)) for each in truths))
    for low_quality in (True, False):
        matcher = Matcher(0.7, 0.3, allow_low_quality_matches=low_quality)
        labels, matched = assign(boxes, together, low=0.3, high=0.7, low_quality=low_quality)
        assert labels[0].tolist() == [0] * 60
        for i in range(1, 4):
            torch.testing.assert_close(anchor_iou(truths[i][None], boxes[i])[0], box_iou(truths[i], boxes[i]))
            expected = matcher(box_iou(truths[i], boxes[i]))
            assert torch.equal(labels[i], torch.where(expected >= 0, 1, torch.where(expected == -1, 0, -1)))
            assert torch.equal(matched[i], expected.clamp(min=0))


def test_an_ignored_car_yields_no_negative_anchor_on_itself() -> None:
    """Of all anchors of an image; without the rule hundreds of them would be background."""
    image = torch.zeros(1, 3, 256, 256)
    features = [torch.zeros(1, 256, 256 // stride, 256 // stride) for stride in (4, 8, 16, 32, 64)]
    (anchors,) = model().rpn.anchor_generator(ImageList(image, [(256, 256)]), features)
    labels, without = (
        assign(anchors, batch(target(VEHICLES, ignored)), low=0.3, high=0.7, low_quality=True)[0][0]
        for ignored in (IGNORED, torch.zeros(0, 4))
    )
    x0, y0, x1, y1 = anchors.T
    shared = (x1.clamp(max=160) - x0.clamp(min=100)).clamp(min=0) * (y1.clamp(max=160) - y0.clamp(min=100)).clamp(min=0)
    on_it = shared >= 0.5 * (x1 - x0) * (y1 - y0)
    assert (labels[on_it] == -1).all()
    assert (without[on_it] == 0).sum() > 100
    assert torch.equal(labels[~on_it], without[~on_it])


def test_a_vehicle_before_an_ignored_one_stays_a_vehicle() -> None:
    vehicle = torch.tensor([[105.0, 105, 155, 155]])
    boxes = torch.tensor([[106.0, 105, 156, 155], [100.0, 100, 120, 120]])
    assert labels_of(boxes, batch(target(vehicle, IGNORED))) == [[1, -1]]


def test_an_image_of_ignored_vehicles_only() -> None:
    assert labels_of(BOXES, batch(target(torch.zeros(0, 4), IGNORED))) == [[0, *LABELS[1:]]]


def test_targets_are_resized_with_the_image_and_what_is_too_small_there_is_ignored() -> None:
    # Inside the network the image has half the size.
    boxes = torch.tensor([[10.0, 10, 40, 25], [50, 50, 90, 67], [100, 20, 114, 100]])
    points = torch.arange(3 * 33 * 3, dtype=torch.float32).reshape(3, 33, 3)
    given = {**target(boxes, torch.tensor([[0.0, 0, 20, 20]])), "keypoints": points}
    seen = TargetBatch.of([given, EMPTY], [(192, 256)] * 2, [(96, 128)] * 2, ignore_below=8.0, device=CPU)
    assert seen.boxes[0][seen.present[0]].tolist() == [[25, 25, 45, 33.5]]
    assert seen.present.sum(dim=1).tolist() == [1, 0]
    assert seen.ignored[0].tolist() == [[0, 0, 10, 10], [5, 5, 20, 12.5], [50, 10, 57, 50]]
    assert seen.ignored[1].tolist() == [[0] * 4] * 3
    assert seen.keypoints[0, 0, 0].tolist() == [99 / 2, 100 / 2, 101]
    assert given["boxes"] is boxes


def test_what_a_step_learns_from_is_drawn_without_preference() -> None:
    labels = torch.tensor([[1, 1, 1, 1, 0, 0, 0, 0, -1, 2], [0, 0, 0, -1, -1, -1, -1, -1, -1, -1]])
    counts = torch.zeros(labels.shape)
    torch.manual_seed(0)
    for _ in range(600):
        at, drawn = sample_anchors(labels, 6, 0.5)
        assert at.shape == (2, 6)
        for image, own in enumerate(at):
            counts[image, own[drawn[image]]] += 1
        assert drawn.sum(dim=1).tolist() == [6, 3]
        assert (labels[0][at[0][drawn[0]]] > 0).sum() == 3
    assert counts[:, [8]].sum() == 0
    # Three of five and three of four of 600: within five deviations.
    assert ((counts[0, [0, 1, 2, 3, 9]] - 360).abs() < 60).all()
    assert ((counts[0, 4:8] - 450).abs() < 55).all()
    assert counts[1].tolist() == [600] * 3 + [0] * 7


def test_points_without_a_label_are_never_negative() -> None:
    """A vehicle of which one point is labelled moves nothing in the predictor but that point's channel."""
    given = target(VEHICLES, IGNORED)
    given["keypoints"][0, 5] = torch.tensor([30.0, 25, 2])
    image = torch.randint(0, 256, (3, 96, 128), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    learning = model()
    detection_losses(learning, [image], [given], LossSettings(64, 2, 0.0))["loss_keypoint"].backward()  # type: ignore[no-untyped-call]
    moved = learning.roi_heads.keypoint_predictor.kps_score_lowres.weight.grad.abs().amax(dim=(0, 2, 3))
    assert torch.nonzero(moved).flatten().tolist() == [5]


def test_the_keypoint_head_gets_so_many_vehicles_with_a_labelled_point() -> None:
    """Not more than asked for, none without a point, and no other road user, even where it has points."""
    learning, seen = model(schema.CATEGORY_NAMES), []
    learning.roi_heads.keypoint_head.register_forward_pre_hook(lambda _, given: seen.append(len(given[0])))
    image = torch.randint(0, 256, (3, 96, 128), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    boxes = torch.tensor([[10.0, 10, 50, 40], [60, 20, 100, 80]])
    for labels, visible, most in (([1, 1], 2.0, 2), ([1, 1], 2.0, 1), ([1, 1], 0.0, 2), ([2, 4], 2.0, 2)):
        given = {**target(boxes, torch.zeros(0, 4)), "labels": torch.tensor(labels)}
        given["keypoints"][:] = torch.tensor([30.0, 25, visible])
        found = detection_losses(learning, [image], [given], LossSettings(64, most, 0.0))
        assert torch.isfinite(found["loss_keypoint"])
    assert seen == [2, 1, 0, 0]


def test_boxes_keep_their_precision_in_bfloat16() -> None:
    """Boxes around 600 px would otherwise lie on a grid of 4 px."""
    learning, seen = model(), []
    hook = learning.roi_heads.box_roi_pool.register_forward_pre_hook(lambda _, given: seen.extend(given[1]))
    image = torch.randint(0, 256, (3, 96, 160), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    with torch.autocast("cpu", torch.bfloat16):
        losses = detection_losses(learning, [image], [TARGET], LossSettings(64, 2, 0.0))
    hook.remove()
    assert seen[0].dtype == torch.float32
    assert (seen[0] != seen[0].bfloat16().float()).any()
    assert all(loss.dtype == torch.float32 for loss in losses.values())
