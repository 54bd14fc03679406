"""Rules that decide which road users are ground truth and which are ignored."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.errors import UserError, one_of
from skope.gen.labels.image_extent import Extent
from skope.gen.labels.world_keypoints import LOCALIZER_CHOICES
from skope.types import Mask

OCCLUSION_RULES: Final = ("others", "paper")


@dataclass(frozen=True)
class LabelLimits:
    """Limits below which a vehicle is ignored."""

    pixels: int = 20
    """Minimum number of visible pixels; vehicles with fewer are ignored as `small`."""
    contrast: float = 1.0
    """Minimum mean contrast of a vehicle's visible pixels, in multiples of the noise floor (noise and compression).

    Vehicles with less are ignored as `unseen`."""


LABEL_LIMITS: Final = LabelLimits()


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Rules for ground truth and ignored road users, and the method of keypoint localisation."""

    occlusion: str = "others"
    localizer: str = "rigid"
    min_visible: float = 0.15
    """Minimum visible fraction of the whole silhouette; a road user below it is ignored as `sliver`."""
    min_box: float = 12.0
    """Minimum length of a box's shorter edge, pixels; a road user below it is ignored as `small`."""

    def __post_init__(self) -> None:
        one_of("--occlusion-rule", self.occlusion, OCCLUSION_RULES)
        one_of("--localizer", self.localizer, LOCALIZER_CHOICES)
        if not 0 <= self.min_visible <= 1:
            raise UserError(f"--min-visible: expected a share from 0 to 1, got {self.min_visible}")
        if not self.min_box >= 0:
            raise UserError(f"--min-box: expected a number of pixels from 0, got {self.min_box}")


def occluded_by_others(hidden_by_others: Mask, inside: Mask) -> Mask:
    """Return whether vehicles (...,) count as occluded by the rule `others`.

    A vehicle does if other objects hide more than half of its keypoints in the image. Both masks are (..., 33).
    """
    return np.asarray(hidden_by_others.sum(-1) * 2 > inside.sum(-1))


def counts_as_hidden(extent: Extent) -> bool:
    """Return whether a road user without keypoints counts as occluded.

    It does if other objects hide more than half of its silhouette in the image.
    """
    return 2 * extent.visible < extent.inside


def ignore_reason(shape: Extent, occluded: bool, contrast: float, rules: Rules) -> str | None:
    """Return why a road user is ignored, or None if it is ground truth.

    Args:
        shape: Boxes and pixel counts of the road user.
        occluded: Whether it counts as occluded by the occlusion rule.
        contrast: Contrast with its background, in multiples of the noise floor.
        rules: Limits.
    """
    if occluded:
        return "occluded"
    if shape.visible < rules.min_visible * shape.whole:
        return "sliver"
    if min(shape.bbox[2:]) < rules.min_box or shape.visible < LABEL_LIMITS.pixels:
        return "small"
    return "unseen" if contrast < LABEL_LIMITS.contrast else None
