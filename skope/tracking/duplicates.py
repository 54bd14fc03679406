"""Remove duplicates of a road user: of two boxes in one image or two tracks at one position, keep one.

Detectors often find a vehicle twice, as its front and as a whole, and a rider as a bicycle, a motorcycle and a
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
    """Limits at which two detections or tracks are one road user."""

    inside_share: float = 0.6
    """Minimum share of the smaller box inside the larger one at which both may be one road user."""
    foot_sizes: float = 0.35
    """Maximum distance between the feet of both, in sizes of the larger box: its width, or half its height."""
    duplicate_s: float = 0.5
    """Time at one position after which two tracks are one vehicle, seconds."""
    shadowing_m: float = 2.0
    """Maximum median distance to the kept track at which a duplicate is dropped from its start, metres."""


DUPLICATE_LIMITS: Final = DuplicateLimits()


def inside_and_apart(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the share of the smaller of two boxes inside the larger one, and the distance of both.

    Args:
        first: (N, 4) first boxes: x, y, width, height, pixels.
        second: (N, 4) second boxes.

    Returns:
        (N,) shares from 0 to 1, and (N,) distances of the lower edges' middles in sizes of the larger box.
    """
    first_corners, second_corners = boxes.xywh_to_xyxy(first), boxes.xywh_to_xyxy(second)
    inside = np.maximum(
        boxes.share_inside_each(first_corners, second_corners), boxes.share_inside_each(second_corners, first_corners)
    )
    size = np.maximum(first[:, 2:], second[:, 2:]) * [1.0, 0.5]
    apart = np.linalg.norm(feet(first) - feet(second), axis=1) / size.max(axis=1)
    return inside, apart


def feet(rectangles: Array) -> Array:
    """Return (N, 2) the middles of the lower edges of boxes (N, 4): x, y, width, height."""
    return np.asarray(rectangles[:, :2] + rectangles[:, 2:] * [0.5, 1.0])


def encloses(track: OpenTrack, position: Array, covariance: Array) -> bool:
    """Return whether a position is inside a track's vehicle, within one standard deviation.

    Args:
        track: The track, with a pose.
        position: (2,) world, metres.
        covariance: (2, 2) covariance of `position`, square metres; that of the track's own position is added.
    """
    mean, spread = track.state
    return inside_vehicle(track.last_pose, position - mean[:2], covariance + spread[:2, :2])


def inside_vehicle(vehicle: PoseMeasurement, away: Array, covariance: Array) -> bool:
    """Return whether a position is inside a vehicle, within one standard deviation.

    Far from the camera, a standard deviation can exceed the gap to the next vehicle in a queue or a car park. The
    margin is therefore limited to half a width at the sides and a quarter of the length ahead and behind.

    Args:
        vehicle: Its heading and size.
        away: (2,) world x and y from the vehicle's middle, metres.
        covariance: (2, 2) covariance of `away`, square metres.
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
    """Return the tracks that have been inside another track long enough to be duplicates.

    The track with more poses is kept. It takes over the detections that the duplicate has had since it is inside. The
    duplicate ends before them.
    """
    kept_tracks: list[OpenTrack] = []
    duplicates: list[OpenTrack] = []
    for track in sorted(live, key=lambda open_track: -open_track.poses):
        mean, spread = track.state
        around = next((kept for kept in kept_tracks if encloses(kept, mean[:2], spread[:2, :2])), None)
        if around is None or around is not track.surrounding:
            track.surrounding, track.surrounded_s = around, time_s
        if around is None or time_s - track.surrounded_s < DUPLICATE_LIMITS.duplicate_s:
            kept_tracks.append(track)
        else:
            _hand_over(track, around)
            duplicates.append(track)
    return duplicates


def _hand_over(duplicate: OpenTrack, kept: OpenTrack) -> None:
    """Move the detections of `duplicate` since it entered `kept` to `kept`, in frames in which `kept` has none."""
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
