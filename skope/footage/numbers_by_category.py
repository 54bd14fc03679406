"""Numbers of the road users of a video, each category by itself: nobody becomes another kind from frame to frame."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from skope.schema import CATEGORIES, AnyResult, Found
from skope.tracking.box_links import BoxLinks
from skope.types import Integers32


class Numbering(Protocol):
    """Something that numbers the road users of one category, as `skope.footage.confirmation.Confirmation`
    does."""

    def add(self, time_s: float, found: Sequence[Found]) -> None: ...

    def confirmed(self) -> list[Integers32]: ...


class Linked:
    """All detections above a score, whether or not other frames confirm them."""

    def __init__(self, score: float) -> None:
        self._score, self._links = score, BoxLinks()
        self._numbers: list[Integers32] = []

    def add(self, time_s: float, found: Sequence[Found]) -> None:
        """Take the detections of the next frame, which is later."""
        sure = np.array([one.score > self._score for one in found], dtype=bool)
        self._numbers.append(np.where(sure, self._links.add(time_s, found), -1).astype(np.int32))

    def confirmed(self) -> list[Integers32]:
        """For each frame the number of each detection, from 0; -1 for those that score less."""
        return self._numbers


class NumbersByCategory:
    """A numbering for each category, whose numbers follow one another: vehicles have the first ones."""

    def __init__(self, make: Callable[[], Numbering]) -> None:
        self._of_category = {number: make() for number in range(1, 1 + len(CATEGORIES))}
        self._categories: list[Integers32] = []
        """(N,) of each frame, ids of its detections' categories."""

    def add(self, time_s: float, found: Sequence[AnyResult]) -> None:
        """Take the detections of the next frame, which is later."""
        categories = np.array([one.category_id for one in found], dtype=np.int32)
        self._categories.append(categories)
        for category, numbering in self._of_category.items():
            numbering.add(time_s, [one for one in found if one.category_id == category])

    def confirmed(self) -> list[Integers32]:
        """For each frame the number of each detection's road user, from 0; -1 for what is not confirmed."""
        out = [np.full(len(categories), -1, dtype=np.int32) for categories in self._categories]
        count = 0
        for category, numbering in self._of_category.items():
            numbers = numbering.confirmed()
            for of_frame, categories, own in zip(out, self._categories, numbers, strict=True):
                of_frame[categories == category] = np.where(own >= 0, own + count, -1)
            count += 1 + max((int(own.max()) for own in numbers if len(own)), default=-1)
        return out
