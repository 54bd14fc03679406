"""The losses of torchvision's Keypoint R-CNN, computed for all images of a batch at once.

The losses equal those of torchvision's model up to rounding and the random choice of boxes. Three rules differ: (1)
boxes on ignored regions are neither positive nor background; (2) only vehicles train the keypoint head; (3) the number
of these vehicles per image is limited. In a step of 16 images torchvision launches a few thousand small operations and
waits hundreds of times for the GPU. This module needs a tenth of these operations and waits, which keeps the GPU busy
(scripts/bench_train.py).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.nn import functional
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection._utils import BoxCoder, Matcher, encode_boxes
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.roi_heads import RoIHeads, keypointrcnn_loss
from torchvision.models.detection.rpn import RegionProposalNetwork, concat_box_prediction_layers
from torchvision.models.detection.transform import GeneralizedRCNNTransform
from torchvision.ops import batched_nms

from skope import schema
from skope.detector.build import box_passes_of
from skope.detector.detect import offsets_of_label
from skope.detector.suppression import not_overlapped
from skope.train.anchor_matching import MATCHING_LIMITS, assign, sample_anchors
from skope.train.target_batch import HeightWidth, Target, TargetBatch, to_device
from skope.train.teacher import BOX_LOSS_BETA, Teacher, TeacherOutputs

_LEAST_SIDE_PX: Final = 1.0
"""Minimum side of a box of the second pass, pixels inside the network."""


@dataclass(frozen=True)
class LossSettings:
    """Settings of the losses in addition to those of the model."""

    regions: int
    """Number of regions per image that the second stage is trained on; at most a quarter are vehicles and other road
    users."""
    keypoint_regions: int | None
    """Number of vehicles per image that enter the keypoint head; None for all."""
    ignore_below: float
    """Minimum shorter edge of a box inside the network, pixels. Smaller boxes are ignored."""


def detection_losses(
    model: KeypointRCNN,
    pixels: Sequence[Tensor],
    targets: Sequence[Target],
    rules: LossSettings,
    teacher: Teacher | None = None,
) -> dict[str, Tensor]:
    """Compute the training losses of a batch.

    Args:
        model: The detector.
        pixels: One (3, H, W) uint8 sRGB tensor per image, on the device of the model.
        targets: Per image boxes (N, 4) xyxy, labels (N,), keypoints (N, K, 3) and ignored_boxes (M, 4), on the CPU, in
            pixels of the image; vehicles have label 1.
        rules: Settings of the losses.
        teacher: Detector for distillation; None: training on labels alone.

    Returns:
        The losses as float32 scalars by torchvision's names, and `skope.train.teacher.TEACHER_LOSSES` with a teacher.
    """
    images, before = network_images(model.transform, pixels)
    batch = TargetBatch.of(
        targets, before, images.image_sizes, ignore_below=rules.ignore_below, device=images.tensors.device
    )
    features = model.backbone(images.tensors)
    proposals, found = _proposals(model.rpn, images, features, batch)
    looks_again = box_passes_of(model) > 1
    lesson = None if teacher is None else teacher.lesson(images.tensors)
    heads = _head_losses(model.roi_heads, features, proposals, images.image_sizes, batch, rules, looks_again, lesson)
    return {**found, **heads}


# -------------------------------------------------------------------------------------------------------------- images


def network_images(
    transform: GeneralizedRCNNTransform, pixels: Sequence[Tensor]
) -> tuple[ImageList, list[HeightWidth]]:
    """Return the images resized and normalised by the rules of `transform`, and their original sizes."""
    device = pixels[0].device
    mean, deviation = (to_device(each, device)[:, None, None] for each in (transform.image_mean, transform.image_std))
    before: list[HeightWidth] = [(image.shape[1], image.shape[2]) for image in pixels]
    inside: list[HeightWidth] = [(0, 0)] * len(pixels)
    resized: dict[HeightWidth, Tensor] = {}
    members = {size: [i for i, image_size in enumerate(before) if image_size == size] for size in dict.fromkeys(before)}
    for size, group in members.items():
        stack = (torch.stack([pixels[i] for i in group]).float() / 255 - mean) / deviation
        short = transform.torch_choice(transform.min_size)
        scale = min(short / min(size), transform.max_size / max(size))
        resized[size] = functional.interpolate(
            stack, scale_factor=scale, mode="bilinear", recompute_scale_factor=True, align_corners=False
        )
        for i in group:
            inside[i] = (resized[size].shape[2], resized[size].shape[3])
    step = transform.size_divisible
    height, width = (step * math.ceil(max(sides) / step) for sides in zip(*inside, strict=True))
    tensor = torch.zeros((len(pixels), 3, height, width), device=device)
    for size, group in members.items():
        image = resized[size]
        where = slice(None) if len(members) == 1 else to_device(group, device)
        tensor[where, :, : image.shape[2], : image.shape[3]] = image
    return ImageList(tensor, inside), before


# ----------------------------------------------------------------------------------------------------------- proposals


def _proposals(
    rpn: RegionProposalNetwork, images: ImageList, features: dict[str, Tensor], batch: TargetBatch
) -> tuple[list[Tensor], dict[str, Tensor]]:
    """Return each image's proposals (P, 4), and the losses of the proposal network.

    Results of its convolutions are converted to float32: decoded in bfloat16, boxes at 600 px would lie on a grid of 4
    px.
    """
    maps = list(features.values())
    logits, offsets = ([each.float() for each in part] for part in rpn.head(maps))
    per_level = [math.prod(each.shape[1:]) for each in logits]
    count = len(images.image_sizes)
    objectness, deltas = concat_box_prediction_layers(logits, offsets)
    objectness, deltas = objectness.view(count, -1), deltas.view(count, -1, 4)
    (anchors,) = rpn.anchor_generator(ImageList(images.tensors[:1], images.image_sizes[:1]), maps)
    proposals = _best_boxes(rpn, anchors, deltas.detach(), objectness.detach(), images.image_sizes, per_level)

    sampler = rpn.fg_bg_sampler
    labels, matched = _assigned(rpn.proposal_matcher, anchors, batch)
    at, drawn = sample_anchors(labels, sampler.batch_size_per_image, sampler.positive_fraction)
    label = labels.gather(1, at).clamp(min=0)
    truth = _pick(batch.boxes, matched.gather(1, at))
    error = _box_error(_pick(deltas, at), truth, anchors[at], rpn.box_coder.weights, drawn & (label > 0))
    sure = functional.binary_cross_entropy_with_logits(objectness.gather(1, at), (label > 0).float(), reduction="none")
    number = drawn.sum()
    return proposals, {
        "loss_objectness": sure.where(drawn, 0.0).sum() / number,
        "loss_rpn_box_reg": error.sum() / number,
    }


def _best_boxes(
    rpn: RegionProposalNetwork,
    anchors: Tensor,
    deltas: Tensor,
    objectness: Tensor,
    sizes: Sequence[HeightWidth],
    per_level: list[int],
) -> list[Tensor]:
    """Return the best proposals (P, 4) of each image, without near duplicates."""
    best = rpn._get_top_n_idx(objectness, per_level)
    boxes = _moved(anchors[best], _pick(deltas, best), rpn.box_coder)
    scores = objectness.gather(1, best).sigmoid()
    boxes = _clipped(boxes, sizes)
    valid = ((boxes[..., 2:] - boxes[..., :2]) >= rpn.min_size).all(dim=2) & (scores >= rpn.score_thresh)
    counts = [min(count, rpn.pre_nms_top_n()) for count in per_level]
    choose = _chosen_at_once if boxes.is_cuda else _chosen_in_turn
    return choose(boxes, scores, valid, counts, most=rpn.nms_thresh, first=rpn.post_nms_top_n())


def _chosen_in_turn(
    boxes: Tensor, scores: Tensor, valid: Tensor, counts: list[int], *, most: float, first: int
) -> list[Tensor]:
    """Return the `first` best boxes of each image that no better box of their level overlaps by more than `most`.

    Args:
        boxes: (B, N, 4) xyxy, level by level, best first in each level.
        scores: (B, N).
        valid: (B, N) bool; other boxes are excluded.
        counts: Number of boxes of each level.
        most: Maximum IoU.
        first: Maximum number of boxes per image.
    """
    levels = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)).to(boxes.device)
    kept = []
    for image_boxes, score, image_valid in zip(boxes, scores, valid, strict=True):
        keep = batched_nms(image_boxes[image_valid], score[image_valid], levels[image_valid], most)
        kept.append(image_boxes[image_valid][keep[:first]])
    return kept


def _chosen_at_once(
    boxes: Tensor, scores: Tensor, valid: Tensor, counts: list[int], *, most: float, first: int
) -> list[Tensor]:
    """Select the same boxes as `_chosen_in_turn`, with operations that suit a GPU."""
    levels = zip(torch.split(boxes, counts, dim=1), torch.split(valid, counts, dim=1), strict=True)
    stays = torch.cat([not_overlapped(*level, most) for level in levels], dim=1)
    order = scores.masked_fill(~stays, -1.0).argsort(dim=1, descending=True, stable=True)
    numbers = stays.sum(dim=1).clamp(max=first).tolist()
    return [image_boxes[at[:number]] for image_boxes, at, number in zip(boxes, order, numbers, strict=True)]


# --------------------------------------------------------------------------------------------------------------- heads


def _head_losses(
    heads: RoIHeads,
    features: dict[str, Tensor],
    proposals: list[Tensor],
    sizes: list[HeightWidth],
    batch: TargetBatch,
    rules: LossSettings,
    looks_again: bool,
    lesson: TeacherOutputs | None,
) -> dict[str, Tensor]:
    """Return the losses of the second stage: class, box and keypoints; the box loss twice with `looks_again`."""
    boxes, labels, matched, drawn = _regions(heads, proposals, batch, rules)
    pooled = heads.box_roi_pool(features, list(boxes), sizes)
    logits, deltas = (each.float() for each in heads.box_predictor(heads.box_head(pooled)))
    label = labels.clamp(min=0).flatten()
    wrong = functional.cross_entropy(logits, label, reduction="none").view_as(drawn)
    offsets = offsets_of_label(deltas, label).view_as(boxes)
    truth, assigned = _pick(batch.boxes, matched), drawn & (labels > 0)
    error = _box_error(offsets, truth, boxes, heads.box_coder.weights, assigned).sum()
    if looks_again:
        error = error + _second_look(heads, features, boxes, offsets.detach(), truth, labels, assigned, sizes)
    number = drawn.sum()
    return {
        "loss_classifier": wrong.where(drawn, 0.0).sum() / number,
        "loss_box_reg": error / number,
        **_keypoint_losses(
            heads, features, boxes, labels.where(drawn, MATCHING_LIMITS.discarded), matched, sizes, batch, rules, lesson
        ),
        **({} if lesson is None else lesson.of_boxes(boxes, sizes, logits, deltas, labels, drawn)),
    }


def _second_look(
    heads: RoIHeads,
    features: dict[str, Tensor],
    boxes: Tensor,
    offsets: Tensor,
    truth: Tensor,
    labels: Tensor,
    assigned: Tensor,
    sizes: list[HeightWidth],
) -> Tensor:
    """Sum the errors of the offsets in the second pass of the box head.

    Args:
        heads: The second stage.
        features: The pyramid.
        boxes: (B, S, 4) regions.
        offsets: (B, S, 4) offsets of the first pass.
        truth: (B, S, 4) assigned ground-truth boxes.
        labels: (B, S) labels of these boxes.
        assigned: (B, S) bool, whether a region is assigned and sampled.
        sizes: Sizes of the images inside the network.
    """
    found = _clipped(_moved(boxes, offsets, heads.box_coder), sizes)[assigned]
    found = torch.cat([found[:, :2], torch.maximum(found[:, 2:], found[:, :2] + _LEAST_SIDE_PX)], dim=1)
    counts = assigned.sum(dim=1).tolist()
    pooled = heads.box_roi_pool(features, list(torch.split(found, counts)), sizes)
    _, deltas = heads.box_predictor(heads.box_head(pooled))
    class_offsets = offsets_of_label(deltas.float(), labels[assigned])
    everyone = torch.ones(class_offsets.shape[:1], dtype=torch.bool, device=class_offsets.device)[None]
    return _box_error(class_offsets[None], truth[assigned][None], found[None], heads.box_coder.weights, everyone).sum()


def _regions(
    heads: RoIHeads, proposals: list[Tensor], batch: TargetBatch, rules: LossSettings
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the training sample of the second stage: boxes (B, S, 4), labels, ground-truth indices and mask (B, S)."""
    lengths = to_device([len(each) for each in proposals], batch.boxes.device)[:, None]
    padded = torch.nn.utils.rnn.pad_sequence(proposals, batch_first=True)
    boxes = torch.cat([padded, batch.boxes], dim=1)
    present = torch.cat([torch.arange(padded.shape[1], device=lengths.device) < lengths, batch.present], dim=1)
    labels, matched = _assigned(heads.proposal_matcher, boxes, batch)
    at, drawn = sample_anchors(
        labels.where(present, MATCHING_LIMITS.discarded), rules.regions, heads.fg_bg_sampler.positive_fraction
    )
    return _pick(boxes, at), labels.gather(1, at), matched.gather(1, at), drawn


