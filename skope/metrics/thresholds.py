"""Default thresholds above which detections, boxes and keypoints count."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class PaperThresholds:
    """Default thresholds of the metrics."""

    iou: tuple[float, float, float, float] = (0.9, 0.8, 0.7, 0.6)
    """IoU thresholds for a box to count as found: those of the paper's table, in its order."""
    score: float = 0.9
    """Score above which a detection counts."""
    alpha: float = 0.1
    """Maximum error of a correct keypoint, as a share of the longer edge of the vehicle's box."""


PAPER_THRESHOLDS: Final = PaperThresholds()

KEPT_SCORE: Final = 0.5
"""Default score above which detections are kept, tracked and drawn."""
