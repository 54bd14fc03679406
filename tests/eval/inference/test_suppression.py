"""Regions that are suppressed for a whole batch are those that torchvision leaves out image by image."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torchvision.models.detection._utils import BoxCoder
from torchvision.models.detection.roi_heads import RoIHeads
from torchvision.models.detection.rpn import RegionProposalNetwork

from skope.eval.inference.backends.suppression import suppress_together

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


@pytest.mark.parametrize("seed", range(4))
def test_proposals_are_those_of_torchvision(seed: int) -> None:
    """Of levels with more and with fewer anchors than go in."""
    draw, model = torch.Generator().manual_seed(seed), Model()
    levels = [400, 90, 30]
    boxes, logits = drawn(2, sum(levels), draw=draw), torch.randn(2, sum(levels), generator=draw)
    expected = model.rpn.filter_proposals(boxes, logits.view(-1, 1), SIZES, levels)
    suppress_together(model)  # type: ignore[arg-type]
    found = model.rpn.filter_proposals(boxes, logits.view(-1, 1), SIZES, levels)
    assert {len(one) for one in expected[0]} == {40}
    same(found[0], expected[0])
    same(found[1], expected[1])


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
