"""How a model is trained beyond stock torchvision: ignored road users, and vehicles alone for the keypoint head.

torchvision assigns labels to anchors and proposals in two methods; subclasses here discard what lies on an ignored
vehicle or other road user (label -1, which its samplers leave out), so that it counts neither as one of a category nor
as background. The keypoint head, which torchvision has learn from all categories, gets vehicles alone, and not too
many. They add no weights: `prepare` turns a stock model's parts into these.
"""

from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.roi_heads import RoIHeads, fastrcnn_loss, keypointrcnn_loss
from torchvision.models.detection.rpn import RegionProposalNetwork, RPNHead
from torchvision.models.detection.transform import GeneralizedRCNNTransform, resize_boxes
from torchvision.ops import box_iou

from skope import schema

KEY = "ignored_boxes"
"""Targets carry the ignored boxes, (M, 4) xyxy, under this key."""

_DISCARD = -1
"""Label of what is neither of a category nor background, which torchvision's samplers leave out."""
_SHARE = 0.5
"""Share of a box's area inside an ignored box from which it lies on what is ignored."""
_IOU = 0.5
"""IoU with a box of the ground truth from which a box is that one's, whatever it lies on."""

Target = dict[str, Tensor]


def on_ignored(boxes: Tensor, ignored: Tensor, truth: Tensor) -> Tensor:
    """(N,) bool: lies to half of its area inside one of (M, 4) ignored boxes, and overlaps none of (G, 4) ground-truth
    boxes by 0.5 IoU."""
    if not len(ignored):
        return torch.zeros(len(boxes), dtype=torch.bool, device=boxes.device)
    sides = torch.minimum(boxes[:, None, 2:], ignored[:, 2:]) - torch.maximum(boxes[:, None, :2], ignored[:, :2])
    shared = sides.clamp(min=0).prod(dim=-1).amax(dim=1)  # (N, M, 2) -> (N,)
    own = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1)
    inside = (shared >= _SHARE * own) & (own > 0)
    on_truth: Tensor = (box_iou(boxes, truth) >= _IOU).any(dim=1)
    return inside & ~on_truth


def prepare(model: KeypointRCNN, *, regions: int, keypoint_regions: int | None, ignore_below: float = 0.0) -> None:
    """Make `model` heed the ignored boxes of its targets from now on, and learn from so many regions an image.

    Of `regions` a quarter are vehicles and other road users; at most `keypoint_regions` of the vehicles among them
    enter the keypoint head, None for all. Those whose box has a shorter edge than `ignore_below` pixels inside the
    network are ignored too.
    """
    # Only methods differ, so changing the class keeps weights, settings and hooks as they are.
    model.transform.__class__ = _Transform
    model.transform._ignore_below = ignore_below
    model.rpn.__class__ = _ProposalNetwork
    model.rpn.head.__class__ = _RPNHead
    model.roi_heads.__class__ = _RoIHeads
    model.roi_heads.fg_bg_sampler.batch_size_per_image = regions
    model.roi_heads._keypoint_regions = keypoint_regions


class _Transform(GeneralizedRCNNTransform):  # type: ignore[misc]
    _ignore_below: float

    def resize(self, image: Tensor, target: Target | None = None) -> tuple[Tensor, Target | None]:
        before = image.shape[-2:]
        image, target = super().resize(image, target)
        if target is not None:
            target[KEY] = resize_boxes(target[KEY], before, image.shape[-2:])
            small = (target["boxes"][:, 2:] - target["boxes"][:, :2]).amin(dim=1) < self._ignore_below
            target[KEY] = torch.cat([target[KEY], target["boxes"][small]])
            target.update({name: target[name][~small] for name in ("boxes", "labels", "keypoints")})
        return image, target


class _RPNHead(RPNHead):  # type: ignore[misc]
    def forward(self, x: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """torchvision's forward with results in float32.

        torchvision decodes boxes in the precision of the offsets, and that of bfloat16 is 4 px at 600 px.
        """
        logits, offsets = super().forward(x)
        return [each.float() for each in logits], [each.float() for each in offsets]


class _ProposalNetwork(RegionProposalNetwork):  # type: ignore[misc]
    def assign_targets_to_anchors(
        self, anchors: list[Tensor], targets: list[Target]
    ) -> tuple[list[Tensor], list[Tensor]]:
        labels, matched = super().assign_targets_to_anchors(anchors, targets)
        for label, boxes, target in zip(labels, anchors, targets, strict=True):
            label.masked_fill_(on_ignored(boxes, target[KEY], target["boxes"]), _DISCARD)
        return labels, matched


class _RoIHeads(RoIHeads):  # type: ignore[misc]
    _ignored: list[Tensor]
    _keypoint_regions: int | None

    def assign_targets_to_proposals(
        self, proposals: list[Tensor], gt_boxes: list[Tensor], gt_labels: list[Tensor]
    ) -> tuple[list[Tensor], list[Tensor]]:
        matched, labels = super().assign_targets_to_proposals(proposals, gt_boxes, gt_labels)
        for label, boxes, ignored, truth in zip(labels, proposals, self._ignored, gt_boxes, strict=True):
            label.masked_fill_(on_ignored(boxes, ignored, truth), _DISCARD)
        return matched, labels

    def forward(
        self,
        features: dict[str, Tensor],
        proposals: list[Tensor],
        image_shapes: list[tuple[int, int]],
        targets: list[Target] | None = None,
    ) -> Any:
        """torchvision's forward; in training the keypoint head gets `_keypoint_regions` of an image's vehicles."""
        if not self.training:
            return super().forward(features, proposals, image_shapes, targets)
        assert targets is not None
        self._ignored = [target[KEY] for target in targets]  # assign_targets_to_proposals is not given the targets
        proposals, matched, labels, regression = self.select_training_samples(proposals, targets)
        logits, deltas = self.box_predictor(self.box_head(self.box_roi_pool(features, proposals, image_shapes)))
        loss_classifier, loss_box_reg = fastrcnn_loss(logits.float(), deltas.float(), labels, regression)

        labelled = [(target["keypoints"][..., 2] > 0).any(dim=1) for target in targets]
        chosen = [self._choose(*each) for each in zip(labels, matched, labelled, strict=True)]
        regions = [boxes[index] for boxes, index in zip(proposals, chosen, strict=True)]
        pooled = self.keypoint_roi_pool(features, regions, image_shapes)
        loss_keypoint = keypointrcnn_loss(
            self.keypoint_predictor(self.keypoint_head(pooled)).float().contiguous(),  # the loss takes no other layout
            regions,
            [target["keypoints"] for target in targets],
            [index_of[index] for index_of, index in zip(matched, chosen, strict=True)],
        )
        losses = {"loss_classifier": loss_classifier, "loss_box_reg": loss_box_reg, "loss_keypoint": loss_keypoint}
        return [], losses

    def _choose(self, labels: Tensor, matched: Tensor, labelled: Tensor) -> Tensor:
        """Indices of at most `_keypoint_regions` regions of vehicles with a labelled point, drawn without preference.

        The others add nothing to the loss, which is a mean over labelled points.
        """
        vehicles = torch.where(labels == schema.CATEGORY_ID)[0]
        if len(labelled):
            vehicles = vehicles[labelled[matched[vehicles]]]
        if self._keypoint_regions is None or len(vehicles) <= self._keypoint_regions:
            return vehicles
        return vehicles[torch.randperm(len(vehicles), device=vehicles.device)[: self._keypoint_regions]]
