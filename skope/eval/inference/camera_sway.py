"""How the camera of a video sways, and when it is moved for good: each frame is held against the first one."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.eval.image_shift import MOVED, ImageMotion, Pixels, ReferencePicture
from skope.eval.inference.view_changes import EVERY_S, ViewChange, changes
from skope.eval.pose.camera_motion import CameraMotion
from skope.schema import Image
from skope.types import Array

_STILL_PX: Final = 0.1
"""A camera stands still whose image moves by less, one standard deviation an axis in a picture 640 pixels wide:
keypoints are ten times as uncertain."""
_STILL_WIDTH: Final = 640
_RAYLEIGH_95: Final = 2.448
"""Within so many of these standard deviations 95% of shifts lie."""
_AROUND_S: Final = 2.0
"""Over so long before and after a change the image's middle place is compared."""
_FEWEST: Final = 3
"""Frames that such a middle place needs."""


class SwayWatch:
    """Measures how far the image of each frame of a video is from the first one's."""

    def __init__(self, first: Pixels | None = None) -> None:
        """`first`: the footage's first frame, where a run goes on after it."""
        self.measured: dict[int, ImageMotion | None] = {}
        """By the number of the frame; None: cannot be told."""
        self._reference = None if first is None else ReferencePicture(first)

    def watch(self, frames: Iterable[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """The frames as they come; single images, which have no times, are not measured."""
        for image, pixels in frames:
            if image.time_s is not None:
                if self._reference is None:
                    self._reference = ReferencePicture(pixels)
                same = pixels.shape[1::-1] == self._reference.size
                self.measured[image.id] = self._reference.motion(pixels) if same else None
            yield image, pixels


@dataclass(frozen=True, eq=False)
class SwayRecord:
    """The motion of all frames of a video, against the first one."""

    numbers: tuple[int, ...]
    """`Image.id` of each frame."""
    times_s: Array
    """(N,) rising."""
    motions: tuple[ImageMotion | None, ...]
    width: int
    """Of the images, pixels."""

    def view_changes(self, looks: Sequence[tuple[float, str]]) -> list[ViewChange]:
        """When the view changes for good, as `changes` has it; not where the camera sways on around the same place."""
        return [self._timed(change) for change in changes(looks, self._stays)]

    def motion(self, view_changes: Sequence[ViewChange]) -> CameraMotion | None:
        """How the camera sways around where it is at rest in each of its views; None: it stands still."""
        part = np.searchsorted([change.time_s for change in view_changes], self.times_s, side="right")
        values = self._values
        known = np.isfinite(values[:, 0])
        for k in np.unique(part):
            rows = (part == k) & known
            if rows.any():
                values[rows] -= np.median(values[rows], axis=0)
        if not known.any():
            return None
        away = np.linalg.norm(values[known, :2], axis=1)
        still = _STILL_PX * max(1.0, self.width / _STILL_WIDTH)
        if np.percentile(away, 95) <= _RAYLEIGH_95 * still:
            return None
        frames = {
            number: replace(motion, x=float(row[0]), y=float(row[1]), turn=float(row[2]))
            for number, motion, row in zip(self.numbers, self.motions, values, strict=True)
            if motion is not None
        }
        x, y, turn = np.sqrt((values[known] ** 2).mean(axis=0)).tolist()
        return CameraMotion(frames, (x, y, turn))

    @property
    def _values(self) -> Array:
        """(N, 3) x, y, turn; NaN where they are not known."""
        nothing = (np.nan,) * 3
        rows = [nothing if one is None else (one.x, one.y, one.turn) for one in self.motions]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def _around(self, time_s: float) -> tuple[Array, Array] | None:
        """(2,) pixels each: the image's middle place before and after a time; None where too few frames tell it.

        A look that shows a change comes up to half a second after it.
        """
        values = self._values[:, :2]
        before = (self.times_s > time_s - EVERY_S - _AROUND_S) & (self.times_s < time_s - EVERY_S)
        after = (self.times_s >= time_s) & (self.times_s < time_s + _AROUND_S)
        parts = [values[rows][np.isfinite(values[rows, 0])] for rows in (before, after)]
        if min(map(len, parts)) < _FEWEST:
            return None
        one, other = (np.median(part, axis=0) for part in parts)
        return one, other

    def _stays(self, time_s: float) -> bool:
        """Whether the image lies elsewhere after a time: looks alone may fall on one side of a sway again and again."""
        around = self._around(time_s)
        return around is None or bool(np.linalg.norm(around[1] - around[0]) > 0.5 * MOVED * self.width)

    def _timed(self, change: ViewChange) -> ViewChange:
        """The change at the first frame that is nearer to where the image is afterwards."""
        around = None if change.cut else self._around(change.time_s)
        if around is None:
            return change
        values = self._values[:, :2]
        window = np.flatnonzero(
            (self.times_s > change.time_s - EVERY_S - 1e-6) & (self.times_s <= change.time_s + 1e-6)
        )
        nearer = np.linalg.norm(values[window] - around[1], axis=1) < np.linalg.norm(values[window] - around[0], axis=1)
        after = list(itertools.takewhile(lambda k: nearer[k], reversed(range(len(window)))))
        return replace(change, time_s=float(self.times_s[window[after[-1]]])) if after else change


def motion_to_row(motion: ImageMotion | None) -> list[float] | None:
    """JSON values of a frame's motion, not rounded."""
    if motion is None:
        return None
    return [motion.x, motion.y, motion.turn, motion.sigma_px, motion.sigma_turn, motion.growth]


def record_of_rows(rows: Iterable[dict[str, Any]], width: int) -> SwayRecord:
    """What was measured, of rows with `image` and `motion` (by `motion_to_row`); images without times are left out."""
    numbers, times, motions = [], [], list[ImageMotion | None]()
    for row in rows:
        if row["image"].get("time_s") is not None:
            numbers.append(int(row["image"]["id"]))
            times.append(float(row["image"]["time_s"]))
            motions.append(None if row["motion"] is None else ImageMotion(*row["motion"]))
    seconds: NDArray[np.float64] = np.array(times, dtype=np.float64)
    return SwayRecord(tuple(numbers), seconds, tuple(motions), width)
