"""Pad the targets of a batch to tensors of one shape, so that a GPU processes all images at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

IGNORED_KEY = "ignored_boxes"
"""Key of targets for the ignored boxes, (M, 4) xyxy."""

Target = dict[str, Tensor]
HeightWidth = tuple[int, int]
"""Height and width, pixels."""


@dataclass(frozen=True)
class TargetBatch:
    """Labels of B images, in pixels inside the network, padded to the largest number."""

    boxes: Tensor
    """(B, G, 4) float32 xyxy; 0 for padding."""
    labels: Tensor
    """(B, G) int64, from 1."""
    keypoints: Tensor
    """(B, G, K, 3) float32 x, y, v."""
    present: Tensor
    """(B, G) bool: whether an entry exists."""
    ignored: Tensor
    """(B, M, 4) float32 xyxy of ignored boxes; 0 for padding."""

    @classmethod
    def of(
        cls,
        targets: Sequence[Target],
        before: Sequence[HeightWidth],
        inside: Sequence[HeightWidth],
        *,
        ignore_below: float,
        device: torch.device,
    ) -> Self:
        """Collate targets.

        Args:
            targets: Per image boxes (N, 4), labels (N,), keypoints (N, K, 3), ignored_boxes (M, 4), on the CPU.
            before: Sizes of the images, pixels.
            inside: Their sizes inside the network, pixels.
            ignore_below: Minimum shorter edge of a box inside the network, pixels; smaller boxes are ignored.
            device: Device of the result.
        """
        rows = [_resized(*each, ignore_below) for each in zip(targets, before, inside, strict=True)]
        counts = torch.tensor([len(row["labels"]) for row in rows])
        # At least one entry, because a maximum over none fails.
        most = max(1, int(counts.max()))
        shape = rows[0]["keypoints"].shape[1:]
        padding = {
            "boxes": torch.zeros(most, 4),
            "labels": torch.zeros(most, dtype=torch.int64),
            "keypoints": torch.zeros(most, *shape),
            IGNORED_KEY: torch.zeros(1, 4),
        }
        filled = {
            name: pad_sequence([*(row[name] for row in rows), longest], batch_first=True)[:-1]
            for name, longest in padding.items()
        }
        present = torch.arange(most) < counts[:, None]
        parts = (filled["boxes"], filled["labels"], filled["keypoints"], present, filled[IGNORED_KEY])
        return cls(*(to_device(part, device) for part in parts))


def _resized(target: Target, before: HeightWidth, inside: HeightWidth, ignore_below: float) -> Target:
    """Return a target in pixels inside the network; boxes that are too small there are ignored."""
    height, width = (
        torch.tensor(new, dtype=torch.float32) / torch.tensor(old, dtype=torch.float32)
        for new, old in zip(inside, before, strict=True)
    )
    factors = torch.stack([width, height, width, height])
    boxes, ignored = target["boxes"] * factors, target[IGNORED_KEY] * factors
    points = torch.cat([target["keypoints"][..., :2] * factors[:2], target["keypoints"][..., 2:]], dim=-1)
    small = (boxes[:, 2:] - boxes[:, :2]).amin(dim=1) < ignore_below
    kept = ~small
    return {
        "boxes": boxes[kept],
        "labels": target["labels"][kept],
        "keypoints": points[kept],
        IGNORED_KEY: torch.cat([ignored, boxes[small]]),
    }


def to_device(values: Any, device: torch.device) -> Tensor:
    """Return a tensor, or numbers, on a device, without waiting for earlier work of the device."""
    tensor = torch.as_tensor(values)
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)
