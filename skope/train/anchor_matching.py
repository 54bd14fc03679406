"""Assign anchors and proposals of a batch to ground truth, and sample them, by torchvision's rules.

torchvision processes the images one by one. For each image it requests numbers of boxes from the GPU many times, and
waits each time. Here every count has a known bound, and entries beyond the count are masked. Boxes on an ignored
vehicle or other road user count neither as a category nor as background.
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from skope.train.target_batch import TargetBatch


@dataclass(frozen=True)
class MatchingLimits:
    """Limits of matching anchors and proposals to boxes."""

    discarded: int = -1
    """Label of boxes that belong neither to a category nor to the background."""
    ignored_share: float = 0.5
    """Minimum share of a box's area inside an ignored box for the box to be ignored."""
    iou: float = 0.5
    """Minimum IoU with a ground-truth box at which a box is assigned to that box, even inside an ignored one."""
    pairs_at_once: int = 1 << 26
    """Number of pairs of boxes that are compared at once; several quarters of a gigabyte in float32."""


MATCHING_LIMITS: Final = MatchingLimits()


_BELOW, _BETWEEN = -1, -2


def assign(boxes: Tensor, batch: TargetBatch, *, low: float, high: float, low_quality: bool) -> tuple[Tensor, Tensor]:
    """Assign labels and ground-truth boxes to anchors or proposals.

    Args:
        boxes: (N, 4) xyxy of anchors, the same for all images, or (B, N, 4) of the proposals of each image.
        batch: The ground truth of the B images.
        low: IoU below which a box is background.
        high: Minimum IoU for a box to be assigned to the road user that it overlaps most. A box with an IoU between
            `low` and `high` is discarded.
        low_quality: Also assign the boxes that overlap a ground-truth box most, even if their IoU is below `high`.
            Useful for small objects in the RPN.

    Returns:
        (B, N) int64 labels: that of the ground truth, 0 for background, or `MATCHING_LIMITS.discarded`; and (B, N)
        int64 indices into the ground truth, 0 without a match.
    """
    count = len(batch.boxes)
    at_once = max(1, MATCHING_LIMITS.pairs_at_once // max(1, batch.boxes.shape[1] * boxes.shape[-2]))
    labels, matched = [], []
    for first in range(0, count, at_once):
        part = slice(first, first + at_once)
        part_boxes = boxes if boxes.dim() == 2 else boxes[part]
        present, quality = batch.present[part], anchor_iou(batch.boxes[part], part_boxes)
        best, match = _match(quality, present, low, high, low_quality=low_quality)
        label = batch.labels[part].gather(1, match.clamp(min=0))
        label = torch.where(match >= 0, label, torch.where(match == _BELOW, 0, MATCHING_LIMITS.discarded))
        on_nobody = best < MATCHING_LIMITS.iou
        labels.append(
            label.masked_fill_(_inside(part_boxes, batch.ignored[part]) & on_nobody, MATCHING_LIMITS.discarded)
        )
        matched.append(match.clamp_(min=0))
    return torch.cat(labels), torch.cat(matched)


def anchor_iou(truth: Tensor, boxes: Tensor) -> Tensor:
    """Return (B, G, N) intersection over union of (B, G, 4) ground-truth boxes with (N, 4) or (B, N, 4) boxes."""
    shared = _shared(truth, boxes)
    union = _area(truth)[:, :, None] + _area(boxes).unsqueeze(-2) - shared
    return shared.div_(union)


def _shared(references: Tensor, boxes: Tensor) -> Tensor:
    """Return (B, G, N) intersection areas of (B, G, 4) reference boxes with (N, 4) or (B, N, 4) boxes."""
    x0, y0, x1, y1 = (side[:, :, None] for side in references.unbind(-1))
    left, top, right, bottom = (side.unsqueeze(-2) for side in boxes.unbind(-1))
    width = torch.minimum(x1, right).sub_(torch.maximum(x0, left)).clamp_(min=0)
    height = torch.minimum(y1, bottom).sub_(torch.maximum(y0, top)).clamp_(min=0)
    return width.mul_(height)


def _area(boxes: Tensor) -> Tensor:
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])


def _match(quality: Tensor, present: Tensor, low: float, high: float, *, low_quality: bool) -> tuple[Tensor, Tensor]:
    """Return (B, N) best IoU, -1 without ground truth, and (B, N) its index, `_BELOW` or `_BETWEEN`, as torchvision."""
    quality = quality.masked_fill_(~present[:, :, None], -1.0)
    best, best_index = quality.max(dim=1)
    match = torch.where(best < low, _BELOW, torch.where(best < high, _BETWEEN, best_index))
    if low_quality:
        most = quality.amax(dim=2, keepdim=True)
        closest = ((quality == most) & present[:, :, None]).any(dim=1)
        match = torch.where(closest, best_index, match)
    return best, match


def _inside(boxes: Tensor, ignored: Tensor) -> Tensor:
    """Return (B, N) bool: whether half of a box's area lies inside one of (B, M, 4) ignored boxes."""
    areas = _area(boxes)
    return (_shared(ignored, boxes).amax(dim=1) >= MATCHING_LIMITS.ignored_share * areas) & (areas > 0)


def sample_anchors(labels: Tensor, count: int, share: float) -> tuple[Tensor, Tensor]:
    """Sample anchors or proposals at random for training.

    Args:
        labels: (B, N) labels from `assign`.
        count: Maximum number of samples per image.
        share: Maximum share of samples that are not background; background takes the rest.

    Returns:
        (B, S) int64 indices, S <= `count`, and (B, S) bool mask of the valid ones.
    """
    total = labels.shape[1]
    keys = torch.rand(labels.shape, device=labels.device)
    wanted = (min(int(count * share), total), min(count, total))
    found = [keys.where(kind, -1.0).topk(n, dim=1) for kind, n in zip((labels > 0, labels == 0), wanted, strict=True)]
    positive, negative = ((keys >= 0) for keys, _ in found)
    rank = torch.arange(negative.shape[1], device=labels.device)
    negative &= rank < count - positive.sum(dim=1, keepdim=True)
    drawn = torch.cat([positive, negative], dim=1)
    first = drawn.byte().argsort(dim=1, descending=True, stable=True)[:, :count]
    return torch.cat([at for _, at in found], dim=1).gather(1, first), drawn.gather(1, first)
