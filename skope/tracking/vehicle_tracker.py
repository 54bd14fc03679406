"""Vehicles followed through a video on the ground: which detection belongs to which track.

Each vehicle is a point that moves with a slowly changing acceleration (`skope.tracking.kalman`). A detection joins
the track from which it more likely comes than from a vehicle that nobody has seen before (Jonker and Volgenant's
assignment, as scipy has it): what counts is how certain track and pose are and how much time has passed, not how many
frames. Before that, a detection whose box lies where one track's box was a moment ago, and no other one's, joins that
track if its pose allows it: along the line of sight poses are uncertain by metres, where boxes are by pixels. What
`skope eval predict` has followed from frame to frame (`Detection.link`) goes before both. For a
vehicle without a pose, or whose pose is elsewhere all of a sudden, the box keeps the track; where poses stay elsewhere,
it ends and another one begins, as nothing on wheels jumps. By its boxes a track also reaches back before its first pose
and goes on after its last one, for half a second: vehicles at the image's edge and between key frames have none.
Trackers of boxes alone would lose what the poses know: metres, headings and how certain they are.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from skope import boxes as box_math
from skope.tracking import kalman
from skope.tracking.box_links import cheapest_pairs
from skope.tracking.duplicates import encloses, give_up_duplicates, inside_vehicle
from skope.tracking.kalman import KALMAN_SETTINGS
from skope.tracking.tracker_inputs import Detection, PoseMeasurement
from skope.tracking.tracks import OpenTrack, Sighting, TrackStep, begin, finished
from skope.tracks.track import Track
from skope.types import Array


@dataclass(frozen=True)
class TrackerLimits:
    """Limits of the assignment of detections to tracks of vehicles."""

    pace_s: float = 0.3
    """Least time between two boxes that give a vehicle's speed in the image, seconds."""
    faster: float = 2.0
    """Largest factor of that speed since. Vehicles that come near grow faster in the image."""
    lateral_diagonals: float = 0.6
    """Largest lateral distance of a vehicle from its predicted path at once, in diagonals of its box."""
    lateral_growth: float = 0.7
    """Growth of that distance per second. The vehicle may have turned."""
    first_diagonals: tuple[float, float] = (1.0, 8.0)
    """The same two for a vehicle that was detected once: 8 lengths per second are 130 km/h."""
    new_vehicle_cost: float = 2 * math.log(20_000.0)
    """Cost of a new vehicle, twice a negative log likelihood: one in 20 000 m^2."""
    gate_slack_m: float = 0.5
    """Added to the standard deviation of each prediction when detections are assigned, metres."""
    swerve_mps2: float = 6.0
    """Acceleration with which a vehicle may have turned or braked since its last pose, m/s^2."""
    swerve_s: float = 1.0
    """Longest duration of that acceleration, seconds."""
    continuing_iou: float = 0.3
    """Least IoU by which a box without a pose continues a track."""
    jump_iou: float = 0.5
    """Least IoU by which a box continues a track though its pose is elsewhere."""
    fresh_s: float = 0.15
    """Time for which a box alone locates a vehicle in the image, seconds."""
    clear_ratio: float = 2.0
    """Two boxes are one vehicle's if their IoU is this many times the next best IoU of either."""
    most_jumps: int = 3
    """Number of poses elsewhere after which the vehicle is there."""
    lost_s: float = 3.0
    """A track ends when no pose of it was found for this long, seconds."""
    approach_s: float = 0.5
    """Time before a vehicle's first pose for which its boxes belong to its track, seconds."""
    lag_s: float = 20.0
    """Frames older than this are final, seconds."""


TRACKER_LIMITS: Final = TrackerLimits()


@dataclass(frozen=True, eq=False, slots=True)
class Whereabouts:
    """Region of an image for the middle of a track's box: near a line from where it was."""

    middle: tuple[float, float]
    """Its last place, pixels."""
    way: tuple[float, float]
    """Longest way that it may have gone on from there, pixels."""
    diagonal: float
    """Of the last box, pixels."""
    reach: float
    """Largest distance from the line, in diagonals."""

    def holds(self, detection: Detection) -> bool:
        """Whether a detection can be this vehicle."""
        (x, y), (ahead_x, ahead_y) = _middle(detection.bbox), self.way
        x, y = x - self.middle[0], y - self.middle[1]
        squared = ahead_x**2 + ahead_y**2
        share = min(1.0, max(0.0, (x * ahead_x + y * ahead_y) / squared)) if squared else 0.0
        away = math.hypot(x - share * ahead_x, y - share * ahead_y)
        return away <= self.reach * max(_diagonal(detection.bbox), self.diagonal)


