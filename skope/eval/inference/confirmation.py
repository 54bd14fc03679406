"""Which detections of a video its other frames confirm.

Boxes are linked from frame to frame. What is seen surely once or twice only is left out; of a vehicle that is seen
surely nearly always, weak detections stay. What stands all the time is left out where it has no vehicle's size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import boxes as box_math
from skope.eval.assignment import cheapest_pairs
from skope.eval.inference.expected_sizes import ExpectedSizes, Sample
from skope.schema import Result
from skope.types import Array

Integers = NDArray[np.int32]

WEAK: Final = 0.2
"""Detections above this continue a vehicle that is seen more surely in other frames."""
FARTHEST_S: Final = 0.3
"""Frames that are farther apart say nothing of each other: vehicles cannot be linked by their boxes."""

_LOST_S: Final = 1.0
"""A vehicle that is not seen for so long is another one when it comes back, seconds."""
_FEWEST: Final = 3
"""A vehicle is seen surely in so many frames, or there is none."""
_FEWEST_KEYS: Final = 2
"""The same where the detector sees key frames only."""
_NEARLY_ALWAYS: Final = 0.8
"""Weak detections stay of a vehicle that is sure in more than this share of those that it has."""
_REACH: Final = 0.7
"""How far from where it is expected a vehicle may be, in its sizes."""
_FIRST_REACH: Final = 1.5
"""The same while its speed is not known."""
_ALIKE: Final = 1.8
"""Boxes of one vehicle in two frames differ in size by this factor at most."""
_STANDS: Final = 0.3
"""What never moves by more of its size stands."""
_DRIVES: Final = 1.0
"""What moves by more of its size drives."""


@dataclass(slots=True)
class _Vehicle:
    """What was seen of a vehicle, or of what was taken for one; sizes are square roots of boxes' areas, pixels."""

    time_s: float
    """Of its last frame."""
    box: Array
    """(4,) x0, y0, x1, y1 in its last frame."""
    velocity: Array = field(default_factory=lambda: np.zeros(4))
    """(4,) of the box's edges, pixels a second."""
    seen: int = 0
    """In how many frames it is."""
    found: int = 0
    """How often the detector has found it; in other frames it is interpolated."""
    sure: int = 0
    """How often the detector has found it surely."""
    lowest: Array = field(default_factory=lambda: np.full(2, np.inf))
    """(2,) least x and y of its middle."""
    highest: Array = field(default_factory=lambda: np.full(2, -np.inf))
    sizes: float = 0.0
    """Sum of its sizes."""
    samples: list[Sample] = field(default_factory=list)
    """Where its box stands on the road, x and y, and its size there: one for each size that it has moved."""

    @property
    def size(self) -> float:
        return self.sizes / self.seen

    @property
    def moved(self) -> float:
        """How far its middle has moved, in its sizes."""
        return float((self.highest - self.lowest).max()) / self.size

    def expected(self, time_s: float) -> Array:
        """(4,) its box at a later time."""
        return self.box + self.velocity * (time_s - self.time_s)

    def see(self, time_s: float, box: Array, *, sure: bool, interpolated: bool) -> None:
        if self.seen:
            now = (box - self.box) / (time_s - self.time_s)
            self.velocity = now if self.seen == 1 else (self.velocity + now) / 2
        self.time_s, self.box = time_s, box
        self.seen += 1
        self.found += not interpolated
        self.sure += sure and not interpolated
        middle, size = (box[:2] + box[2:]) / 2, _size(box)
        self.lowest, self.highest = np.minimum(self.lowest, middle), np.maximum(self.highest, middle)
        self.sizes += size
        ground = (float(middle[0]), float(box[3]))
        if not self.samples or np.hypot(*np.subtract(ground, self.samples[-1][:2])) > size:
            self.samples.append((*ground, size))


