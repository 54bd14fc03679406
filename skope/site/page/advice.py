"""Advice on what is missing or turned round in the marks, in words of somebody who has a road and a map."""

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from skope.camera.evidence import Evidence
from skope.camera.model import Camera
from skope.camera.pose_from_points import FEWEST
from skope.site.mark_limits import KNOWN_RANGES
from skope.site.page.document_values import entries_of
from skope.site.page.marks import Marks
from skope.types import Array

BEGIN: Final = (
    "Mark at least four points whose positions you know, or a known length and lines that are parallel on the road. "
    "Gates in the image need no calibration; everything in metres does."
)
MIRRORED: Final = (
    "These places are mirrored: the camera would hang below the road. Looking along x, y has to grow to the left, as "
    "with x east and y north. Are x and y swapped (surveyors often count x to the north), or does y of your plan grow "
    "downwards?"
)
DEGREES: Final = (
    "These places look like latitude and longitude: degrees, not metres. Say which comes first, and they are taken as "
    "metres around a point between them."
)
_NUMBERS: Final = ("no", "one", "two", "three", "four")
_NO_METRES: Final = 0.2
"""Places that differ by less than this are no metres of a road."""


def missing(document: Mapping[str, Any], marks: Marks) -> str:
    """Advice on what to mark or type before points can tell a camera; empty where points are not what is missing."""
    evidence = marks.evidence
    # Three points have as many coordinates as a pose; a fourth is needed where the lens is not known.
    needed = FEWEST - 1 if any("focal" in belief.of for belief in evidence.beliefs) else FEWEST
    if evidence.lengths or evidence.parallels or len(evidence.points) >= needed:
        return ""
    marked = entries_of(document, "points")
    if not marked:
        return BEGIN
    good = len(evidence.points)
    unplaced = [i for i in range(len(marked)) if i not in marks.entries["points"].values()]
    words = f"{good} of {needed} points have their places. "
    if unplaced:
        name = marked[unplaced[0]].get("name") or unplaced[0] + 1
        words += f"Type x and y of point {name} in metres"
    left = needed - good - len(unplaced)
    if left > 0:
        words += (", then mark " if unplaced else "Mark ") + f"{_NUMBERS[left]} more"
        words += ", spread over the road: near and far, left and right"
    return words + "."


def in_degrees(evidence: Evidence) -> bool:
    """Whether places look like degrees on the Earth: none of them a hand's breadth from the others as metres."""
    if len(evidence.points) < 2:
        return False
    places: Array = np.array([point.place[:2] for point in evidence.points])
    return bool(np.ptp(places, axis=0).max() < _NO_METRES and 0 < np.abs(places).max() <= 180 and np.any(places % 1))


def implausible(camera: Camera) -> str:
    """Sentence on a camera that no road camera is, as marks give it that contradict each other; empty for any other."""
    fov_deg = 2 * math.degrees(math.atan(camera.width / 2 / float(camera.K[0, 0])))
    height_m = float(camera.position[2])
    if fov_deg >= KNOWN_RANGES["fov_deg"][0] and height_m >= KNOWN_RANGES["height_m"][0]:
        return ""
    return (
        f"The marks give a camera {height_m:.1f} m over the road with a field of view of {fov_deg:.1f} degrees, which "
        "is not plausible. Check that the lines are parallel on the road, and the lengths; or mark points."
    )


def below_road(evidence: Evidence, camera: Camera) -> bool:
    """Whether a camera hangs below the points that it was found by, as a mirrored plan has it."""
    heights = [point.place[2] for point in evidence.points]
    return bool(heights) and float(camera.position[2]) < min(heights)