def whereabouts(track: OpenTrack, time_s: float) -> Whereabouts | None:
    """Region for the vehicle of a track in the image of its latest frame, at `time_s`; None: anywhere."""
    last, older = _seen(track.steps)
    if last is None or last.detection is None:
        return None
    x, y = _middle(last.detection.bbox)
    gap, diagonal = time_s - last.time_s, _diagonal(last.detection.bbox)
    if older is None or older.detection is None:
        aside, later = TRACKER_LIMITS.first_diagonals
        return Whereabouts((x, y), (0.0, 0.0), diagonal, aside + later * gap)
    before_x, before_y = _middle(older.detection.bbox)
    times = TRACKER_LIMITS.faster * gap / (last.time_s - older.time_s)
    way = (times * (x - before_x), times * (y - before_y))
    return Whereabouts((x, y), way, diagonal, TRACKER_LIMITS.lateral_diagonals + TRACKER_LIMITS.lateral_growth * gap)


def _seen(steps: Sequence[TrackStep]) -> tuple[TrackStep | None, TrackStep | None]:
    """The last step before the latest that has a box, and an older one: the newest that tells a pace, or the first."""
    last = older = None
    for step in reversed(steps[:-1]):
        if step.detection is None:
            continue
        if last is None:
            last = step
            continue
        older = step
        if last.time_s - step.time_s >= TRACKER_LIMITS.pace_s:
            break
    return last, older


def _middle(bbox: Array) -> tuple[float, float]:
    x, y, width, height = bbox.tolist()
    return x + width / 2, y + height / 2


def _diagonal(bbox: Array) -> float:
    _, _, width, height = bbox.tolist()
    return math.hypot(width, height)


__all__ = ["Track", "follow"]

Posed = tuple[Detection, PoseMeasurement]
"""A detection that has a pose, and the pose."""


def follow(images: Iterable[Sequence[Detection]], times_s: Sequence[float]) -> list[Track]:
    """Follow the vehicles in consecutive images of one camera.

    Images are taken one at a time; memory grows by 150 bytes for each vehicle and image.

    Args:
        images: The detections of each image.
        times_s: Seconds of each image, rising.

    Returns:
        A track for each vehicle with enough poses (`skope.tracking.tracks.TRACK_LIMITS`), numbered from 1 by its first
        frame.

    Raises:
        ValueError: The times do not rise.
    """
    live: list[OpenTrack] = []
    done: list[OpenTrack] = []
    recent: deque[tuple[int, float, list[Detection]]] = deque()
    before = -math.inf
    for frame, (image, time_s) in enumerate(zip(images, times_s, strict=True)):
        if time_s <= before:
            raise ValueError("times must rise")
        if live:
            F, Q = kalman.motion(time_s - before)
            for track in live:
                track.predict(frame, time_s, F, Q)
        new, without_track = _associate(live, image, time_s)
        live += [track.successor for track in live if track.successor is not None]
        ended = {id(track) for track in live if track.successor or time_s - track.last_pose_s > TRACKER_LIMITS.lost_s}
        ended |= {id(track) for track in give_up_duplicates([t for t in live if id(t) not in ended], time_s)}
        for track in live:
            if id(track) in ended:
                track.end()
                done.append(track)
            elif time_s - track.steps[0].time_s > 2 * TRACKER_LIMITS.lag_s:
                track.settle(time_s - TRACKER_LIMITS.lag_s)
        live = [track for track in live if id(track) not in ended]
        live += [begin(frame, time_s, *pair, _approach(pair[0], recent)) for pair in new]
        recent.append((frame, time_s, without_track))
        while time_s - recent[0][1] > TRACKER_LIMITS.approach_s:
            recent.popleft()
        before = time_s
    for track in live:
        track.end()
    confirmed = [track for track in done + live if track.confirmed]
    confirmed.sort(key=lambda track: track.parts[0].frames[0])
    return [finished(track, number) for number, track in enumerate(confirmed, start=1)]


