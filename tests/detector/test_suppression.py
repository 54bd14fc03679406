"""Suppression of many groups at once keeps what torchvision keeps of each."""

import pytest
import torch
from torchvision.ops import nms

from skope.detector import suppression
from skope.detector.suppression import not_overlapped


@pytest.mark.parametrize("pairs", [1 << 26, 1])
def test_what_stays_is_what_torchvision_keeps(pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suppression, "PAIRS_AT_ONCE", pairs)
    draw = torch.Generator().manual_seed(1)
    centres = 40 * torch.randint(1, 8, (3, 400, 2), generator=draw) + 6 * torch.randn(3, 400, 2, generator=draw)
    halves = 10 + 15 * torch.rand(3, 400, 2, generator=draw)
    boxes = torch.cat([centres - halves, centres + halves], dim=2)
    good = torch.rand(3, 400, generator=draw) > 0.1
    stays = not_overlapped(boxes, good, 0.5)
    for own, mine, found in zip(boxes, good, stays, strict=True):
        kept = nms(own[mine], torch.arange(int(mine.sum()), 0, -1).float(), 0.5)
        assert found.nonzero()[:, 0].tolist() == sorted(mine.nonzero()[kept, 0].tolist())
    assert 0 < int(stays.sum()) < 600


def test_a_chain_is_decided_in_order() -> None:
    """Each overlaps the next one only: every other one stays, however long the chain is."""
    left = torch.arange(41.0) * 4
    boxes = torch.stack([left, torch.zeros(41), left + 10, torch.full((41,), 10.0)], dim=1)
    kept = not_overlapped(boxes[None], torch.ones(1, 41, dtype=torch.bool), 0.3)[0]
    assert torch.equal(torch.where(kept)[0], nms(boxes, torch.arange(41.0, 0, -1), 0.3))
    assert kept.tolist() == [i % 2 == 0 for i in range(41)]


def test_no_boxes() -> None:
    assert not_overlapped(torch.zeros(2, 0, 4), torch.zeros(2, 0, dtype=torch.bool), 0.5).shape == (2, 0)
