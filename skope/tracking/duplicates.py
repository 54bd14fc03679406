"""One road user, one track: of two boxes in one picture, or two tracks in one place, only one is kept.

Detectors find many a vehicle twice, as its front and as its whole, and a rider as a bicycle, as a motorcycle and as a
pedestrian.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope import boxes
from skope.tracking.tracker_inputs import PoseMeasurement
from skope.tracking.tracks import OpenTrack
from skope.types import Array


@dataclass(frozen=True)
class DuplicateLimits:
    """Limits from which two detections or tracks are one road user."""

    inside_share: float = 0.6
    """Share of the smaller box inside the larger one from which both may be one road user."""
    foot_sizes: float = 0.35
    """Largest distance between the feet of both, in sizes of the larger box: its width, or half its height."""
    duplicate_s: float = 0.5
    """Two tracks at one position for this long are one vehicle, seconds."""
    shadowing_m: float = 2.0
    """A duplicate within this median distance of the kept track is dropped from its start, metres."""


DUPLICATE_LIMITS: Final = DuplicateLimits()


def inside_and_apart(one: Array, other: Array) -> tuple[Array, Array]:
    """Share of the smaller of two boxes that lies in the other one, and their distance.

    Args:
        one: (N, 4) boxes: x, y, width, height, pixels.
        other: (N, 4) the others.

    Returns:
        (N,) shares from 0 to 1, and (N,) distances of the lower edges' middles in sizes of the larger box.
    """
    first, second = boxes.xywh_to_xyxy(one), boxes.xywh_to_xyxy(other)
    inside = np.maximum(boxes.share_inside_each(first, second), boxes.share_inside_each(second, first))
    size = np.maximum(one[:, 2:], other[:, 2:]) * [1.0, 0.5]
    apart = np.linalg.norm(feet(one) - feet(other), axis=1) / size.max(axis=1)
    return inside, apart


def feet(rectangles: Array) -> Array:
    """(N, 2) the middles of the lower edges of boxes (N, 4): x, y, width, height."""
    return np.asarray(rectangles[:, :2] + rectangles[:, 2:] * [0.5, 1.0])


def encloses(track: OpenTrack, place: Array, covariance: Array) -> bool:
    """Whether a place is inside a track's vehicle, give or take a standard deviation.

    Args:
        track: The track, with a pose.
        place: (2,) world, metres.
        covariance: (2, 2) of the place, square metres; that of the track's own place is added.
    """
    mean, spread = track.state
    return inside_vehicle(track.last_pose, place - mean[:2], covariance + spread[:2, :2])


def inside_vehicle(vehicle: PoseMeasurement, away: Array, covariance: Array) -> bool:
    """Whether a place is inside a vehicle, give or take a standard deviation.

    Far away a standard deviation is more than the way to the next vehicle in a queue or a car park: at most half a
    width is given to the sides, and a quarter of the length ahead.

    Args:
        vehicle: Its heading and size.
        away: (2,) world x and y from the vehicle's middle, metres.
        covariance: (2, 2) of `away`, square metres.
    """
    x, y = away.tolist()
    (a, b), (_, d) = covariance.tolist()
    length, width, _ = vehicle.size_lwh.tolist()
    cos, sin = math.cos(vehicle.heading), math.sin(vehicle.heading)
    along = math.sqrt(a * cos * cos + 2 * b * cos * sin + d * sin * sin)
    across = math.sqrt(a * sin * sin - 2 * b * cos * sin + d * cos * cos)
    ahead, aside = abs(x * cos + y * sin), abs(y * cos - x * sin)
    return bool(ahead <= length / 2 + min(along, length / 4) and aside <= width / 2 + min(across, width / 2))


def give_up_duplicates(live: Sequence[OpenTrack], time_s: float) -> list[OpenTrack]:
    """The tracks that have been inside another one for so long that both are one vehicle.

    The one with more poses is kept. What was seen of the other since it is inside goes over to the kept track; the
    other then ends before that.
    """
    kept_tracks: list[OpenTrack] = []
    duplicates: list[OpenTrack] = []
    for track in sorted(live, key=lambda one: -one.poses):
        mean, spread = track.state
        around = next((one for one in kept_tracks if encloses(one, mean[:2], spread[:2, :2])), None)
        if around is None or around is not track.surrounding:
            track.surrounding, track.surrounded_s = around, time_s
        if around is None or time_s - track.surrounded_s < DUPLICATE_LIMITS.duplicate_s:
            kept_tracks.append(track)
        else:
            _hand_over(track, around)
            duplicates.append(track)
    return duplicates


def _hand_over(duplicate: OpenTrack, kept: OpenTrack) -> None:
    """Give what was seen of `duplicate` since it is inside `kept` to that track, where it was not seen itself."""
    kept_steps = {step.frame: step for step in kept.steps}
    before = [step for step in duplicate.steps if step.time_s < duplicate.surrounded_s]
    apart = [
        float(np.linalg.norm(step.filtered[0][:2] - kept_steps[step.frame].filtered[0][:2]))
        if step.frame in kept_steps
        else math.inf
        for step in before
        if step.detection is not None
    ]
    if not duplicate.parts and float(np.median(apart or [0.0])) < DUPLICATE_LIMITS.shadowing_m:
        before = []
    for step in duplicate.steps[len(before) :]:
        if step.detection is None:
            continue
        if step.detection.pose is not None:
            duplicate.kinds[step.detection.pose.kind] -= 1
        if (same := kept_steps.get(step.frame)) is not None and same.detection is None:
            same.detection = replace(step.detection, pose=None)
    duplicate.steps = before
    posed = [step.time_s for step in before if step.detection is not None and step.detection.pose is not None]
    duplicate.last_pose_s = posed[-1] if posed else -math.inf
