"""Faster suppression of overlapping regions with the same result as torchvision.

On a GPU, all images of a batch are processed together, whereas torchvision processes them one by one
(skope/detector/suppression.py). On a CPU, the best regions of all levels are examined first, and the remaining regions
only if too few of the best are kept.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import pad, softmax
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.roi_heads import RoIHeads
from torchvision.models.detection.rpn import RegionProposalNetwork
from torchvision.ops import batched_nms, clip_boxes_to_image

from skope.detector.suppression import not_overlapped


@dataclass(frozen=True)
class SuppressionLimits:
    """Limits of the suppression of regions."""

    first_factor: int = 3
    """Number of regions that are examined first, as a multiple of the requested number."""
    least_side_px: float = 1e-2
    """Minimum length of a detection's shorter side, pixels, as in torchvision."""


SUPPRESSION_LIMITS: Final = SuppressionLimits()


def suppress_together(model: KeypointRCNN) -> None:
    """Make a model select its proposals and detections on a GPU with this module."""
    model.rpn.filter_proposals = _Proposals(model.rpn)
    model.roi_heads.postprocess_detections = _Detections(model.roi_heads)


def suppress_best_first(model: KeypointRCNN) -> None:
    """Make a model on a CPU select its proposals with this module."""
    model.rpn.filter_proposals = _BestFirst(model.rpn)


class _ProposalLimits:
    """Limits of proposals: number, overlap, side length and score."""

    def __init__(self, rpn: RegionProposalNetwork) -> None:
        self._before, self._after = rpn.pre_nms_top_n(), rpn.post_nms_top_n()
        self._overlap, self._least_side, self._least_score = rpn.nms_thresh, rpn.min_size, rpn.score_thresh