def _approach(detection: Detection, recent: deque[tuple[int, float, list[Detection]]]) -> list[Sighting]:
    """The boxes without a track by which a new vehicle came, from frame to frame; they are taken from `recent`."""
    out: list[Sighting] = []
    for frame, time_s, boxes in reversed(recent):
        if not boxes:
            break
        overlap = box_math.iou(
            box_math.xywh_to_xyxy(detection.bbox[None]), box_math.xywh_to_xyxy(np.array([one.bbox for one in boxes]))
        )[0]
        if overlap.max() < TRACKER_LIMITS.continuing_iou:
            break
        detection = boxes.pop(int(overlap.argmax()))
        out.append((frame, time_s, detection))
    return out


def _associate(live: list[OpenTrack], image: Sequence[Detection], time_s: float) -> tuple[list[Posed], list[Detection]]:
    """Give an image's detections to tracks, by clear boxes, by place, then by box.

    Returns:
        The detections of new vehicles, and those without a pose that belong to no track.
    """
    places = [whereabouts(track, time_s) for track in live]
    posed = [(detection, detection.pose) for detection in image if detection.pose is not None]
    left = dict(enumerate(posed))
    cost = np.array(
        [
            [_cost(track, pose) if place is None or place.holds(detection) else math.inf for detection, pose in posed]
            for track, place in zip(live, places, strict=True)
        ]
    ).reshape(len(live), len(posed))
    same, other = _by_link(live, [detection for detection, _ in posed])
    cost = np.where(other, np.inf, cost)
    for t, s in [*np.argwhere(same).tolist(), *_clear_pairs(live, posed, time_s)]:
        if np.isfinite(cost[t, s]):
            live[t].update(*posed[s])
            cost[t], cost[:, s] = np.inf, np.inf
            del left[s]
    for t, s in cheapest_pairs(cost, TRACKER_LIMITS.new_vehicle_cost):
        live[t].update(*posed[s])
        del left[s]
    unposed = [detection for detection in image if detection.pose is None]
    given_unposed = {id(detection) for detection in _by_box(live, unposed, TRACKER_LIMITS.continuing_iou, time_s)}
    for given in _by_box(live, [detection for detection, _ in left.values()], TRACKER_LIMITS.jump_iou, time_s):
        del left[next(s for s, (detection, _) in left.items() if detection is given)]
    new = _without_duplicates(live, list(left.values()))
    return new, [detection for detection in unposed if id(detection) not in given_unposed]