class Confirmation:
    """Detections of a video, frame by frame, and which of them the others confirm."""

    def __init__(self, score: float, *, every: int = 1) -> None:
        """What scores above `score` is sure; the detector sees each `every`-th frame."""
        self._sure = score
        self._fewest = _FEWEST if every == 1 else _FEWEST_KEYS
        self._vehicles: dict[int, _Vehicle] = {}
        """By number; those that were lost before they were surely seen are gone."""
        self._live: list[int] = []
        self._count = 0
        self._of: list[tuple[Integers, list[bool]]] = []
        """The vehicles that the detections of each frame belong to, and which of these are sure."""

    def add(self, time_s: float, found: Sequence[Result]) -> None:
        """Take the detections of the next frame, which is later; sure ones choose their vehicles first."""
        rectangles = box_math.xywh_to_xyxy(np.array([one.bbox for one in found]).reshape(-1, 4))
        sure = np.array([one.score > self._sure for one in found], dtype=bool)
        self._forget(time_s)
        numbers = np.full(len(found), -1, dtype=np.int32)
        for group in (np.flatnonzero(sure), np.flatnonzero(~sure)):
            free = [i for i in self._live if self._vehicles[i].time_s < time_s]
            for vehicle, detection in self._links(free, rectangles[group], time_s):
                here = int(group[detection])
                numbers[here] = vehicle
                self._vehicles[vehicle].see(
                    time_s, rectangles[here], sure=sure[here], interpolated=found[here].interpolated
                )
        for i in np.flatnonzero(numbers < 0).tolist():
            numbers[i], new = self._count, _Vehicle(time_s, rectangles[i])
            new.see(time_s, rectangles[i], sure=sure[i], interpolated=found[i].interpolated)
            self._vehicles[self._count] = new
            self._live.append(self._count)
            self._count += 1
        self._of.append((numbers, sure.tolist()))

    def _forget(self, time_s: float) -> None:
        """End vehicles that were lost."""
        lost = {i for i in self._live if time_s - self._vehicles[i].time_s > _LOST_S}
        self._live = [i for i in self._live if i not in lost]
        for i in lost:
            if self._vehicles[i].sure < self._fewest:
                del self._vehicles[i]

    def _links(self, vehicles: Sequence[int], rectangles: Array, time_s: float) -> list[tuple[int, int]]:
        """Pairs of vehicle and detection that belong together."""
        if not vehicles or not len(rectangles):
            return []
        known = [self._vehicles[i] for i in vehicles]
        expected = np.array([one.expected(time_s) for one in known])
        size = np.array([_size(one.box) for one in known])[:, None]
        reach = np.array([_REACH if one.seen > 1 else _FIRST_REACH for one in known])[:, None]
        away = np.linalg.norm((_middles(expected)[:, None] - _middles(rectangles)[None]), axis=-1) / size
        ratio = np.sqrt(box_math.area(rectangles))[None] / size
        cost = np.where((away < reach) & (np.maximum(ratio, 1 / ratio) < _ALIKE), away, np.inf)
        return [(vehicles[v], d) for v, d in cheapest_pairs(cost, np.inf)]

    def confirmed(self) -> list[list[bool]]:
        """For each frame, which of its detections stay."""
        seen = {i: one for i, one in self._vehicles.items() if one.sure >= self._fewest}
        sizes = ExpectedSizes([one.samples for one in seen.values() if one.moved > _DRIVES])
        stay = {i for i, one in seen.items() if one.moved > _STANDS or sizes.allow((*one.samples[0][:2], one.size))}
        constant = {i for i in stay if seen[i].sure > _NEARLY_ALWAYS * seen[i].found}
        return [
            [i in stay and (sure or i in constant) for i, sure in zip(numbers.tolist(), flags, strict=True)]
            for numbers, flags in self._of
        ]


def _size(box: Array) -> float:
    """Square root of a box's area, pixels."""
    return float(np.sqrt(np.maximum(1.0, box_math.area(box))))


def _middles(rectangles: Array) -> Array:
    return (rectangles[:, :2] + rectangles[:, 2:]) / 2
