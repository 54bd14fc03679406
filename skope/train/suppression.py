"""Non-maximum suppression of the proposals of all images at once.

torchvision's kernel walks through an image's boxes one after the other on a single block of the GPU: 3 ms an image, 53
of the 186 ms of a step of 16 images (scripts/bench_train.py). Here all pairs of boxes are compared, and what stays is
found by repetition: a box stays if none of the better boxes that overlap it stays. The k-th repetition is right for
every box with less than k overlapping boxes in a row above it; proposals have about ten, so that the result is
torchvision's after a few products of matrices.
"""

from typing import Final

import torch
from torch import Tensor

from skope.train.assignment import iou

_PAIRS: Final = 1 << 26
"""Pairs of boxes that are compared at once: a quarter of a gigabyte in float32, several times over."""
_REPETITIONS: Final = 16
"""After so many it is asked for the first time whether anything still changes, for which the GPU has to be waited."""


def unsuppressed(boxes: Tensor, there: Tensor, most: float) -> Tensor:
    """Which boxes stay when each that stays removes the worse ones that overlap it much.

    Args:
        boxes: (B, N, 4) xyxy, each image's from the best to the worst.
        there: (B, N) bool; the others neither stay nor remove anything.
        most: IoU above which two boxes overlap too much.

    Returns:
        (B, N) bool.
    """
    at_once = max(1, _PAIRS // max(1, boxes.shape[1] ** 2))
    parts = zip(torch.split(boxes, at_once), torch.split(there, at_once), strict=True)
    return torch.cat([_unsuppressed(*part, most) for part in parts])


def _unsuppressed(boxes: Tensor, there: Tensor, most: float) -> Tensor:
    """As `unsuppressed`, of images whose pairs fit into the memory."""
    # Row i has the better boxes that overlap box i; sums of at most some thousand ones are safe in 16 bits.
    better = (iou(boxes, boxes) > most).tril(-1).to(torch.float16 if boxes.is_cuda else torch.float32)
    stays, before = there, ~there
    repetitions = 0
    while repetitions < _REPETITIONS or not torch.equal(stays, before):
        before = stays
        stays = there & (torch.bmm(better, before[..., None].to(better.dtype))[..., 0] == 0)
        repetitions += 1
    return stays
