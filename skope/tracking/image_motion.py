"""Region of the image that a followed vehicle can be in: what is far from there is another vehicle.

Along the line of sight a pose is uncertain by metres, which are a lane or a whole vehicle for what is far away; in the
image a vehicle goes on as it went, by pixels. After a gap poses alone would let a track go on with whatever is there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from skope.tracking.tracker_inputs import Detection
from skope.tracking.tracks import OpenTrack, TrackStep
from skope.types import Array

_PACE_S: Final = 0.3
"""The last box and the newest one older by so much tell how fast a vehicle moves in the image, seconds."""
_FASTER: Final = 2.0
"""It may have stopped, or moved on so many times as fast: in the image vehicles that come near grow faster."""
_ASIDE_DIAGONALS: Final = 0.6
"""Largest distance of a vehicle from that way at once, in diagonals of its box."""
_SWERVES: Final = 0.7
"""Growth of that distance in a second: it may have turned."""
_FIRST: Final = (1.0, 8.0)
"""The same two for one that has been seen once: 8 lengths a second are 130 km/h."""


@dataclass(frozen=True, eq=False, slots=True)
class Whereabouts:
    """Region of an image for the middle of a track's box: near a line from where it was."""

    middle: tuple[float, float]
    """Its last place, pixels."""
    way: tuple[float, float]
    """Longest way that it may have gone on from there, pixels."""
    diagonal: float
    """Of the last box, pixels."""
    reach: float
    """Largest distance from the line, in diagonals."""

    def holds(self, detection: Detection) -> bool:
        """Whether a detection can be this vehicle."""
        (x, y), (ahead_x, ahead_y) = _middle(detection.bbox), self.way
        x, y = x - self.middle[0], y - self.middle[1]
        squared = ahead_x**2 + ahead_y**2
        share = min(1.0, max(0.0, (x * ahead_x + y * ahead_y) / squared)) if squared else 0.0
        away = math.hypot(x - share * ahead_x, y - share * ahead_y)
        return away <= self.reach * max(_diagonal(detection.bbox), self.diagonal)


def whereabouts(track: OpenTrack, time_s: float) -> Whereabouts | None:
    """Region for the vehicle of a track in the image of its latest frame, at `time_s`; None: anywhere."""
    last, older = _seen(track.steps)
    if last is None or last.detection is None:
        return None
    x, y = _middle(last.detection.bbox)
    gap, diagonal = time_s - last.time_s, _diagonal(last.detection.bbox)
    if older is None or older.detection is None:
        aside, later = _FIRST
        return Whereabouts((x, y), (0.0, 0.0), diagonal, aside + later * gap)
    before_x, before_y = _middle(older.detection.bbox)
    times = _FASTER * gap / (last.time_s - older.time_s)
    way = (times * (x - before_x), times * (y - before_y))
    return Whereabouts((x, y), way, diagonal, _ASIDE_DIAGONALS + _SWERVES * gap)


def _seen(steps: Sequence[TrackStep]) -> tuple[TrackStep | None, TrackStep | None]:
    """The last step before the latest that has a box, and an older one: the newest that tells a pace, or the first."""
    last = older = None
    for step in reversed(steps[:-1]):
        if step.detection is None:
            continue
        if last is None:
            last = step
            continue
        older = step
        if last.time_s - step.time_s >= _PACE_S:
            break
    return last, older


def _middle(bbox: Array) -> tuple[float, float]:
    x, y, width, height = bbox.tolist()
    return x + width / 2, y + height / 2


def _diagonal(bbox: Array) -> float:
    _, _, width, height = bbox.tolist()
    return math.hypot(width, height)
