"""Find road users in the frames between key frames: the detector runs on key frames only, points on them are tracked.

Points on the vehicles of a key frame are tracked through the frames up to the next one (Lucas and Kanade's method in
pyramids; Bouguet, 2000), and back from that one. A vehicle in both key frames has a mean of both positions, in which
the nearer key frame has more weight. A vehicle in only one of them is followed from there alone, as far as its points
can be tracked, because detectors miss vehicles more often than vehicles vanish. All results of one vehicle have one
`track_id`.

Pedestrians and two-wheelers are followed by the points in the middle of their boxes, where their bodies are. Limbs and
narrow bodies are tracked less reliably than sheet metal. If tracking fails, a road user is interpolated linearly
between two key frames that both show it at about the same position.
"""

import itertools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeAlias

import cv2
import numpy as np

from skope import boxes as box_math
from skope.schema import AnyResult, Image, Result
from skope.tracking.box_links import cheapest_pairs
from skope.types import Array, Floats32, Pixels

ImageWithPixels = tuple[Image, Pixels]


@dataclass(frozen=True)
class KeyFrameLimits:
    """Settings of key frames, and limits for following vehicles between them."""

    interval_s: float = 0.5
    """Time between key frames, seconds."""
    window_px: tuple[int, int] = (15, 15)
    """Sides of the window that is tracked around a point, pixels."""
    pyramid_levels: int = 4
    """Number of levels of the image pyramid."""
    round_trip_px: float = 0.5
    """Maximum distance of a point from its start after it was tracked to the next frame and back, pixels."""
    grid_shares: tuple[float, float, float, float] = (0.2, 0.4, 0.6, 0.8)
    """Grid of points that are tracked in addition to keypoints, as shares of the box's edges."""
    body_shares: tuple[float, float, float] = (0.35, 0.5, 0.65)
    """Shares of the width for pedestrians and two-wheelers. Beside them the road is visible."""
    fewest_points: int = 4
    """Minimum number of tracked points of a vehicle."""
    deviation_share: float = 0.02
    """Maximum deviation of a point from its vehicle's motion, as a share of the vehicle's size; at least a pixel."""
    growth: float = 1.25
    """Maximum factor by which a vehicle grows or shrinks from frame to frame."""
    same_iou: float = 0.3
    """Minimum IoU of a vehicle tracked from one key frame with its detection in the next."""
    smallest_px: float = 4.0
    """Minimum shorter edge of a box inside the image, pixels; smaller ones are dropped."""


KEY_FRAME_LIMITS: Final = KeyFrameLimits()


_NO_POINTS: Final = np.zeros((0, 2), dtype=np.float32)


def with_frames_between(
    frames: Iterator[ImageWithPixels],
    find: Callable[[Iterator[ImageWithPixels]], Iterator[tuple[Image, list[AnyResult]]]],
    every: int,
    known: Sequence[int] = (),
) -> Iterator[tuple[Image, list[AnyResult], bool]]:
    """Yield the road users of all frames of a video; the detector runs on each `every`-th frame and the last.

    Args:
        frames: Consecutive frames. The first is a key frame.
        find: Finds the road users of the key frames, in order. It may take a few key frames ahead.
        every: Number of frames from one key frame to the next.
        known: The `track_id` of each road user of the first frame, if it was processed before.

    Yields:
        Each image with its road users, and whether it is a key frame. Those of other frames are `interpolated`.
    """
    taken: deque[_Frame] = deque()
    since: list[_Frame] = []
    vehicles: list[AnyResult] = []
    names = itertools.count(1)
    for image, found in find(_key_frames(frames, every, taken)):
        first, since = not since, since[-1:]
        while not since or since[-1].image.id != image.id:
            since.append(taken.popleft())
        if first:
            if len(known) != len(found):
                known = [next(names) for _ in found]
            names = itertools.count(max([0, *known]) + 1)
            vehicles = [replace(vehicle, track_id=name) for vehicle, name in zip(found, known, strict=True)]
        else:
            between, vehicles = _between(since, vehicles, found, names)
            yield from between
        yield image, vehicles, True


@dataclass(frozen=True)
class _Frame:
    """Frame in which points are tracked."""

    image: Image
    grey: Pixels
    """(H, W) uint8."""

    @classmethod
    def of(cls, frame: ImageWithPixels) -> "_Frame":
        image, pixels = frame
        return cls(image, np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), dtype=np.uint8))