def _keypoint_losses(
    heads: RoIHeads,
    features: dict[str, Tensor],
    boxes: Tensor,
    labels: Tensor,
    matched: Tensor,
    sizes: list[HeightWidth],
    batch: TargetBatch,
    rules: LossSettings,
    lesson: TeacherOutputs | None,
) -> dict[str, Tensor]:
    """Return the keypoint loss over at most `keypoint_regions` randomly sampled vehicles per image.

    Only vehicles with a labelled point are sampled. Others would add nothing to the loss, a mean over labelled points.
    """
    labelled = (batch.keypoints[..., 2] > 0).any(dim=2).gather(1, matched)
    keys = torch.rand(labels.shape, device=labels.device).where((labels == schema.CATEGORY_ID) & labelled, -1.0)
    most = keys.shape[1] if rules.keypoint_regions is None else min(rules.keypoint_regions, keys.shape[1])
    keys, at = keys.topk(most, dim=1)
    chosen = keys >= 0
    counts = chosen.sum(dim=1).tolist()
    regions = _pick(boxes, at)[chosen]
    image = torch.arange(len(boxes), device=boxes.device)[:, None]
    points = batch.keypoints[image, matched.gather(1, at)][chosen]
    of_image = list(torch.split(regions, counts))
    pooled = heads.keypoint_roi_pool(features, of_image, sizes)
    maps = heads.keypoint_predictor(heads.keypoint_head(pooled)).float().contiguous()  # required by the loss
    loss: Tensor = keypointrcnn_loss(maps, [regions], [points], [torch.arange(len(regions), device=regions.device)])
    taught = {} if lesson is None else lesson.of_keypoints(of_image, sizes, maps, points[..., 2] > 0)
    return {"loss_keypoint": loss, **taught}


