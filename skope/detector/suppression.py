"""Non-maximum suppression of many groups of boxes at once.

torchvision's kernel processes a group on a single block of the GPU, one box after another. For the proposals of an
image in training this takes 3 ms, which is 53 of the 186 ms of a step of 16 images. For large images it takes longer
than the backbone.

Here a box is kept if no better kept box overlaps it. The rule is applied to all boxes at once and repeated until
nothing changes. The result is that of sequential processing, after as many rounds as the longest chain of dependent
boxes: about ten (Cluster-NMS; Zheng et al., 2020).
"""

from typing import Final

import torch
from torch import Tensor

PAIRS_AT_ONCE: Final = 1 << 26
"""Number of pairs of boxes that are compared at once; several quarters of a gigabyte in float32."""


def not_overlapped(boxes: Tensor, good: Tensor, most: float) -> Tensor:
    """Return which boxes remain after non-maximum suppression within each group.

    Args:
        boxes: (G, P, 4) xyxy, best first in each group.
        good: (G, P) bool; boxes that are False are neither kept nor remove a box.
        most: IoU above which a kept box removes the worse ones; greater than 0.

    Returns:
        (G, P) bool.
    """
    at_once = max(1, PAIRS_AT_ONCE // max(1, boxes.shape[1] ** 2))
    parts = zip(torch.split(boxes, at_once), torch.split(good, at_once), strict=True)
    return torch.cat([_not_overlapped(*part, most) for part in parts])


def _not_overlapped(boxes: Tensor, good: Tensor, most: float) -> Tensor:
    """Apply `not_overlapped` to batches of groups that fit into memory."""
    area = (boxes[..., 2:] - boxes[..., :2]).prod(dim=-1)
    common = torch.minimum(boxes[:, :, None, 2], boxes[:, None, :, 2])
    common -= torch.maximum(boxes[:, :, None, 0], boxes[:, None, :, 0])
    high = torch.minimum(boxes[:, :, None, 3], boxes[:, None, :, 3])
    high -= torch.maximum(boxes[:, :, None, 1], boxes[:, None, :, 1])
    common = common.clamp_(min=0).mul_(high.clamp_(min=0))
    # Overlap is common / (a + b - common). It exceeds the limit if common exceeds its share of the sum.
    overlaps = common.mul_((1 + most) / most) > area[:, :, None] + area[:, None]
    overlaps = overlaps.triu_(diagonal=1)  # [g, i, j]: whether i is better than j
    kept = good
    while True:
        now = good & ~(overlaps & kept[..., None]).any(dim=1)
        if torch.equal(now, kept):
            return kept
        kept = now
