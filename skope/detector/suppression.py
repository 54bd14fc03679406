"""Non-maximum suppression of many groups of boxes at once.

torchvision's kernel walks through a group on a single block of the GPU, one box after the other: 3 ms for the proposals
of an image in training, 53 of the 186 ms of a step of 16 images, and for large images longer than the backbone. Here a
box stays if no better one that stays overlaps it; begun with all boxes, that rule settles on what going through them in
order would give, after as many rounds as the longest chain of boxes that decide on each other: about ten (Cluster-NMS;
Zheng et al., 2020).
"""

from typing import Final

import torch
from torch import Tensor

PAIRS_AT_ONCE: Final = 1 << 26
"""Pairs of boxes that are compared at once: several quarters of a gigabyte in float32."""


def not_overlapped(boxes: Tensor, good: Tensor, most: float) -> Tensor:
    """Boxes that stay when each that stays removes the worse ones of its group that overlap it much.

    Args:
        boxes: (G, P, 4) xyxy, each group's from the best to the worst.
        good: (G, P) bool; the others neither stay nor remove anything.
        most: IoU above which two boxes overlap too much, more than 0.

    Returns:
        (G, P) bool.
    """
    at_once = max(1, PAIRS_AT_ONCE // max(1, boxes.shape[1] ** 2))
    parts = zip(torch.split(boxes, at_once), torch.split(good, at_once), strict=True)
    return torch.cat([_not_overlapped(*part, most) for part in parts])


def _not_overlapped(boxes: Tensor, good: Tensor, most: float) -> Tensor:
    """Apply `not_overlapped` to groups with few enough pairs for the memory."""
    area = (boxes[..., 2:] - boxes[..., :2]).prod(dim=-1)
    common = torch.minimum(boxes[:, :, None, 2], boxes[:, None, :, 2])
    common -= torch.maximum(boxes[:, :, None, 0], boxes[:, None, :, 0])
    high = torch.minimum(boxes[:, :, None, 3], boxes[:, None, :, 3])
    high -= torch.maximum(boxes[:, :, None, 1], boxes[:, None, :, 1])
    common = common.clamp_(min=0).mul_(high.clamp_(min=0))
    # Overlap is common / (a + b - common), which is above the limit where common is above its share of the sum.
    overlaps = common.mul_((1 + most) / most) > area[:, :, None] + area[:, None]
    overlaps = overlaps.triu_(diagonal=1)  # [g, i, j]: i is better than j
    kept = good
    while True:
        now = good & ~(overlaps & kept[..., None]).any(dim=1)
        if torch.equal(now, kept):
            return kept
        kept = now
