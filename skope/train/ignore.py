"""Ignored vehicles in training: what lies on one counts neither as vehicle nor as background.

torchvision assigns labels to anchors and proposals in two methods; subclasses here discard (label -1, which its samplers
leave out) what lies on an ignored vehicle. They add no weights: `heed` turns a stock model's parts into these.
"""

from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.roi_heads import RoIHeads
from torchvision.models.detection.rpn import RegionProposalNetwork
from torchvision.models.detection.transform import GeneralizedRCNNTransform, resize_boxes
from torchvision.ops import box_iou

KEY = "ignored_boxes"
"""Targets carry the ignored boxes, (M, 4) xyxy, under this key."""

_DISCARD = -1
_SHARE = 0.5
_IOU = 0.5

Target = dict[str, Tensor]


def on_ignored(boxes: Tensor, ignored: Tensor, vehicles: Tensor) -> Tensor:
    """(N,) bool: lies to half of its area inside one of (M, 4) ignored boxes and overlaps no vehicle by 0.5 IoU."""
    if not len(ignored):
        return torch.zeros(len(boxes), dtype=torch.bool, device=boxes.device)
    sides = torch.minimum(boxes[:, None, 2:], ignored[:, 2:]) - torch.maximum(boxes[:, None, :2], ignored[:, :2])
    shared = sides.clamp(min=0).prod(dim=-1).amax(dim=1)  # (N, M, 2) -> (N,)
    own = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1)
    inside = (shared >= _SHARE * own) & (own > 0)
    return inside & ~(box_iou(boxes, vehicles) >= _IOU).any(dim=1)


def heed(model: KeypointRCNN) -> None:
    """Make `model` heed the ignored boxes of its targets from now on."""
    # Only these three methods differ, so changing the class keeps weights, settings and hooks as they are.
    model.transform.__class__ = _Transform
    model.rpn.__class__ = _ProposalNetwork
    model.roi_heads.__class__ = _RoIHeads


class _Transform(GeneralizedRCNNTransform):  # type: ignore[misc]
    def resize(self, image: Tensor, target: Target | None = None) -> tuple[Tensor, Target | None]:
        before = image.shape[-2:]
        image, target = super().resize(image, target)
        if target is not None:
            target[KEY] = resize_boxes(target[KEY], before, image.shape[-2:])
        return image, target


class _ProposalNetwork(RegionProposalNetwork):  # type: ignore[misc]
    def assign_targets_to_anchors(
        self, anchors: list[Tensor], targets: list[Target]
    ) -> tuple[list[Tensor], list[Tensor]]:
        labels, matched = super().assign_targets_to_anchors(anchors, targets)
        for label, boxes, target in zip(labels, anchors, targets, strict=True):
            label[on_ignored(boxes, target[KEY], target["boxes"])] = _DISCARD
        return labels, matched


class _RoIHeads(RoIHeads):  # type: ignore[misc]
    def select_training_samples(self, proposals: list[Tensor], targets: list[Target]) -> Any:
        # The assignment below is not given the targets.
        self._ignored = [target[KEY] for target in targets]
        return super().select_training_samples(proposals, targets)

    def assign_targets_to_proposals(
        self, proposals: list[Tensor], gt_boxes: list[Tensor], gt_labels: list[Tensor]
    ) -> tuple[list[Tensor], list[Tensor]]:
        matched, labels = super().assign_targets_to_proposals(proposals, gt_boxes, gt_labels)
        for label, boxes, ignored, vehicles in zip(labels, proposals, self._ignored, gt_boxes, strict=True):
            label[on_ignored(boxes, ignored, vehicles)] = _DISCARD
        return matched, labels
