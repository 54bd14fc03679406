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
    """Vehicles with fewer visible pixels are ignored as `small`."""
    contrast: float = 1.0
    """Vehicles whose visible pixels change by less than this on average, in units of what noise and compression hide,
    are ignored as `unseen`."""


LABEL_LIMITS: Final = LabelLimits()


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Rules on what is ground truth and what ignored, and on how keypoints are localised."""

    occlusion: str = "others"
    localizer: str = "rigid"
    min_visible: float = 0.15
    """Less than this share of the silhouette unhidden and inside the image: `sliver`."""
    min_box: float = 12.0
    """A box whose shorter edge is under this many pixels: `small`."""

    def __post_init__(self) -> None:
        one_of("--occlusion-rule", self.occlusion, OCCLUSION_RULES)
        one_of("--localizer", self.localizer, LOCALIZER_CHOICES)
        if not 0 <= self.min_visible <= 1:
            raise UserError(f"--min-visible: expected a share from 0 to 1, got {self.min_visible}")
        if not self.min_box >= 0:
            raise UserError(f"--min-box: expected pixels from 0, got {self.min_box}")


def occluded_by_others(hidden_by_others: Mask, inside: Mask) -> Mask:
    """(...,) whether a vehicle counts as hidden by the rule `others`.

    It does where something else hides more than half of its keypoints inside the image; both masks are (..., 33).
    """
    return np.asarray(hidden_by_others.sum(-1) * 2 > inside.sum(-1))


def counts_as_hidden(extent: Extent) -> bool:
    """Whether a road user without keypoints counts as occluded.

    It does if something else hides more than half of its silhouette inside the image.
    """
    return 2 * extent.visible < extent.inside


def ignore_reason(shape: Extent, occluded: bool, contrast: float, rules: Rules) -> str | None:
    """Tell why a road user is ignored; None where it is ground truth.

    Args:
        shape: Its boxes and pixel counts.
        occluded: Whether something else hides it, by the rule of occlusion.
        contrast: Its contrast with what is behind it, in deviations of the noise.
        rules: The limits.
    """
    if occluded:
        return "occluded"
    if shape.visible < rules.min_visible * shape.whole:
        return "sliver"
    if min(shape.bbox[2:]) < rules.min_box or shape.visible < LABEL_LIMITS.pixels:
        return "small"
    return "unseen" if contrast < LABEL_LIMITS.contrast else None
