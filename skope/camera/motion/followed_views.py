"""Register the views of a moved camera to the first view, and find when the camera is at rest in them.

The footage is read again around each change. The median of its frames shows a view without traffic.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.camera.motion.image_shift import SHIFT_LIMITS, ImageMotion, ReferencePicture, SmallPicture
from skope.camera.motion.view_changes import ViewChange
from skope.camera.motion.view_registration import ViewHomography, register, transformed
from skope.errors import UserError
from skope.pictures.median import median_of
from skope.types import Pixels
from skope.video.footage import Footage, FrameRange


@dataclass(frozen=True)
class FollowedViewLimits:
    """Images and times for registering the views of a moved camera."""

    image_s: float = 20.0
    """Maximum duration of a view's part from which its image is made, seconds."""
    image_frames: int = 25
    """Number of frames of that image."""
    margin_s: float = 1.0
    """Time around a change of view within which frames are left out, seconds. The camera may still be moving."""
    margin_share: float = 0.25
    """Maximum of this margin, as a share of the view's duration."""
    around_s: float = 3.0
    """Time before and after a change within which the movement is searched for, seconds."""
    older_views: int = 3
    """Number of earlier views that a new view is compared with, the latest first."""


FOLLOWED_VIEWS: Final = FollowedViewLimits()


@dataclass(frozen=True, eq=False)
class _Followed:
    """View with a known homography."""

    begin_s: float
    end_s: float
    from_first: ViewHomography


def with_homographies(footage: Footage, changes: Sequence[ViewChange], end_s: float) -> list[ViewChange]:
    """Return the changes of a video's view, with reliable homographies from the first view.

    Args:
        footage: The video. A live stream cannot be read again: its changes stay as they are.
        changes: The changes, in order of time.
        end_s: Time of the last frame, seconds.
    """
    if footage.live:
        return list(changes)
    first_s = footage.cut.start_s
    groups = _groups(changes)
    ends = [*(group[0].time_s for group in groups[1:]), end_s]
    followed = [_Followed(first_s, groups[0][0].time_s if groups else end_s, ViewHomography(np.eye(3), 0.0, 0.0))]
    out, before_s = list[ViewChange](), first_s
    for group, stop_s in zip(groups, ends, strict=True):
        try:
            found = _follow(footage, group, stop_s, followed, before_s)
        except UserError:  # the footage is no longer available
            found = None
        if found is not None and found.settled_s is not None and found.from_first is not None:
            followed.append(_Followed(found.settled_s, stop_s, found.from_first))
        out += group if found is None else [found]
        before_s = out[-1].settled_s or out[-1].time_s
    return out


def _groups(changes: Sequence[ViewChange]) -> list[list[ViewChange]]:
    """Group changes that follow one another immediately: a camera that is moved step by step."""
    out = list[list[ViewChange]]()
    for change in changes:
        if out and change.time_s - out[-1][-1].time_s < FOLLOWED_VIEWS.around_s:
            out[-1].append(change)
        else:
            out.append([change])
    return out


def _follow(
    footage: Footage, group: Sequence[ViewChange], stop_s: float, followed: Sequence[_Followed], before_s: float
) -> ViewChange | None:
    """Return one change for a group, with its homography from the first view; None if it is not reliable.

    Args:
        footage: The video.
        group: Changes that follow one another immediately.
        stop_s: Time of the next change, or of the last frame, seconds.
        followed: The earlier views with a known homography.
        before_s: Time at which the view before the changes begins, seconds.
    """
    first, last = group[0], group[-1]
    new = _picture(footage, last.time_s, stop_s, late=False)
    for view in reversed(followed[-FOLLOWED_VIEWS.older_views :]):
        old = _picture(footage, view.begin_s, view.end_s, late=True)
        found = None if old is None or new is None else register(old, new)
        if old is None or new is None or found is None:
            continue
        low_s, high_s = (
            max(before_s, first.time_s - FOLLOWED_VIEWS.around_s),
            min(stop_s, last.time_s + FOLLOWED_VIEWS.around_s),
        )
        left_s, settled_s = _movement(_part(footage, low_s, high_s), last.time_s, old, new)
        middle = np.array([new.shape[1], new.shape[0]]) / 2
        shift = float(np.linalg.norm(transformed(found.matrix, middle) - middle)) / new.shape[1]
        return ViewChange(
            left_s,
            cut=False,
            shift=first.shift if len(group) == 1 and not first.cut else shift,
            settled_s=settled_s,
            from_first=view.from_first.then(found),
        )
    return None


