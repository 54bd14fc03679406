"""Distillation: training on the outputs of another detector in addition to the labels (Hinton et al., 2015).

The teacher is the trained detector, the student the network in training. The teacher processes the same images, and the
regions of the student's second stage. Class probabilities, boxes and keypoint heat maps of the teacher are softer than
labels, and show which classes and positions are similar.
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
"""Error of a box offset above which the loss of labels and teacher is linear instead of quadratic."""


@dataclass(frozen=True)
class Teacher:
    """Frozen detector whose outputs a smaller detector learns (distillation), with the weights of its losses."""

    model: KeypointRCNN
    """In evaluation mode; no part of it is trainable."""
    config: DetectorConfig
    rules: TeacherRules

    @classmethod
    def load(cls, rules: TeacherRules, student: DetectorConfig, device: torch.device) -> "Teacher | None":
        """Return the teacher of a recipe; None if the recipe names no teacher, or all of its losses have weight 0.

        Raises:
            UserError: The checkpoint does not exist, its keypoint scheme differs from the student's, or its categories
                differ while the loss of classes or boxes has a weight.
        """
        if rules.checkpoint is None or not (rules.of_boxes or rules.keypoints):
            return None
        path = find_checkpoint(Path(rules.checkpoint))
        model, config, _ = load_weights(path, device)
        if config.scheme != student.scheme:
            raise UserError(
                f"teacher.checkpoint: {path}: expected keypoint scheme {student.scheme}, got {config.scheme}"
            )
        if config.categories != student.categories and rules.of_boxes:
            teacher_categories, student_categories = (", ".join(detector.categories) for detector in (config, student))
            raise UserError(
                f"teacher.checkpoint: {path}: expected the categories {student_categories}; got {teacher_categories}. "
                "For keypoints alone, add --set teacher.classes=0 --set teacher.boxes=0"
            )
        fold_norms(model.to(memory_format=torch.channels_last))
        return cls(model.requires_grad_(False), config, rules)

    def lesson(self, images: Tensor) -> "TeacherOutputs":
        """Return the teacher's outputs for (N, 3, H, W) images, as they enter the network."""
        with torch.no_grad():
            return TeacherOutputs(self.model.roi_heads, self.model.backbone(images), self.rules)


@dataclass(frozen=True)
class TeacherOutputs:
    """Outputs of a teacher for a batch of images."""

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
            drawn: (B, S) bool: whether a region is in the sample on which the losses are computed.

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
        """Compute the loss of the keypoint heat maps.

        Args:
            regions: (N, 4) vehicle regions of each image, pixels inside the network.
            sizes: Sizes of the images inside the network.
            maps: (N of all, K, H, W) logits of the student's heat maps.
            labelled: (N of all, K) bool, whether a point is trained.

        Returns:
            Mean divergence of the heat maps of the trained points, times the weight of the loss.
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
        """Return the Kullback-Leibler divergence of the student from the teacher over the last axis.

        The divergence is multiplied by the square of the temperature. Gradients then have the same size at any
        temperature.
        """
        heat = self.rules.temperature
        student_log_p, teacher_log_p = (functional.log_softmax(each / heat, dim=-1) for each in (logits, taught))
        return heat**2 * functional.kl_div(student_log_p, teacher_log_p, reduction="none", log_target=True).sum(dim=-1)
