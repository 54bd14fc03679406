"""Where footage shows another view: a cut to another camera, or a camera that was turned or knocked.

Small pictures of the footage, half a second apart, are held against the first one of a view: their edges, as light
changes and edges of the background stay. A view that has changed and stays so is a new one; one that comes back was
hidden or shaken meanwhile.
"""

import base64
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.schema import Image
from skope.types import Array

Pixels = NDArray[np.uint8]

EVERY_S: Final = 0.5
"""Looks are so far apart, seconds."""
_WIDTH: Final = 160
"""Of the pictures, pixels."""
_QUALITY: Final = 80
_BLOCKS: Final = (6, 10)
"""Rows and columns of blocks in which pictures are compared: traffic hides some of them, not all."""
_BLOCK: Final = 0.6
"""Correlation of edges from which two blocks show the same."""
_BARE: Final = 0.3
"""Deviation of edges, in that of the whole picture, under which a block shows nothing."""
_SAME: Final = 0.2
"""Share of the blocks that show the same from which two pictures show one view."""
_SHIFT: Final = 0.006
"""A view has moved by more than this share of the image's width, or has not."""
_LASTS: Final = 4
"""Looks that a change has to last to be a new view."""
_AS_WELL: Final = 0.9
"""A view that fits as well where it was, but for this factor, has not moved."""
_STRONG: Final = 0.03
"""Strength of edges, as a share of white, under which a picture is too even to tell."""


@dataclass(frozen=True)
class ViewChange:
    """A time from which footage shows another view."""

    time_s: float
    cut: bool
    """Whether nothing of the view before is seen; else the camera was turned."""
    shift: float
    """How far the view has moved, as a share of the image's width; 0 for a cut."""

    def __str__(self) -> str:
        what = "cuts to another view" if self.cut else f"moves by {self.shift:.1%} of its width"
        return f"the view {what} at {self.time_s:.1f} s"


class Looks:
    """Takes a small picture of footage every half a second."""

    def __init__(self) -> None:
        self.taken: dict[int, str] = {}
        """By the number of the frame."""
        self._last_s: float | None = None

    def watch(self, frames: Iterable[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """The frames as they come."""
        for image, pixels in frames:
            if image.time_s is not None and (self._last_s is None or image.time_s - self._last_s >= EVERY_S - 1e-6):
                self._last_s = image.time_s
                self.taken[image.id] = _packed(pixels)
            yield image, pixels


def changes(looks: Sequence[tuple[float, str]]) -> list[ViewChange]:
    """When the view changes for good, of looks with their times in seconds, which rise."""
    out: list[ViewChange] = []
    reference: Array | None = None
    pending: list[tuple[float, Array, float | None]] = []
    for time_s, packed in looks:
        edges = _edges(packed)
        if edges is None:
            continue
        if reference is None:
            reference = edges
            continue
        moved = _moved(reference, edges)
        if moved is not None and moved <= _SHIFT:
            pending = []
            continue
        # What is pending counts as one change only while it shows one view.
        if pending and not _shows(pending[0][1], edges):
            pending = []
        pending.append((time_s, edges, moved))
        if len(pending) >= _LASTS:
            began_s, reference, shift = pending[0]
            out.append(ViewChange(began_s, cut=shift is None, shift=shift or 0.0))
            pending = []
    return out


def _shows(one: Array, other: Array) -> bool:
    moved = _moved(one, other)
    return moved is not None and moved <= _SHIFT


def _packed(pixels: Pixels) -> str:
    height, width = pixels.shape[:2]
    size = (_WIDTH, max(1, round(_WIDTH * height / width)))
    small = cv2.resize(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return base64.b64encode(encoded.tobytes()).decode()


def _edges(packed: str) -> Array | None:
    """(H, W) strength of edges, of mean 0 and deviation 1; None where there are hardly any."""
    small: Any = cv2.imdecode(np.frombuffer(base64.b64decode(packed), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    grey = cv2.GaussianBlur(small.astype(np.float32) / 255, (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    if strength.mean() < _STRONG:
        return None
    root = np.sqrt(strength)  # lamps and white cars shall not decide
    return np.asarray((root - root.mean()) / root.std(), dtype=np.float64)


def _moved(one: Array, other: Array) -> float | None:
    """How far a view has moved, as a share of the image's width; None where the two show different views."""
    height, width = one.shape
    if one.shape != other.shape:
        return None
    window = np.outer(np.hanning(height), np.hanning(width))
    # OpenCV multiplies its inputs by the window in place.
    (x, y), _ = cv2.phaseCorrelate(one.copy(), other.copy(), window)
    back = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y]])
    aligned: Any = cv2.warpAffine(other, back, (width, height), flags=cv2.INTER_LINEAR)
    here, there = (_agreement(one, picture) for picture in (other, aligned))
    if max(here, there) < _SAME:
        return None
    return 0.0 if here >= _AS_WELL * there else float(np.hypot(x, y)) / width


def _agreement(one: Array, other: Array) -> float:
    """Share of the blocks of two pictures, of those that show something, in which their edges correlate."""
    rows, columns = (np.array_split(np.arange(size), parts) for size, parts in zip(one.shape, _BLOCKS, strict=True))
    good = []
    for block in itertools.product(rows, columns):
        a, b = one[np.ix_(*block)], other[np.ix_(*block)]
        a, b = a - a.mean(), b - b.mean()
        if a.std() < _BARE and b.std() < _BARE:
            continue
        good.append((a * b).mean() >= _BLOCK * max(a.std() * b.std(), 1e-9))
    return float(np.mean(good)) if good else 0.0