def _key_frames(frames: Iterator[ImageWithPixels], every: int, taken: deque[_Frame]) -> Iterator[ImageWithPixels]:
    """Yield each `every`-th frame and the last; add all frames to `taken`."""
    waiting: ImageWithPixels | None = None
    for number, frame in enumerate(frames):
        taken.append(_Frame.of(frame))
        waiting = None if number % every == 0 else frame
        if waiting is None:
            yield frame
    if waiting is not None:
        yield waiting


def _between(
    frames: Sequence[_Frame], first: Sequence[AnyResult], last: Sequence[AnyResult], names: Iterator[int]
) -> tuple[list[tuple[Image, list[AnyResult], bool]], list[AnyResult]]:
    """Return the frames between two key frames, the ends of `frames`, with vehicles; and the vehicles of the last."""
    grey = [frame.grey for frame in frames]
    ahead, back = _followed(grey, first), _followed(grey[::-1], last)
    pairs = _same(first, ahead, last)
    gone = sorted(set(range(len(first))) - {i for i, _ in pairs})
    before = {j: first[i].track_id for i, j in pairs}
    last = [replace(vehicle, track_id=before[j] if j in before else next(names)) for j, vehicle in enumerate(last)]
    ways = [
        *((_merged(ahead[i], back[j][::-1]), first[i], last[j]) for i, j in pairs),
        *((ahead[i], first[i], first[i]) for i in gone),
        *((back[j][::-1], last[j], last[j]) for j in range(len(last)) if j not in before),
    ]
    out = []
    for k, frame in enumerate(frames[1:-1], start=1):
        share = k / (len(frames) - 1)
        shown = [
            position.result(frame.image, end, (1 - share) * start.score + share * end.score)
            for way, start, end in ways
            if (position := way[k]) is not None
        ]
        out.append((frame.image, [result for result in shown if result is not None], False))
    return out, last


@dataclass(frozen=True)
class _Place:
    """Position of a vehicle in a frame."""

    box: Array
    """(4,) x0, y0, x1, y1, pixels."""
    keypoints: Array
    """(33, 3) keypoints: x, y (pixels) and score; (0, 3) if there are none."""

    @classmethod
    def of(cls, result: AnyResult) -> "_Place":
        return cls(box_math.xywh_to_xyxy(result.bbox[None])[0], _keypoints(result))

    def blended(self, other: "_Place", share: float) -> "_Place":
        """Interpolate between two positions, with a share of the second one."""
        box = (1 - share) * self.box + share * other.box
        return _Place(box, (1 - share) * self.keypoints + share * other.keypoints)

    def moved(self, motion: Array) -> "_Place | None":
        """Apply a (2, 3) rotation, scale and shift; None if the vehicle grows more than vehicles do."""
        scale = float(np.hypot(motion[0, 0], motion[1, 0]))
        if not 1 / KEY_FRAME_LIMITS.growth < scale < KEY_FRAME_LIMITS.growth:
            return None
        corners = self.box.reshape(2, 2)
        middle = corners.mean(axis=0)
        box = (corners - middle) * scale + motion[:, :2] @ middle + motion[:, 2]
        at = self.keypoints[:, :2] @ motion[:, :2].T + motion[:, 2]
        return _Place(box.ravel(), np.column_stack([at, self.keypoints[:, 2]]))

    def result(self, image: Image, like: AnyResult, score: float) -> AnyResult | None:
        """Return `like` at this position of an image, with another score; None if hardly any of it is inside."""
        box = np.clip(self.box, 0.0, [image.width, image.height] * 2)
        if (box[2:] - box[:2]).min() < KEY_FRAME_LIMITS.smallest_px:
            return None
        bbox = box_math.xyxy_to_xywh(box[None])[0]
        placed = replace(like, image_id=image.id, bbox=bbox, score=score, interpolated=True)
        return replace(placed, keypoints=self.keypoints) if isinstance(placed, Result) else placed


def _keypoints(result: AnyResult) -> Array:
    return result.keypoints if isinstance(result, Result) else np.zeros((0, 3))


Way: TypeAlias = list[_Place | None]
"""Positions of a vehicle, one per frame; None if it is lost."""


