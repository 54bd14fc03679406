"""Suppression of all images at once keeps what torchvision keeps, in its order."""

import pytest
import torch
from torchvision.ops import nms

from skope.train import suppression
from skope.train.losses import _chosen_at_once, _chosen_in_turn
from skope.train.suppression import unsuppressed


def crowd(images: int, count: int, seed: int) -> torch.Tensor:
    """(images, count, 4) boxes about a few places, so that most overlap others."""
    generator = torch.Generator().manual_seed(seed)
    centres = 40 * torch.randint(1, 8, (images, count, 2), generator=generator).float()
    centres += 6 * torch.randn(images, count, 2, generator=generator)
    halves = 10 + 15 * torch.rand(images, count, 2, generator=generator)
    return torch.cat([centres - halves, centres + halves], dim=2)


def in_a_row(count: int) -> torch.Tensor:
    """(1, count, 4) boxes of which each overlaps its neighbours alone: every other one stays."""
    left = 3.0 * torch.arange(count)
    return torch.stack([left, torch.zeros(count), left + 10, torch.full((count,), 10.0)], dim=1)[None]


@pytest.mark.parametrize("pairs", [1 << 26, 1])
def test_what_stays_is_what_torchvision_keeps(pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suppression, "_PAIRS", pairs)
    boxes = crowd(3, 400, 1)
    there = torch.rand(3, 400, generator=torch.Generator().manual_seed(2)) > 0.1
    stays = unsuppressed(boxes, there, 0.5)
    for own, mine, found in zip(boxes, there, stays, strict=True):
        kept = nms(own[mine], torch.arange(int(mine.sum()), 0, -1).float(), 0.5)
        assert found.nonzero()[:, 0].tolist() == sorted(mine.nonzero()[kept, 0].tolist())
    assert 0 < int(stays.sum()) < 600


def test_long_rows_are_followed_to_their_ends() -> None:
    stays = unsuppressed(in_a_row(101), torch.ones(1, 101, dtype=torch.bool), 0.5)
    assert stays[0].tolist() == [i % 2 == 0 for i in range(101)]


def test_no_boxes() -> None:
    assert unsuppressed(torch.zeros(2, 0, 4), torch.zeros(2, 0, dtype=torch.bool), 0.5).shape == (2, 0)


@pytest.mark.parametrize("first", [20, 1000])
def test_both_ways_to_choose_agree(first: int) -> None:
    counts = [150, 150, 40]
    boxes = torch.cat([crowd(2, count, seed) for seed, count in enumerate(counts)], dim=1)
    scores = torch.cat([torch.rand(2, count).round(decimals=2).sort(dim=1, descending=True)[0] for count in counts], 1)
    there = torch.rand(2, 340) > 0.1
    found = [
        choose(boxes, scores, there, counts, most=0.6, first=first) for choose in (_chosen_in_turn, _chosen_at_once)
    ]
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