def _picture(footage: Footage, begin_s: float, end_s: float, *, late: bool) -> Pixels | None:
    """Return (H, W, 3) a view without traffic, from its first seconds or, if `late`, its last; None without frames."""
    margin = min(FOLLOWED_VIEWS.margin_s, FOLLOWED_VIEWS.margin_share * (end_s - begin_s))
    low, high = begin_s + margin, end_s - margin
    low, high = (
        (max(low, high - FOLLOWED_VIEWS.image_s), high) if late else (low, min(high, low + FOLLOWED_VIEWS.image_s))
    )
    if not low < high:
        return None
    part = _part(footage, low, high)
    part.cut = replace(part.cut, every=max(1, len(part) // FOLLOWED_VIEWS.image_frames))
    frames = [pixels for _, pixels in part.frames()]
    same = [pixels for pixels in frames if pixels.shape == frames[0].shape]
    return median_of(same) if same else None


def _part(footage: Footage, begin_s: float, end_s: float) -> Footage:
    """Return the frames of footage between two times, read independently of it."""
    return replace(footage, cut=FrameRange(start_s=max(0.0, begin_s), end_s=end_s), skipped=[])


def _movement(footage: Footage, time_s: float, old: Pixels, new: Pixels) -> tuple[float, float]:
    """Return the time of the first frame after the camera left a view, and of its first frame at rest in the next.

    Args:
        footage: The frames around the change.
        time_s: Approximate time of the change, seconds.
        old: (H, W, 3) the first view.
        new: (H, W, 3) the second view.
    """
    references = [ReferencePicture(SmallPicture.of(pixels)) for pixels in (old, new)]
    times, in_old, in_new = list[float](), list[bool | None](), list[bool | None]()
    for image, pixels in footage.frames():
        picture = SmallPicture.of(pixels)
        if picture.size == references[0].size and image.time_s is not None:
            from_old, from_new = (_distance(reference.motion(picture), picture.size[0]) for reference in references)
            times.append(image.time_s)
            in_old.append(_is_at_rest(from_old, from_new))
            in_new.append(_is_at_rest(from_new, from_old))
    left = max((k for k, at_rest in enumerate(in_old) if at_rest), default=-1) + 1
    first = next((k for k in range(left, len(times)) if in_new[k]), None)
    if first is None:
        return time_s, times[-1] if times else time_s
    # A frame at another position shows a camera that still swings. An unmeasured frame may be hidden by traffic.
    elsewhere = max((k for k in range(first, len(times)) if in_new[k] is False), default=first - 1)
    settled = next((k for k in range(elsewhere + 1, len(times)) if in_new[k]), len(times) - 1)
    return times[left], times[settled]


def _distance(motion: ImageMotion | None, width: int) -> float | None:
    """Return the distance of a frame from a view, as a share of the image's width; None: unknown."""
    if motion is None:
        return None
    return float(np.hypot(motion.x, motion.y)) / width + max(abs(motion.turn), abs(motion.growth)) / 2


def _is_at_rest(distance: float | None, other_view_distance: float | None) -> bool | None:
    """Return whether a frame is at rest in a view, from its distances to this and to another view; None: unknown."""
    if distance is None:
        return None
    return distance <= SHIFT_LIMITS.moved_share and (other_view_distance is None or distance <= other_view_distance)