def _assigned(matcher: Matcher, boxes: Tensor, batch: TargetBatch) -> tuple[Tensor, Tensor]:
    """Return the result of `assign` for the thresholds of one of torchvision's matchers."""
    return assign(
        boxes,
        batch,
        low=matcher.low_threshold,
        high=matcher.high_threshold,
        low_quality=matcher.allow_low_quality_matches,
    )


def _box_error(found: Tensor, truth: Tensor, boxes: Tensor, weights: Sequence[float], counted: Tensor) -> Tensor:
    """Return (B, S) errors of offsets `found` (B, S, 4) from `boxes` to `truth`; 0 where not `counted`."""
    wanted = encode_boxes(truth.flatten(0, 1), boxes.flatten(0, 1), to_device(weights, boxes.device)).view_as(found)
    # Without the mask, an infinite offset times 0 would not be a number.
    wanted = wanted.where(counted[..., None], found.detach())
    return functional.smooth_l1_loss(found, wanted, beta=BOX_LOSS_BETA, reduction="none").sum(dim=2)


def _moved(boxes: Tensor, offsets: Tensor, coder: BoxCoder) -> Tensor:
    """Return (B, S, 4) boxes moved by offsets, as torchvision decodes them."""
    sides = boxes[..., 2:] - boxes[..., :2]
    centres = boxes[..., :2] + 0.5 * sides
    x, y, w, h = (part / weight for part, weight in zip(offsets.unbind(-1), coder.weights, strict=True))
    centres = centres + torch.stack([x, y], dim=-1) * sides
    halves = 0.5 * (torch.stack([w, h], dim=-1).clamp(max=coder.bbox_xform_clip).exp() * sides)
    return torch.cat([centres - halves, centres + halves], dim=-1)


def _clipped(boxes: Tensor, sizes: Sequence[HeightWidth]) -> Tensor:
    """Return (B, S, 4) boxes clipped to the B images of these sizes."""
    limits = to_device([[width, height, width, height] for height, width in sizes], boxes.device)[:, None]
    return torch.minimum(boxes.clamp(min=0), limits)


def _pick(rows: Tensor, at: Tensor) -> Tensor:
    """Return (B, S, 4) rows of (B, N, 4) at indices (B, S)."""
    return rows.gather(1, at[..., None].expand(-1, -1, rows.shape[2]))