class _BestFirst(_ProposalLimits):
    """Replacement for `RegionProposalNetwork.filter_proposals` with the same arguments and result.

    Only better regions can suppress a region. If enough of the best few regions are kept, worse regions cannot be among
    the result and need not be examined.
    """

    def __call__(
        self,
        proposals: Tensor,
        objectness: Tensor,
        image_shapes: Sequence[tuple[int, int]],
        num_anchors_per_level: Sequence[int],
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Select proposals; same arguments and result as `_Proposals`."""
        counts = list(num_anchors_per_level)
        logits = objectness.reshape(len(proposals), -1)
        images = [self._chosen(*each, counts) for each in zip(proposals, logits, image_shapes, strict=True)]
        return [boxes for boxes, _ in images], [scores for _, scores in images]

    def _chosen(
        self, proposals: Tensor, logits: Tensor, size: tuple[int, int], counts: list[int]
    ) -> tuple[Tensor, Tensor]:
        """Return boxes and scores of an image's proposals, from (A, 4) and (A,) of all levels."""
        tops = [
            level_logits.topk(min(self._before, len(level_logits))).indices
            for level_logits in torch.split(logits, counts)
        ]
        begins = itertools.accumulate([0, *counts[:-1]])
        index = torch.cat([begin + top for begin, top in zip(begins, tops, strict=True)])
        level = torch.repeat_interleave(torch.tensor([len(top) for top in tops]))
        scores, order = logits[index].sort(descending=True, stable=True)
        boxes, level, scores = proposals[index[order]], level[order], scores.sigmoid()
        boxes = clip_boxes_to_image(boxes, size)
        good = _has_sides(boxes, self._least_side) & (scores >= self._least_score)
        boxes, level, scores = boxes[good], level[good], scores[good]
        for best in (SUPPRESSION_LIMITS.first_factor * self._after, len(boxes)):
            kept = batched_nms(boxes[:best], scores[:best], level[:best], self._overlap)[: self._after]
            if len(kept) == self._after or best >= len(boxes):
                break
        return boxes[kept], scores[kept]


class _Proposals(_ProposalLimits):
    """Replacement for `RegionProposalNetwork.filter_proposals`: same arguments and, up to rounding, same result."""

    def __call__(
        self,
        proposals: Tensor,
        objectness: Tensor,
        image_shapes: Sequence[tuple[int, int]],
        num_anchors_per_level: Sequence[int],
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Select proposals.

        Args:
            proposals: (N, A, 4) xyxy in N images, pixels; the A anchors of all levels.
            objectness: (N * A, 1) logits of the proposals.
            image_shapes: Height and width of each image.
            num_anchors_per_level: Number of anchors of each level.

        Returns:
            The (M, 4) best regions of each image and their scores, best first.
        """
        counts = list(num_anchors_per_level)
        logits = torch.split(objectness.reshape(len(proposals), -1), counts, dim=1)
        of_level = zip(torch.split(proposals, counts, dim=1), logits, strict=True)
        levels = [_best(boxes, scores, self._before) for boxes, scores in of_level]
        boxes = _clipped(torch.stack([level_boxes for level_boxes, _ in levels], dim=1), image_shapes)
        scores = torch.stack([level_scores for _, level_scores in levels], dim=1).sigmoid()
        good = _has_sides(boxes, self._least_side) & (scores >= self._least_score) & (scores > 0)
        kept = not_overlapped(boxes.flatten(0, 1), good.flatten(0, 1), self._overlap).view_as(good)
        found, sure, _ = _chosen(boxes.flatten(1, 2), scores.flatten(1), kept.flatten(1), self._after)
        return found, sure


class _Detections:
    """Replacement for `RoIHeads.postprocess_detections`: same arguments and, up to rounding, same result."""

    def __init__(self, heads: RoIHeads) -> None:
        self._heads = heads

    def __call__(
        self,
        class_logits: Tensor,
        box_regression: Tensor,
        proposals: Sequence[Tensor],
        image_shapes: Sequence[tuple[int, int]],
    ) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Select detections; detections of one category do not suppress those of another.

        Args:
            class_logits: (M of all N images, 1 + C) of the background and C categories.
            box_regression: (M of all, 4 + 4 C) offsets of the boxes of each.
            proposals: (M, 4) regions of each image, xyxy, pixels.
            image_shapes: Height and width of each image.

        Returns:
            (D, 4) boxes, (D,) scores and (D,) classes of the detections of each image, best first.
        """
        heads, counts = self._heads, [len(regions) for regions in proposals]
        classes = class_logits.shape[1]
        of_classes = heads.box_coder.decode(box_regression, list(proposals)).reshape(-1, classes, 4)
        decoded = torch.split(of_classes[:, 1:], counts)
        likely = torch.split(softmax(class_logits, -1)[:, 1:], counts)
        most = max(counts)
        # Axes: image, category, region.
        boxes = torch.stack(
            [pad(image_boxes, (0, 0, 0, 0, 0, most - len(image_boxes))) for image_boxes in decoded]
        ).transpose(1, 2)
        scores = torch.stack(
            [pad(image_scores, (0, 0, 0, most - len(image_scores)), value=-1.0) for image_scores in likely]
        ).transpose(1, 2)
        groups, best = _best(boxes.flatten(0, 1), scores.flatten(0, 1), most)
        boxes, scores = _clipped(groups.view_as(boxes), image_shapes), best.view_as(scores)
        good = _has_sides(boxes, SUPPRESSION_LIMITS.least_side_px) & (scores > max(0.0, heads.score_thresh))
        kept = not_overlapped(boxes.flatten(0, 1), good.flatten(0, 1), heads.nms_thresh).view_as(good)
        most_found = heads.detections_per_img
        found, sure, numbers = _chosen(boxes.flatten(1, 2), scores.flatten(1), kept.flatten(1), most_found)
        return found, sure, [1 + number // most for number in numbers]


def _best(boxes: Tensor, logits: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Return (N, most, 4) boxes and (N, most) logits of (N, A, 4) and (N, A), best first; padded with -inf."""
    count = min(most, logits.shape[1])
    best, index = logits.topk(count, dim=1)
    return pad(_taken(boxes, index), (0, 0, 0, most - count)), pad(best, (0, most - count), value=-torch.inf)


def _taken(boxes: Tensor, index: Tensor) -> Tensor:
    """Return (N, M, 4) boxes: those with the indices (N, M) of (N, A, 4)."""
    return boxes.gather(1, index[..., None].expand(-1, -1, 4))


def _clipped(boxes: Tensor, image_shapes: Sequence[tuple[int, int]]) -> Tensor:
    return torch.stack(
        [clip_boxes_to_image(image_boxes, size) for image_boxes, size in zip(boxes, image_shapes, strict=True)]
    )


def _has_sides(boxes: Tensor, least: float) -> Tensor:
    return (boxes[..., 2:] - boxes[..., :2] >= least).all(dim=-1)


def _chosen(boxes: Tensor, scores: Tensor, kept: Tensor, most: int) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Return boxes, scores and indices of at most `most` kept regions per image, best first."""
    best, index = scores.masked_fill(~kept, -1.0).topk(min(most, scores.shape[1]), dim=1)
    counts = (best >= 0).sum(dim=1).tolist()
    found = _taken(boxes, index)
    return (
        [image_boxes[:count] for image_boxes, count in zip(found, counts, strict=True)],
        [image_scores[:count] for image_scores, count in zip(best, counts, strict=True)],
        [image_index[:count] for image_index, count in zip(index, counts, strict=True)],
    )