def _followed(grey: Sequence[Pixels], vehicles: Sequence[AnyResult]) -> list[Way]:
    """Follow the vehicles of the first frame through all frames."""
    ways: list[Way] = [[_Place.of(vehicle)] for vehicle in vehicles]
    points = [_points(vehicle) for vehicle in vehicles]
    for before, after in itertools.pairwise(grey):
        moved = _flow(before, after, np.concatenate([*points, _NO_POINTS]))
        begin = 0
        for i, old in enumerate(points):
            new = moved[begin : begin + len(old)]
            begin += len(old)
            tracked = ~np.isnan(new[:, 0])
            position = _step(ways[i][-1], old[tracked], new[tracked])
            ways[i].append(position)
            points[i] = _NO_POINTS if position is None else new[tracked]
    return ways


def _points(vehicle: AnyResult) -> Floats32:
    """Return (P, 2) points of a vehicle to track: its keypoints inside the box, and a grid."""
    at = _keypoints(vehicle)[:, :2]
    low, high = vehicle.bbox[:2], vehicle.bbox[:2] + vehicle.bbox[2:]
    inside = ((at > low) & (at < high)).all(axis=1)
    across = KEY_FRAME_LIMITS.grid_shares if isinstance(vehicle, Result) else KEY_FRAME_LIMITS.body_shares
    grid = low + np.stack(np.meshgrid(across, KEY_FRAME_LIMITS.grid_shares), axis=-1).reshape(-1, 2) * vehicle.bbox[2:]
    return np.concatenate([at[inside], grid]).astype(np.float32)


def _flow(before: Pixels, after: Pixels, points: Floats32) -> Floats32:
    """Return (P, 2) positions of points in the next frame; NaN if they cannot be tracked there and back."""
    if not len(points):
        return points
    follow: Any = cv2.calcOpticalFlowPyrLK  # its type hints require an output array
    ahead, found, _ = follow(
        before,
        after,
        points[:, None],
        None,
        winSize=KEY_FRAME_LIMITS.window_px,
        maxLevel=KEY_FRAME_LIMITS.pyramid_levels,
    )
    again, found_again, _ = follow(
        after, before, ahead, None, winSize=KEY_FRAME_LIMITS.window_px, maxLevel=KEY_FRAME_LIMITS.pyramid_levels
    )
    away = np.linalg.norm(again[:, 0] - points, axis=1)
    good = (found[:, 0] > 0) & (found_again[:, 0] > 0) & (away < KEY_FRAME_LIMITS.round_trip_px)
    return np.where(good[:, None], ahead[:, 0], np.float32(np.nan))


def _step(position: _Place | None, old: Floats32, new: Floats32) -> _Place | None:
    """Move a vehicle as most of its points move; None if they are too few."""
    if position is None or len(old) < KEY_FRAME_LIMITS.fewest_points:
        return None
    aside = max(1.0, KEY_FRAME_LIMITS.deviation_share * float(np.ptp(old, axis=0).max()))
    motion: Any
    motion, agreeing = cv2.estimateAffinePartial2D(old, new, method=cv2.RANSAC, ransacReprojThreshold=aside)
    return position.moved(motion) if motion is not None and agreeing.sum() >= KEY_FRAME_LIMITS.fewest_points else None


def _same(first: Sequence[AnyResult], ahead: Sequence[Way], last: Sequence[AnyResult]) -> list[tuple[int, int]]:
    """Return pairs of road users of the first key frame, as far as they were followed, and of the same category in the
    last one."""
    out: list[tuple[int, int]] = []
    for category in sorted({result.category_id for result in last}):
        before = [i for i, result in enumerate(first) if result.category_id == category]
        after = [j for j, result in enumerate(last) if result.category_id == category]
        if not before:
            continue
        ends = np.array([[position for position in ahead[i] if position is not None][-1].box for i in before])
        last_boxes = box_math.xywh_to_xyxy(np.array([last[j].bbox for j in after]))
        out += [
            (before[i], after[j])
            for i, j in cheapest_pairs(1 - box_math.iou(ends, last_boxes), 1 - KEY_FRAME_LIMITS.same_iou)
        ]
    return out


def _merged(ahead: Way, back: Way) -> Way:
    """Merge the positions of a vehicle from both key frames, with linear interpolation where either lost it."""
    first, last = ahead[0], back[-1]
    assert first is not None
    assert last is not None
    shares = np.linspace(0, 1, len(ahead)).tolist()
    return [
        first.blended(last, share) if forward is None or backward is None else forward.blended(backward, share)
        for forward, backward, share in zip(ahead, back, shares, strict=True)
    ]
