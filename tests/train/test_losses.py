"""The losses of a batch equal torchvision's own, of which they are another arrangement."""

import pytest
import torch
from torch.nn.functional import smooth_l1_loss
from torchvision.models.detection import KeypointRCNN
from torchvision.ops import clip_boxes_to_image

from skope import keypoints
from skope.detector.build import DetectorConfig, build
from skope.train import losses
from skope.train.losses import LossSettings, detection_losses
from skope.train.target_batch import IGNORED_KEY, Target

ALL = 1 << 20
"""More regions than there are: nothing is left to chance."""


def target(boxes: list[list[float]], labels: list[int], generator: torch.Generator) -> Target:
    """Boxes with points anywhere in them, of vehicles."""
    corners = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    share = torch.rand(len(corners), keypoints.K, 2, generator=generator)
    places = corners[:, None, :2] + share * (corners[:, None, 2:] - corners[:, None, :2])
    seen = torch.randint(0, 3, (len(corners), keypoints.K, 1), generator=generator).float()
    points = torch.cat([places, seen], dim=2) * (torch.tensor(labels).reshape(-1, 1, 1) == 1)
    return {
        "boxes": corners,
        "labels": torch.tensor(labels, dtype=torch.int64),
        "keypoints": points,
        IGNORED_KEY: torch.zeros(0, 4),
    }


pytestmark = pytest.mark.usefixtures("small_detectors")


@pytest.fixture(scope="module")
def model() -> KeypointRCNN:
    torch.manual_seed(3)
    categories = ("vehicle", "bicycle", "motorcycle", "pedestrian")
    model = build(
        DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160, categories=categories),
        trainable_layers=5,
    )
    # As many as there are, so that the sampling that differs draws all there is.
    model.rpn.fg_bg_sampler.batch_size_per_image = ALL
    model.roi_heads.fg_bg_sampler.batch_size_per_image = ALL
    model.rpn._post_nms_top_n = {"training": 200, "testing": 200}
    return model.train()


@pytest.mark.parametrize("sizes", [((96, 128), (96, 128), (96, 128)), ((96, 128), (120, 90), (96, 128))])
def test_losses_and_gradients_equal_torchvisions(model: KeypointRCNN, sizes: tuple[tuple[int, int], ...]) -> None:
    generator = torch.Generator().manual_seed(5)
    pixels = [torch.randint(0, 256, (3, *size), dtype=torch.uint8, generator=generator) for size in sizes]
    targets = [
        target([[10, 10, 60, 50], [30, 20, 80, 70], [5, 60, 12, 80]], [1, 1, 4], generator),
        target([], [], generator),
        target([[40, 30, 90, 70]], [1], generator),
    ]
    found = {}
    for name in ("stock", "ours"):
        model.zero_grad()
        if name == "stock":
            plain = [{key: value for key, value in one.items() if key != IGNORED_KEY} for one in targets]
            losses = model([image.float() / 255 for image in pixels], plain)
        else:
            losses = detection_losses(model, pixels, targets, LossSettings(ALL, None, 0.0))
        sum(losses.values()).backward()
        gradients = {key: value.grad.clone() for key, value in model.named_parameters() if value.grad is not None}
        found[name] = {key: value.detach() for key, value in losses.items()}, gradients
    (ours, moved), (stock, meant) = found["ours"], found["stock"]
    assert ours.keys() == stock.keys()
    assert moved.keys() == meant.keys()
    for key, value in stock.items():
        torch.testing.assert_close(ours[key], value, rtol=1e-5, atol=1e-7, msg=lambda text, key=key: f"{key}: {text}")
    for key, gradient in meant.items():
        # A bias that moves all places of a map alike has a gradient of nothing but rounding.
        assert (moved[key] - gradient).norm() <= 2e-4 * gradient.norm() + 1e-8, key


class _Constant(torch.nn.Module):
    """In place of the box predictor: the same offsets for every region."""

    def forward(self, regions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.zeros(len(regions), 5), torch.tensor([0.5, -0.4, 0.3, 0.2]).repeat(len(regions), 5)


def test_the_second_look_is_learnt_from_the_box_of_the_first(
    model: KeypointRCNN, monkeypatch: pytest.MonkeyPatch
) -> None:
    heads = model.roi_heads
    monkeypatch.setitem(heads._modules, "box_predictor", _Constant())
    draw = torch.Generator().manual_seed(9)
    corners = 20 + 40 * torch.rand(2, 6, 2, generator=draw)
    boxes = torch.cat([corners, corners + 20], dim=2)
    truth = boxes + 4 * torch.randn(2, 6, 4, generator=draw)
    offsets = torch.randn(2, 6, 4, generator=draw)
    labels = torch.tensor([[1, 0, 4, 1, 1, 0], [0, 0, 2, 1, 0, 1]])
    somebody = (labels > 0) & (torch.rand(2, 6, generator=draw) > 0.2)
    features = {str(level): torch.zeros(2, model.backbone.out_channels, 24 >> level, 32 >> level) for level in range(4)}
    found = losses._second_look(heads, features, boxes, offsets, truth, labels, somebody, [(96, 128), (96, 128)])
    expected = torch.tensor(0.0)
    for own, offset, true in zip(boxes[somebody], offsets[somebody], truth[somebody], strict=True):
        first = heads.box_coder.decode(offset[None], [own[None]])[0]
        first = clip_boxes_to_image(first, (96, 128))
        wanted = heads.box_coder.encode([true[None]], [first])[0][0]
        expected += smooth_l1_loss(torch.tensor([0.5, -0.4, 0.3, 0.2]), wanted, beta=1 / 9, reduction="sum")
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("first", [20, 1000])
def test_proposals_are_chosen_alike_at_once_and_in_turn(first: int) -> None:
    draw = torch.Generator().manual_seed(7)
    counts = [150, 150, 40]
    centres = 40 * torch.randint(1, 6, (2, 340, 2), generator=draw) + 6 * torch.randn(2, 340, 2, generator=draw)
    halves = 10 + 15 * torch.rand(2, 340, 2, generator=draw)
    boxes = torch.cat([centres - halves, centres + halves], dim=2)
    # Some scores are the same, on one level and on several.
    levels = [torch.rand(2, count, generator=draw).round(decimals=2) for count in counts]
    scores = torch.cat([level.sort(dim=1, descending=True)[0] for level in levels], dim=1)
    there = torch.rand(2, 340, generator=draw) > 0.1
    ways = (losses._chosen_in_turn, losses._chosen_at_once)
    found = [choose(boxes, scores, there, counts, most=0.6, first=first) for choose in ways]
    assert all(20 <= len(one) < 300 for one in found[0])
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
