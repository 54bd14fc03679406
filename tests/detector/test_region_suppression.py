"""Regions that are suppressed for a whole batch are those that torchvision leaves out image by image."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torchvision.models.detection._utils import BoxCoder
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.roi_heads import RoIHeads
from torchvision.models.detection.rpn import RegionProposalNetwork
from torchvision.models.detection.transform import GeneralizedRCNNTransform
from torchvision.ops import batched_nms

from skope.detector.backends import region_suppression
from skope.detector.backends.prepare import KeptAnchors, ResizeFirst
from skope.detector.backends.region_suppression import suppress_best_first, suppress_together

SIZES = [(300, 500), (260, 420)]


class Model:
    """What of a detector chooses regions: 80 of each level go in, 40 of each image come out."""

    def __init__(self, score_thresh: float = 0.05) -> None:
        top = {"training": 80, "testing": 80}
        after = {"training": 40, "testing": 40}
        nothing: Any = torch.nn.Identity()
        self.rpn = RegionProposalNetwork(nothing, nothing, 0.7, 0.3, 256, 0.5, top, after, 0.7).eval()
        heads = RoIHeads(nothing, nothing, nothing, 0.5, 0.5, 512, 0.25, None, score_thresh, 0.5, 12).eval()
        heads.box_coder = BoxCoder((10.0, 10.0, 5.0, 5.0))
        self.roi_heads = heads


def drawn(*shape: int, draw: torch.Generator) -> Tensor:
    """Boxes in clusters, so that many overlap; some are beyond the image, some have no width."""
    centres = torch.randint(0, 6, (*shape, 1), generator=draw) * torch.tensor([90.0, 55.0])
    centres = centres + torch.randn(*shape, 2, generator=draw) * 6
    sides = (torch.rand(*shape, 2, generator=draw) * 60 - 2).clamp(min=0)
    return torch.cat([centres - sides / 2, centres + sides / 2], dim=-1)


def same(ours: list[Tensor], theirs: list[Tensor]) -> None:
    assert len(ours) == len(theirs)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("suppress", [suppress_together, suppress_best_first])
@pytest.mark.parametrize("seed", range(4))
def test_proposals_are_those_of_torchvision(seed: int, suppress: Any) -> None:
    """Of levels with more and with fewer anchors than go in."""
    draw, model = torch.Generator().manual_seed(seed), Model()
    levels = [400, 90, 30]
    boxes, logits = drawn(2, sum(levels), draw=draw), torch.randn(2, sum(levels), generator=draw)
    expected = model.rpn.filter_proposals(boxes, logits.view(-1, 1), SIZES, levels)
    suppress(model)
    found = model.rpn.filter_proposals(boxes, logits.view(-1, 1), SIZES, levels)
    assert {len(one) for one in expected[0]} == {40}
    same(found[0], expected[0])
    same(found[1], expected[1])


@pytest.mark.parametrize("multiple", [1, 3, 9])
def test_the_best_are_looked_at_first_and_the_others_where_those_are_too_few(
    multiple: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked_at: list[int] = []

    def noted(boxes: Tensor, *others: Any) -> Tensor:
        looked_at.append(len(boxes))
        return batched_nms(boxes, *others)

    monkeypatch.setattr(region_suppression, "batched_nms", noted)
    monkeypatch.setattr(
        region_suppression, "SUPPRESSION_LIMITS", replace(region_suppression.SUPPRESSION_LIMITS, first_factor=multiple)
    )
    draw, model = torch.Generator().manual_seed(1), Model()
    levels = [400, 90, 30]
    boxes, logits = drawn(1, sum(levels), draw=draw), torch.randn(1, sum(levels), generator=draw)
    expected = model.rpn.filter_proposals(boxes, logits.view(-1, 1), SIZES[:1], levels)
    suppress_best_first(model)  # type: ignore[arg-type]
    found = model.rpn.filter_proposals(boxes, logits.view(-1, 1), SIZES[:1], levels)
    same(found[0], expected[0])
    assert {1: len(looked_at) == 2 and looked_at[0] == 40, 3: looked_at == [120], 9: len(looked_at) == 1}[multiple]


@pytest.mark.parametrize("suppress", [suppress_together, suppress_best_first])
def test_no_proposal_that_is_good_enough(suppress: Any) -> None:
    model = Model()
    boxes, logits = torch.zeros(1, 20, 4), torch.zeros(20, 1)  # without sides
    suppress(model)
    (found,), (scores,) = model.rpn.filter_proposals(boxes, logits, SIZES[:1], [15, 5])
    assert (found.shape, scores.shape) == ((0, 4), (0,))


def test_anchors_are_worked_out_once_for_each_size() -> None:
    asked: list[tuple[int, ...]] = []

    def generator(images: ImageList, maps: list[Tensor]) -> list[Tensor]:
        asked.append(tuple(images.tensors.shape))
        return AnchorGenerator(((8,), (16,)), ((1.0,),) * 2)(images, maps)

    made: Any = generator
    kept = KeptAnchors(made)
    shapes = [(64, 96), (64, 96), (64, 128), (64, 96)]
    for height, width in shapes:
        maps = [torch.zeros(1, 1, height // stride, width // stride) for stride in (8, 16)]
        (found,) = kept(ImageList(torch.zeros(1, 3, height, width), [(height, width)]), maps)
        assert found.shape == (height * width // 64 + height * width // 256, 4)
        assert found[:, 2].max() > width - 9
    assert [shape[3] for shape in asked] == [96, 128, 96]


def test_images_are_resized_before_they_are_normalised() -> None:
    whole = GeneralizedRCNNTransform(48, 90, [0.4, 0.5, 0.6], [0.2, 0.25, 0.3])
    pictures = [torch.rand(3, 60, 100, generator=torch.Generator().manual_seed(k)) for k in range(2)]
    expected, found = whole(pictures)[0], ResizeFirst(whole)(pictures)[0]
    assert found.image_sizes == expected.image_sizes
    torch.testing.assert_close(found.tensors, expected.tensors)


@pytest.mark.parametrize("counts", [(40, 17), (3, 0), (0, 0)])
@pytest.mark.parametrize("score_thresh", [0.05, 0.5])
@pytest.mark.parametrize("classes", [2, 5])
def test_detections_are_those_of_torchvision(counts: tuple[int, int], score_thresh: float, classes: int) -> None:
    draw, model = torch.Generator().manual_seed(sum(counts)), Model(score_thresh)
    proposals = [drawn(count, draw=draw) for count in counts]
    logits = torch.randn(sum(counts), classes, generator=draw)
    offsets = torch.randn(sum(counts), 4 * classes, generator=draw)
    expected = model.roi_heads.postprocess_detections(logits, offsets, proposals, SIZES)
    suppress_together(model)  # type: ignore[arg-type]
    for ours, theirs in zip(
        model.roi_heads.postprocess_detections(logits, offsets, proposals, SIZES), expected, strict=True
    ):
        same(ours, theirs)
