"""Link the boxes of one vehicle from frame to frame of a video.

A box is linked to a vehicle with a predicted box nearby, or to one with points that were followed to the box (see
`skope.footage.key_frames`). A vehicle that is not detected for a while counts as a new vehicle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from skope import boxes as box_math
from skope.schema import Found
from skope.types import Array, Integers32


@dataclass(frozen=True)
class LinkLimits:
    """Limits of linking boxes from frame to frame."""

    unreachable_cost: float = 1e6
    """Cost used in place of infinity, which the assignment does not accept."""
    frame_gap_s: float = 0.3
    """Maximum time between frames that are linked by boxes, seconds."""
    lost_s: float = 1.0
    """Time without a detection after which a vehicle gets a new number, seconds."""
    reach_sizes: float = 0.7
    """Maximum distance of a vehicle from its predicted position, in its sizes."""
    first_reach_sizes: float = 1.5
    """Maximum distance before its speed is known, in its sizes."""
    size_ratio: float = 1.8
    """Maximum ratio of the sizes of a vehicle's boxes in two frames."""


LINK_LIMITS: Final = LinkLimits()


def cheapest_pairs(cost: Array, below: float) -> list[tuple[int, int]]:
    """Pair rows with columns, one to one, at the lowest total cost (Jonker and Volgenant's algorithm, from scipy).

    Args:
        cost: (N, M) cost of each pair, far less than a million; infinite for impossible pairs.
        below: Only pairs with a lower cost are returned.
    """
    pairs = zip(*linear_sum_assignment(np.minimum(cost, LINK_LIMITS.unreachable_cost)), strict=True)
    return [(int(row), int(column)) for row, column in pairs if cost[row, column] < below]


@dataclass(slots=True)
class _Last:
    """Latest detection of a vehicle."""

    time_s: float
    box: Array
    """(4,) x0, y0, x1, y1, pixels."""
    followed: int | None
    """`track_id` of that detection."""
    velocity: Array = field(default_factory=lambda: np.zeros(4))
    """(4,) velocity of the box's edges, pixels per second."""
    seen: int = 1
    """Number of frames with a detection of the vehicle."""

    def expected(self, time_s: float) -> Array:
        """Return the predicted box (4,) at a later time."""
        return self.box + self.velocity * (time_s - self.time_s)

    def see(self, time_s: float, box: Array, followed: int | None) -> None:
        now = (box - self.box) / (time_s - self.time_s)
        self.velocity = now if self.seen == 1 else (self.velocity + now) / 2
        self.time_s, self.box, self.followed = time_s, box, followed
        self.seen += 1


class BoxLinks:
    """Numbers the vehicles of a video from 0, frame by frame."""

    def __init__(self) -> None:
        self._live: dict[int, _Last] = {}
        self._count = 0

    def add(self, time_s: float, found: Sequence[Found], first: Sequence[bool] | None = None) -> Integers32:
        """Add the detections of the next frame; see `add_boxes`.

        Args:
            time_s: Time of the frame, seconds; later than the previous one.
            found: N detections of the frame; `track_id` links them by followed points.
            first: Which detections choose their vehicles before the others; None: all.

        Returns:
            (N,) the number of each detection's vehicle.
        """
        boxes = np.array([detection.bbox for detection in found]).reshape(-1, 4)
        return self.add_boxes(time_s, boxes, followed=[detection.track_id for detection in found], first=first)

    def add_boxes(
        self,
        time_s: float,
        boxes: Array,
        *,
        followed: Sequence[int | None] | None = None,
        first: Sequence[bool] | None = None,
    ) -> Integers32:
        """Add the boxes of the next frame.

        Args:
            time_s: Time of the frame, seconds; later than the previous one.
            boxes: (N, 4) x, y, width, height, pixels.
            followed: Number that each box shares with a box of an earlier frame by followed points; None: unknown.
            first: Which boxes choose their vehicles before the others; None: all.

        Returns:
            (N,) the number of each box's vehicle.
        """
        self._live = {i: last for i, last in self._live.items() if time_s - last.time_s <= LINK_LIMITS.lost_s}
        rectangles = box_math.xywh_to_xyxy(boxes)
        followed = [None] * len(boxes) if followed is None else followed
        numbers = np.full(len(boxes), -1, dtype=np.int32)
        names = {last.followed: i for i, last in self._live.items() if last.followed is not None}
        for here, name in enumerate(followed):
            # Remove the name, so that of two boxes with one name only the first gets the vehicle.
            if name is not None and (number := names.pop(name, None)) is not None:
                numbers[here] = number
        chosen = np.ones(len(boxes), dtype=bool) if first is None else np.asarray(first, dtype=bool)
        for group in (chosen, ~chosen):
            free = [i for i in self._live if i not in numbers]
            rest = np.flatnonzero(group & (numbers < 0))
            for vehicle, detection in self._links(free, rectangles[rest], time_s):
                numbers[rest[detection]] = vehicle
        for here, number in enumerate(numbers.tolist()):
            if number >= 0:
                self._live[number].see(time_s, rectangles[here], followed[here])
            else:
                numbers[here] = self._count
                self._live[self._count] = _Last(time_s, rectangles[here], followed[here])
                self._count += 1
        return numbers

    def _links(self, vehicles: Sequence[int], rectangles: Array, time_s: float) -> list[tuple[int, int]]:
        """Return pairs of vehicle and detection that belong together."""
        if not vehicles or not len(rectangles):
            return []
        known = [self._live[i] for i in vehicles]
        expected = np.array([last.expected(time_s) for last in known])
        size = np.array([size_of(last.box) for last in known])[:, None]
        reach = np.array(
            [LINK_LIMITS.reach_sizes if last.seen > 1 else LINK_LIMITS.first_reach_sizes for last in known]
        )[:, None]
        away = np.linalg.norm((_middles(expected)[:, None] - _middles(rectangles)[None]), axis=-1) / size
        ratio = np.sqrt(box_math.area(rectangles))[None] / size
        cost = np.where((away < reach) & (np.maximum(ratio, 1 / ratio) < LINK_LIMITS.size_ratio), away, np.inf)
        return [(vehicles[v], d) for v, d in cheapest_pairs(cost, np.inf)]


def size_of(box: Array) -> float:
    """Return the square root of a box's area, pixels."""
    return float(np.sqrt(np.maximum(1.0, box_math.area(box))))


def _middles(rectangles: Array) -> Array:
    return (rectangles[:, :2] + rectangles[:, 2:]) / 2
