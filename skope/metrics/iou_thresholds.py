"""Overlaps (IoU) from which a box counts as found."""

from typing import Final

IOU_THRESHOLDS: Final = (0.9, 0.8, 0.7, 0.6)
"""Those of the paper's table, in its order."""
