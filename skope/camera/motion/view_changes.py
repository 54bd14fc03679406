"""Detect changes of view in footage: a cut to a different camera, or a camera that was turned or knocked.

Small images of the footage, half a second apart, are compared with the first image of a view by their edges, because
edges change less than light. A view that has changed and stays changed is a new view. If the old view
returns, it was only hidden or shaken.
"""

import base64
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np

from skope.camera.motion.image_shift import SHIFT_LIMITS, coarse_shift, edges, small_grey
from skope.camera.motion.view_registration import ViewHomography
from skope.schema import Image
from skope.types import Array, Pixels


@dataclass(frozen=True)
class ViewChangeLimits:
    """Settings for sampling footage for changes of view."""

    interval_s: float = 0.5
    """Time between compared frames, seconds."""
    jpeg_quality: int = 80
    """Quality of the kept frames."""
    lasting_frames: int = 4
    """Number of compared frames that a change must last to be a new view."""


VIEW_CHANGES: Final = ViewChangeLimits()


@dataclass(frozen=True)
class ViewChange:
    """Change of footage to a new view."""

    time_s: float
    cut: bool
    """True if nothing of the previous view is visible (a cut); False if the camera was turned."""
    shift: float
    """Displacement of the view, as a share of the image's width; 0 for a cut."""
    settled_s: float | None = None
    """Time from which the camera is at rest in the new view, if `from_first` is known, seconds."""
    from_first: ViewHomography | None = None
    """Homography from the first view to this one; None: not reliably known."""

    def to_dict(self) -> dict[str, Any]:
        """Return the change as in the `info` of frames: pixels to 0.0001."""
        row: dict[str, Any] = {"time_s": self.time_s, "cut": self.cut, "shift": self.shift}
        if self.from_first is None:
            return row
        return row | {
            "settled_s": self.settled_s,
            "homography": self.from_first.matrix.tolist(),
            "residual_px": round(self.from_first.residual_px, 4),
            "corner_error_px": round(self.from_first.corner_error_px, 4),
        }

    def __str__(self) -> str:
        change = "cuts to another view" if self.cut else f"moves by {self.shift:.1%} of its width"
        return f"the view {change} at {self.time_s:.1f} s{self._followed}"

    @property
    def _followed(self) -> str:
        """Text that states whether the view is registered; the end of a sentence."""
        if self.from_first is None or self.settled_s is None:
            return "; the position of the first view in it is not reliably known"
        return (
            f"; it is followed from {self.settled_s:.1f} s on ({self.from_first.residual_px:.2f} px root mean square, "
            f"{self.from_first.corner_error_px:.2f} px at the corners)"
        )


class ViewSamples:
    """Sampler of small images of footage, one every half second."""

    def __init__(self, last_s: float | None = None) -> None:
        """Begin sampling. `last_s` is the time of the last sampled image of a run that is resumed."""
        self.taken: dict[int, str] = {}
        """Small images by frame number."""
        self._last_s = last_s

    def watch(self, frames: Iterable[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """Yield the frames unchanged."""
        for image, pixels in frames:
            if image.time_s is not None and (
                self._last_s is None or image.time_s - self._last_s >= VIEW_CHANGES.interval_s - 1e-6
            ):
                self._last_s = image.time_s
                self.taken[image.id] = _packed(pixels)
            yield image, pixels


def changes(looks: Sequence[tuple[float, str]], stays: Callable[[float], bool] = lambda _: True) -> list[ViewChange]:
    """Return the permanent changes of view between small images, which are in order of time (seconds).

    Args:
        looks: Times (seconds) and small images, packed by `ViewSamples`.
        stays: Function that returns whether a change of view at a time, seconds, is permanent. If it is not, the camera
            shakes.
    """
    out: list[ViewChange] = []
    reference: Array | None = None
    pending: list[tuple[float, Array, float | None]] = []
    for time_s, packed in looks:
        shown = edges(unpacked_look(packed))
        if shown is None:
            continue
        if reference is None:
            reference = shown
            continue
        moved = _moved(reference, shown)
        if moved is not None and moved <= SHIFT_LIMITS.moved_share:
            pending = []
            continue
        # Pending images count as one change only while they show one view.
        if pending and not _shows(pending[0][1], shown):
            pending = []
        pending.append((time_s, shown, moved))
        if len(pending) >= VIEW_CHANGES.lasting_frames:
            began_s, shown, shift = pending[0]
            pending = []
            if shift is not None and not stays(began_s):
                continue
            reference = shown
            out.append(ViewChange(began_s, cut=shift is None, shift=shift or 0.0))
    return out


def change_since(before: str, looks: Sequence[tuple[float, str]]) -> list[ViewChange]:
    """Return the change of view between an earlier small image and the beginning of footage; empty for none.

    Args:
        before: Small image of the view before the footage.
        looks: Times (seconds) and small images of the footage. With fewer than `VIEW_CHANGES.lasting_frames`, no change
            is found.
    """
    if not looks:
        return []
    begin_s = looks[0][0]
    first = looks[: 2 * VIEW_CHANGES.lasting_frames]
    return [
        replace(change, time_s=begin_s) for change in changes([(begin_s - VIEW_CHANGES.interval_s, before), *first])
    ]


def _shows(first: Array, second: Array) -> bool:
    moved = _moved(first, second)
    return moved is not None and moved <= SHIFT_LIMITS.moved_share


def _packed(pixels: Pixels) -> str:
    _, encoded = cv2.imencode(".jpg", small_grey(pixels), [cv2.IMWRITE_JPEG_QUALITY, VIEW_CHANGES.jpeg_quality])
    return base64.b64encode(encoded.tobytes()).decode()


def unpacked_look(packed: str) -> Pixels:
    """Return the small grey image (H, W) that `ViewSamples` has packed as text."""
    small: Any = cv2.imdecode(np.frombuffer(base64.b64decode(packed), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(small, dtype=np.uint8)


def _moved(first: Array, second: Array) -> float | None:
    """Return the displacement of a view, as a share of the image's width; None if the two show different views."""
    shift = coarse_shift(first, second)
    return None if shift is None else float(np.hypot(*shift))
