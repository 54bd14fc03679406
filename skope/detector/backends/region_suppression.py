"""Overlapping regions suppressed in less time than by torchvision, with its answer.

On a GPU for all images of a batch together, where torchvision takes them one by one (skope/detector/suppression.py); on
a CPU, the best regions of all levels first, and the others only where those are too few.
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
    """Number of regions that are examined first, as a multiple of those that are wanted."""
    least_side_px: float = 1e-2
    """Detections with a shorter side are left out, as in torchvision, pixels."""


SUPPRESSION_LIMITS: Final = SuppressionLimits()


def suppress_together(model: KeypointRCNN) -> None:
    """Let a model choose its proposals and its detections in this way from now on."""
    model.rpn.filter_proposals = _Proposals(model.rpn)
    model.roi_heads.postprocess_detections = _Detections(model.roi_heads)


def suppress_best_first(model: KeypointRCNN) -> None:
    """Let a model on a CPU choose its proposals in this way from now on."""
    model.rpn.filter_proposals = _BestFirst(model.rpn)


class _ProposalLimits:
    """Limits of the regions that are proposed: their numbers, overlap, sides and scores."""

    def __init__(self, rpn: RegionProposalNetwork) -> None:
        self._before, self._after = rpn.pre_nms_top_n(), rpn.post_nms_top_n()
        self._overlap, self._least_side, self._least_score = rpn.nms_thresh, rpn.min_size, rpn.score_thresh


class _BestFirst(_ProposalLimits):
    """In place of `RegionProposalNetwork.filter_proposals`, with its arguments and its answer.

    A region is suppressed by better ones alone. So where those that stay of the best few are as many as are wanted,
    nothing that is worse can be among them, and it need not be looked at.
    """

    def __call__(
        self,
        proposals: Tensor,
        objectness: Tensor,
        image_shapes: Sequence[tuple[int, int]],
        num_anchors_per_level: Sequence[int],
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Choose proposals, as `_Proposals`."""
        counts = list(num_anchors_per_level)
        logits = objectness.reshape(len(proposals), -1)
        images = [self._chosen(*each, counts) for each in zip(proposals, logits, image_shapes, strict=True)]
        return [boxes for boxes, _ in images], [scores for _, scores in images]

    def _chosen(
        self, proposals: Tensor, logits: Tensor, size: tuple[int, int], counts: list[int]
    ) -> tuple[Tensor, Tensor]:
        """The boxes and scores of an image, from (A, 4) and (A,) of all levels."""
        tops = [one.topk(min(self._before, len(one))).indices for one in torch.split(logits, counts)]
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
    """In place of `RegionProposalNetwork.filter_proposals`, with its arguments and, but for rounding, its answer."""

    def __call__(
        self,
        proposals: Tensor,
        objectness: Tensor,
        image_shapes: Sequence[tuple[int, int]],
        num_anchors_per_level: Sequence[int],
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Choose proposals.

        Args:
            proposals: (N, A, 4) xyxy in N images, pixels; the A anchors of all levels.
            objectness: (N * A, 1) their logits.
            image_shapes: Height and width of each image.
            num_anchors_per_level: How many of the A are of each level.

        Returns:
            The (M, 4) best regions of each image and their scores, best first.
        """
        counts = list(num_anchors_per_level)
        logits = torch.split(objectness.reshape(len(proposals), -1), counts, dim=1)
        of_level = zip(torch.split(proposals, counts, dim=1), logits, strict=True)
        levels = [_best(boxes, scores, self._before) for boxes, scores in of_level]
        boxes = _clipped(torch.stack([one for one, _ in levels], dim=1), image_shapes)
        scores = torch.stack([one for _, one in levels], dim=1).sigmoid()
        good = _has_sides(boxes, self._least_side) & (scores >= self._least_score) & (scores > 0)
        kept = not_overlapped(boxes.flatten(0, 1), good.flatten(0, 1), self._overlap).view_as(good)
        found, sure, _ = _chosen(boxes.flatten(1, 2), scores.flatten(1), kept.flatten(1), self._after)
        return found, sure


class _Detections:
    """In place of `RoIHeads.postprocess_detections`, with its arguments and, but for rounding, its answer."""

    def __init__(self, heads: RoIHeads) -> None:
        self._heads = heads

    def __call__(
        self,
        class_logits: Tensor,
        box_regression: Tensor,
        proposals: Sequence[Tensor],
        image_shapes: Sequence[tuple[int, int]],
    ) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Choose detections; those of one category do not suppress another's.

        Args:
            class_logits: (M of all N images, 1 + C) of the background and C categories.
            box_regression: (M of all, 4 + 4 C) offsets of the boxes of each.
            proposals: (M, 4) regions of each image, xyxy, pixels.
            image_shapes: Height and width of each image.

        Returns:
            (D, 4) boxes, (D,) scores and (D,) classes of the detections of each image, best first.
        """
        heads, counts = self._heads, [len(one) for one in proposals]
        classes = class_logits.shape[1]
        of_classes = heads.box_coder.decode(box_regression, list(proposals)).reshape(-1, classes, 4)
        decoded = torch.split(of_classes[:, 1:], counts)
        likely = torch.split(softmax(class_logits, -1)[:, 1:], counts)
        most = max(counts)
        # Axes: image, category, region.
        boxes = torch.stack([pad(one, (0, 0, 0, 0, 0, most - len(one))) for one in decoded]).transpose(1, 2)
        scores = torch.stack([pad(one, (0, 0, 0, most - len(one)), value=-1.0) for one in likely]).transpose(1, 2)
        groups, best = _best(boxes.flatten(0, 1), scores.flatten(0, 1), most)
        boxes, scores = _clipped(groups.view_as(boxes), image_shapes), best.view_as(scores)
        good = _has_sides(boxes, SUPPRESSION_LIMITS.least_side_px) & (scores > max(0.0, heads.score_thresh))
        kept = not_overlapped(boxes.flatten(0, 1), good.flatten(0, 1), heads.nms_thresh).view_as(good)
        most_found = heads.detections_per_img
        found, sure, numbers = _chosen(boxes.flatten(1, 2), scores.flatten(1), kept.flatten(1), most_found)
        return found, sure, [1 + number // most for number in numbers]


def _best(boxes: Tensor, logits: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """(N, most, 4) boxes and (N, most) logits of (N, A, 4) and (N, A), best first; -inf where A is less."""
    count = min(most, logits.shape[1])
    best, index = logits.topk(count, dim=1)
    return pad(_taken(boxes, index), (0, 0, 0, most - count)), pad(best, (0, most - count), value=-torch.inf)


def _taken(boxes: Tensor, index: Tensor) -> Tensor:
    """(N, M, 4) boxes of (N, A, 4), those of the numbers (N, M)."""
    return boxes.gather(1, index[..., None].expand(-1, -1, 4))


def _clipped(boxes: Tensor, image_shapes: Sequence[tuple[int, int]]) -> Tensor:
    return torch.stack([clip_boxes_to_image(one, size) for one, size in zip(boxes, image_shapes, strict=True)])


def _has_sides(boxes: Tensor, least: float) -> Tensor:
    return (boxes[..., 2:] - boxes[..., :2] >= least).all(dim=-1)


def _chosen(boxes: Tensor, scores: Tensor, kept: Tensor, most: int) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """The boxes and scores that are kept, of each image the best, `most` of them at most; and their numbers."""
    best, index = scores.masked_fill(~kept, -1.0).topk(min(most, scores.shape[1]), dim=1)
    counts = (best >= 0).sum(dim=1).tolist()
    found = _taken(boxes, index)
    return (
        [one[:count] for one, count in zip(found, counts, strict=True)],
        [one[:count] for one, count in zip(best, counts, strict=True)],
        [one[:count] for one, count in zip(index, counts, strict=True)],
    )
