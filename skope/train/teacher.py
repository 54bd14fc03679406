"""Distillation: training on the outputs of another detector in addition to the labels (Hinton et al., 2015).

The teacher processes the same images and the regions of the student's second stage. Its class probabilities, boxes and
keypoint heat maps are softer than labels, and contain similarities between classes and positions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from torch import Tensor
from torch.nn import functional
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.roi_heads import RoIHeads

from skope.detector.build import DetectorConfig
from skope.detector.checkpoint import find_checkpoint, load_weights
from skope.detector.detect import offsets_of_label
from skope.errors import UserError
from skope.train.fold_batchnorm import fold_norms
from skope.train.recipe import TeacherRules
from skope.train.target_batch import HeightWidth

TEACHER_LOSSES: Final = ("loss_teacher_classes", "loss_teacher_boxes", "loss_teacher_keypoints")
"""Names of the losses that a teacher adds."""
BOX_LOSS_BETA: Final = 1 / 9
"""Error of a box offset above which the loss is linear, for labels and teacher."""


@dataclass(frozen=True)
class Teacher:
    """A detector that is learnt from, and how much its answers count."""

    model: KeypointRCNN
    """In evaluation mode; nothing of it learns."""
    config: DetectorConfig
    rules: TeacherRules

    @classmethod
    def load(cls, rules: TeacherRules, student: DetectorConfig, device: torch.device) -> "Teacher | None":
        """The teacher that a recipe asks for; None: it asks for none, or its answers count nothing.

        Raises UserError where there is no such checkpoint, or it has learnt other keypoints, or other categories and
        its classes or boxes count.
        """
        if rules.checkpoint is None or not (rules.of_boxes or rules.keypoints):
            return None
        path = find_checkpoint(Path(rules.checkpoint))
        model, config, _ = load_weights(path, device)
        if config.scheme != student.scheme:
            raise UserError(
                f"teacher.checkpoint: {path} has keypoint scheme {config.scheme}, what is learnt {student.scheme}"
            )
        if config.categories != student.categories and rules.of_boxes:
            own, wanted = (", ".join(one.categories) for one in (config, student))
            raise UserError(
                f"teacher.checkpoint: {path} knows {own}, what is learnt is {wanted}; with --set teacher.classes=0 "
                "--set teacher.boxes=0 its keypoints alone are learnt"
            )
        fold_norms(model.to(memory_format=torch.channels_last))
        return cls(model.requires_grad_(False), config, rules)

    def lesson(self, images: Tensor) -> "TeacherOutputs":
        """Look at (N, 3, H, W) images as they enter the network."""
        with torch.no_grad():
            return TeacherOutputs(self.model.roi_heads, self.model.backbone(images), self.rules)


@dataclass(frozen=True)
class TeacherOutputs:
    """Answers of a teacher to a batch of images."""

    heads: RoIHeads
    features: dict[str, Tensor]
    rules: TeacherRules

    def of_boxes(
        self, boxes: Tensor, sizes: list[HeightWidth], logits: Tensor, deltas: Tensor, labels: Tensor, drawn: Tensor
    ) -> dict[str, Tensor]:
        """Compute the losses of classes and boxes.

        Args:
            boxes: (B, S, 4) regions of B images, pixels inside the network.
            sizes: Sizes of the images inside the network.
            logits: (B S, C) logits of the student, for background and categories.
            deltas: (B S, 4 C) offsets of the student.
            labels: (B, S) labels of the regions; offsets are trained for vehicles and other road users.
            drawn: (B, S) bool, whether a region is sampled.

        Returns:
            Weighted means over the sampled regions: divergence of the class probabilities, and error of the offsets.
        """
        if not self.rules.of_boxes:
            return dict.fromkeys(("loss_teacher_classes", "loss_teacher_boxes"), logits.new_zeros(()))
        heads = self.heads
        with torch.no_grad():
            pooled = heads.box_roi_pool(self.features, list(boxes), sizes)
            taught, moved = (each.float() for each in heads.box_predictor(heads.box_head(pooled)))
        number = drawn.sum()
        apart = self._divergence(logits, taught).view_as(drawn)
        label = labels.clamp(min=0).flatten()
        offsets, wanted = (offsets_of_label(each, label) for each in (deltas, moved))
        error = (
            functional.smooth_l1_loss(offsets, wanted, beta=BOX_LOSS_BETA, reduction="none").sum(dim=1).view_as(drawn)
        )
        return {
            "loss_teacher_classes": self.rules.classes * apart.where(drawn, 0.0).sum() / number,
            "loss_teacher_boxes": self.rules.boxes * error.where(drawn & (labels > 0), 0.0).sum() / number,
        }

    def of_keypoints(
        self, regions: Sequence[Tensor], sizes: list[HeightWidth], maps: Tensor, labelled: Tensor
    ) -> dict[str, Tensor]:
        """The loss of heat maps.

        Args:
            regions: (N, 4) of each image, on vehicles, pixels inside the network.
            sizes: Of the images inside the network.
            maps: (N of all, K, H, W) the student's heat maps, logits.
            labelled: (N of all, K) bool which points are learnt.

        Returns:
            The mean divergence over these points of where they may be, times its weight.
        """
        if not self.rules.keypoints:
            return {"loss_teacher_keypoints": maps.new_zeros(())}
        heads = self.heads
        with torch.no_grad():
            pooled = heads.keypoint_roi_pool(self.features, list(regions), sizes)
            taught = self.rules.sharpen * heads.keypoint_predictor(heads.keypoint_head(pooled)).float()
        apart = self._divergence(maps.flatten(2), taught.flatten(2))
        mean = apart.where(labelled, 0.0).sum() / labelled.sum().clamp(min=1)
        return {"loss_teacher_keypoints": self.rules.keypoints * mean}

    def _divergence(self, logits: Tensor, taught: Tensor) -> Tensor:
        """Kullback-Leibler divergence of the student's distributions from the teacher's over the last axis.

        Times the temperature's square, so that gradients are as large at any temperature.
        """
        heat = self.rules.temperature
        own, other = (functional.log_softmax(each / heat, dim=-1) for each in (logits, taught))
        return heat**2 * functional.kl_div(own, other, reduction="none", log_target=True).sum(dim=-1)
