"""Limits from which detections, boxes and keypoints count, unless others are asked for."""

from typing import Final

IOU_THRESHOLDS: Final = (0.9, 0.8, 0.7, 0.6)
"""Overlaps from which a box counts as found: those of the paper's table, in its order."""
COUNTED_SCORE: Final = 0.9
"""A detection counts when it scores above this."""
PCK_ALPHA: Final = 0.1
"""A keypoint counts as found within this share of the longer edge of the vehicle's box."""