def _by_link(live: Sequence[OpenTrack], detections: Sequence[Detection]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(T, S) which tracks and detections are one vehicle's by their links, and which are not: another track is it."""
    of_track = np.array([-1 if track.link is None else track.link for track in live], dtype=np.int64)
    of_detection = np.array([-1 if one.link is None else one.link for one in detections], dtype=np.int64)
    same = (of_track[:, None] == of_detection) & (of_detection >= 0)
    return same, same.any(axis=0) & ~same & (of_track >= 0)[:, None]


def _clear_pairs(live: Sequence[OpenTrack], posed: Sequence[Posed], time_s: float) -> list[tuple[int, int]]:
    """Tracks and detections, by index, whose boxes overlap, a moment apart, as no other pair of either does."""
    fresh = [(t, box) for t, track in enumerate(live) if (box := _fresh_box(track, time_s)) is not None]
    if not fresh or not posed:
        return []
    overlap = box_math.iou(
        box_math.xywh_to_xyxy(np.array([box for _, box in fresh])),
        box_math.xywh_to_xyxy(np.array([detection.bbox for detection, _ in posed])),
    )
    out = []
    for k, s in np.argwhere(overlap >= TRACKER_LIMITS.jump_iou).tolist():
        others = max(np.delete(overlap[k], s).max(initial=0.0), np.delete(overlap[:, s], k).max(initial=0.0))
        if overlap[k, s] >= TRACKER_LIMITS.clear_ratio * others:
            out.append((fresh[k][0], s))
    return out


def _fresh_box(track: OpenTrack, time_s: float) -> Array | None:
    """(4,) the box of the image before, if that was a moment ago."""
    before = track.steps[-2] if len(track.steps) > 1 else None
    if before is None or before.detection is None or time_s - before.time_s > TRACKER_LIMITS.fresh_s:
        return None
    return before.detection.bbox


def _without_duplicates(live: Sequence[OpenTrack], new: list[Posed]) -> list[Posed]:
    """The new vehicles but those in the middle of which another one stands: detectors see many a vehicle twice.

    A track that has not been seen in this image takes such a detection as its own.
    """
    out: list[Posed] = []
    for detection, pose in sorted(new, key=lambda pair: -pair[0].score):
        around = [track for track in live if encloses(track, pose.place, pose.covariance)]
        unseen = [track for track in around if track.unseen and _can_be(track, detection)]
        if unseen:
            _take_by_box(unseen[0], detection)
        elif not around and not any(
            inside_vehicle(other, pose.place - other.place, pose.covariance) for _, other in out
        ):
            out.append((detection, pose))
    return out


def _can_be(track: OpenTrack, detection: Detection) -> bool:
    """Whether a detection of the latest image is where in the image the track's vehicle can be."""
    place = whereabouts(track, track.steps[-1].time_s)
    return place is None or place.holds(detection)


def _cost(track: OpenTrack, pose: PoseMeasurement) -> float:
    """Twice the negative log likelihood of a pose where the track should be; infinite out of its reach."""
    mean, spread = track.state
    away = pose.place - mean[:2]
    unseen_s = min(TRACKER_LIMITS.swerve_s, track.steps[-1].time_s - track.last_pose_s)
    S = (
        spread[:2, :2]
        + pose.covariance
        + (TRACKER_LIMITS.gate_slack_m**2 + (TRACKER_LIMITS.swerve_mps2 * unseen_s**2 / 2) ** 2) * np.eye(2)
    )
    # Mahalanobis distance and log determinant of a 2 x 2 matrix, written out: numpy is slow on small matrices.
    (a, b), (_, d) = S.tolist()
    x, y = away.tolist()
    det = a * d - b * b
    squared = (d * x * x - 2 * b * x * y + a * y * y) / det
    return squared + math.log(4 * math.pi**2 * det) if squared < KALMAN_SETTINGS.gate_variances else math.inf


def _by_box(live: list[OpenTrack], rest: list[Detection], least: float, time_s: float) -> list[Detection]:
    """Give detections to tracks that have none yet by the overlap with their last boxes; returns those it gave.

    `least` is the IoU from which a box continues a track.
    """
    free = [(track, box) for track in live if track.unseen and (box := track.box(time_s)) is not None]
    if not free or not rest:
        return []
    overlap = box_math.iou(
        box_math.xywh_to_xyxy(np.array([box for _, box in free])),
        box_math.xywh_to_xyxy(np.array([detection.bbox for detection in rest])),
    )
    same, other = _by_link([track for track, _ in free], rest)
    overlap = np.where(same, 1.0, np.where(other, 0.0, overlap))
    given = []
    for t, s in zip(*linear_sum_assignment(-overlap), strict=True):
        if overlap[t, s] >= least and _can_be(free[t][0], rest[s]):
            _take_by_box(free[t][0], rest[s])
            given.append(rest[s])
    return given


def _take_by_box(track: OpenTrack, detection: Detection) -> None:
    """Note a detection by its box; where poses keep saying that the vehicle is elsewhere, let another track have it."""
    step = track.steps[-1]
    step.detection = replace(detection, pose=None)
    if detection.pose is not None:
        track.elsewhere[step.frame] = detection
        if len(track.elsewhere) >= TRACKER_LIMITS.most_jumps:
            track.successor = _successor(track)


def _successor(track: OpenTrack) -> OpenTrack:
    """A track of what was seen since the last pose of one: of the poses elsewhere the last ones that fit together."""
    new: OpenTrack | None = None
    for step in track.steps:
        if new is not None:
            new.predict(step.frame, step.time_s, *kalman.motion(step.time_s - new.steps[-1].time_s))
            new.steps[-1].detection = step.detection
        detection = track.elsewhere.get(step.frame)
        if detection is None or detection.pose is None:
            continue
        if new is not None and np.isfinite(_cost(new, detection.pose)):
            new.update(detection, detection.pose)
        else:
            new = begin(step.frame, step.time_s, detection, detection.pose)
    assert new is not None
    return new
