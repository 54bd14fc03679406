"""Track vehicles on the ground through a video by assigning detections to tracks.

Each vehicle is a point with a slowly changing acceleration (`skope.tracking.kalman`). Detections are assigned in
this order:

1. Links between frames from `skope eval predict` (`Detection.link`).
2. Boxes: a detection joins a track if its box overlaps the track's last box, no other pair of either overlaps nearly
   as much, and its pose allows it. Along the camera's viewing ray poses are uncertain by metres, boxes by pixels.
3. Positions: a detection joins the track from which it is more likely than from a new vehicle (Jonker and Volgenant's
   assignment as in scipy). The likelihood depends on the covariances of track and pose and on the elapsed time, not
   on the number of frames.
4. Boxes again, for vehicles without a pose or with a pose that suddenly is elsewhere.

If poses stay elsewhere, the track ends and a second track begins, because vehicles do not jump. By its boxes, a track
also extends up to half a second before its first pose and after its last one: vehicles at the image's edge and between
key frames have no pose. A tracker of boxes alone would lose the metric positions, headings and covariances.
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
    """Limits for assigning detections to tracks of vehicles."""

    pace_s: float = 0.3
    """Minimum time between two boxes that give a vehicle's speed in the image, seconds."""
    faster: float = 2.0
    """Maximum factor by which that speed may have grown. Approaching vehicles grow faster in the image."""
    lateral_diagonals: float = 0.6
    """Maximum lateral distance of a vehicle from its predicted path at zero elapsed time, in diagonals of its box."""
    lateral_growth: float = 0.7
    """Growth of that distance, diagonals per second. The vehicle may have turned."""
    first_diagonals: tuple[float, float] = (1.0, 8.0)
    """Both limits for a vehicle that was detected once: 8 lengths per second are 130 km/h."""
    new_vehicle_cost: float = 2 * math.log(20_000.0)
    """Cost of a new vehicle, twice a negative log likelihood: one in 20 000 m^2."""
    gate_slack_m: float = 0.5
    """Standard deviation added to each prediction when detections are assigned, metres."""
    swerve_mps2: float = 6.0
    """Acceleration at which a vehicle may have turned or braked since its last pose, m/s^2."""
    swerve_s: float = 1.0
    """Maximum duration of that acceleration, seconds."""
    other_way_rad: float = math.radians(120)
    """Angle to the direction of travel, less three standard deviations, from which a pose faces the other way. Poses of
    vehicles that the border of the image cuts are off by less."""
    turning_radius_m: float = 5.0
    """Minimum turning radius of the middle of a vehicle, metres."""
    lane_m: float = 1.5
    """Lateral distance at and above which a pose that faces the other way belongs to another vehicle, metres. Nearer,
    it is one with front and rear exchanged."""
    continuing_iou: float = 0.3
    """Minimum IoU at which a box without a pose continues a track."""
    jump_iou: float = 0.5
    """Minimum IoU at which a box continues a track although its pose is elsewhere."""
    fresh_s: float = 0.15
    """Time for which a box alone locates a vehicle in the image, seconds."""
    clear_ratio: float = 2.0
    """Minimum ratio of the IoU of two boxes to the next best IoU of either; at or above it both are one vehicle."""
    most_jumps: int = 3
    """Number of poses elsewhere after which the track's successor begins there."""
    lost_s: float = 3.0
    """Time without a pose after which a track ends, seconds."""
    approach_s: float = 0.5
    """Maximum time before a vehicle's first pose during which its boxes belong to its track, seconds."""
    lag_s: float = 20.0
    """Age above which frames are final, seconds. Frames become final in steps of up to twice this age."""


TRACKER_LIMITS: Final = TrackerLimits()


@dataclass(frozen=True, eq=False, slots=True)
class Whereabouts:
    """Image region in which the middle of a track's next box must lie: around a line from its last position."""

    middle: tuple[float, float]
    """Last position, pixels."""
    way: tuple[float, float]
    """Vector of the longest displacement from there, pixels."""
    diagonal: float
    """Diagonal of the last box, pixels."""
    reach: float
    """Maximum distance from the line, in diagonals of the larger box."""

    def holds(self, detection: Detection) -> bool:
        """Return whether a detection can be this vehicle."""
        (x, y), (ahead_x, ahead_y) = _middle(detection.bbox), self.way
        x, y = x - self.middle[0], y - self.middle[1]
        squared = ahead_x**2 + ahead_y**2
        share = min(1.0, max(0.0, (x * ahead_x + y * ahead_y) / squared)) if squared else 0.0
        away = math.hypot(x - share * ahead_x, y - share * ahead_y)
        return away <= self.reach * max(_diagonal(detection.bbox), self.diagonal)


def whereabouts(track: OpenTrack, time_s: float) -> Whereabouts | None:
    """Return the image region of a track's vehicle at `time_s`, the time of its latest frame; None: anywhere."""
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
    """Return the last step with a box before the latest step, and an older one that gives the speed.

    The older one is the newest at least `TRACKER_LIMITS.pace_s` earlier, or else the oldest.
    """
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


__all__ = ["Track", "track_vehicles"]

Posed = tuple[Detection, PoseMeasurement]
"""Detection that has a pose, and the pose."""


def track_vehicles(images: Iterable[Sequence[Detection]], times_s: Sequence[float]) -> list[Track]:
    """Follow the vehicles in consecutive images of one camera.

    Images are taken one at a time; memory grows by 150 bytes per vehicle and image.

    Args:
        images: The detections of each image.
        times_s: (M,) time of each image, seconds, strictly rising.

    Returns:
        A track for each vehicle with enough poses (`skope.tracking.tracks.TRACK_LIMITS`), numbered from 1 by its first
        frame.

    Raises:
        ValueError: The times do not rise strictly.
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
    """Take the boxes without a track that lead to a new vehicle out of `recent`, and return them latest first."""
    out: list[Sighting] = []
    for frame, time_s, boxes in reversed(recent):
        if not boxes:
            break
        overlap = box_math.iou(
            box_math.xywh_to_xyxy(detection.bbox[None]),
            box_math.xywh_to_xyxy(np.array([earlier.bbox for earlier in boxes])),
        )[0]
        if overlap.max() < TRACKER_LIMITS.continuing_iou:
            break
        detection = boxes.pop(int(overlap.argmax()))
        out.append((frame, time_s, detection))
    return out


def _associate(live: list[OpenTrack], image: Sequence[Detection], time_s: float) -> tuple[list[Posed], list[Detection]]:
    """Assign an image's detections to tracks: by clear boxes, then by position, then by box.

    Returns:
        The detections of new vehicles, and those without a pose that belong to no track.
    """
    regions = [whereabouts(track, time_s) for track in live]
    posed = [(detection, detection.pose) for detection in image if detection.pose is not None]
    left = dict(enumerate(posed))
    cost = np.array(
        [
            [_cost(track, pose) if region is None or region.holds(detection) else math.inf for detection, pose in posed]
            for track, region in zip(live, regions, strict=True)
        ]
    ).reshape(len(live), len(posed))
    same, elsewhere = _by_link(live, [detection for detection, _ in posed])
    cost = np.where(elsewhere, np.inf, cost)
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
    """Return (T, S) whether track and detection are linked, and (T, S) whether the detection is linked elsewhere."""
    of_track = np.array([-1 if track.link is None else track.link for track in live], dtype=np.int64)
    of_detection = np.array(
        [-1 if detection.link is None else detection.link for detection in detections], dtype=np.int64
    )
    same = (of_track[:, None] == of_detection) & (of_detection >= 0)
    return same, same.any(axis=0) & ~same & (of_track >= 0)[:, None]


def _clear_pairs(live: Sequence[OpenTrack], posed: Sequence[Posed], time_s: float) -> list[tuple[int, int]]:
    """Return the index pairs of tracks and detections with boxes that clearly belong together.

    The track's box is recent. No other pair of either has an IoU close to theirs.
    """
    fresh = [(t, box) for t, track in enumerate(live) if (box := _fresh_box(track, time_s)) is not None]
    if not fresh or not posed:
        return []
    overlap = box_math.iou(
        box_math.xywh_to_xyxy(np.array([box for _, box in fresh])),
        box_math.xywh_to_xyxy(np.array([detection.bbox for detection, _ in posed])),
    )
    out = []
    for k, s in np.argwhere(overlap >= TRACKER_LIMITS.jump_iou).tolist():
        next_best = max(np.delete(overlap[k], s).max(initial=0.0), np.delete(overlap[:, s], k).max(initial=0.0))
        if overlap[k, s] >= TRACKER_LIMITS.clear_ratio * next_best:
            out.append((fresh[k][0], s))
    return out


def _fresh_box(track: OpenTrack, time_s: float) -> Array | None:
    """Return the box (4,) of the previous image, or None if there is none or it is too old."""
    before = track.steps[-2] if len(track.steps) > 1 else None
    if before is None or before.detection is None or time_s - before.time_s > TRACKER_LIMITS.fresh_s:
        return None
    return before.detection.bbox


def _without_duplicates(live: Sequence[OpenTrack], new: list[Posed]) -> list[Posed]:
    """Return the new vehicles without duplicates: detectors often find a vehicle twice.

    A detection inside a tracked vehicle joins that track if the track has no detection in this image.
    """
    out: list[Posed] = []
    for detection, pose in sorted(new, key=lambda pair: -pair[0].score):
        around = [track for track in live if encloses(track, pose.place, pose.covariance)]
        unseen = [track for track in around if track.unseen and _can_be(track, detection)]
        if unseen:
            _take_by_box(unseen[0], detection)
        elif not around and not any(
            inside_vehicle(kept_pose, pose.place - kept_pose.place, pose.covariance) for _, kept_pose in out
        ):
            out.append((detection, pose))
    return out


def _can_be(track: OpenTrack, detection: Detection) -> bool:
    """Return whether the track's vehicle can be at the image position of a detection in the latest frame."""
    region = whereabouts(track, track.steps[-1].time_s)
    return region is None or region.holds(detection)


def _cost(track: OpenTrack, pose: PoseMeasurement) -> float:
    """Return twice the negative log likelihood of a pose given the track's prediction; infinite beyond the gate."""
    if _is_in_other_lane(track, pose):
        return math.inf
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


def _is_in_other_lane(track: OpenTrack, pose: PoseMeasurement) -> bool:
    """Return whether a pose is that of another vehicle, in the lane beside, that faces the other way.

    On a circle of radius R, a turn by an angle a moves a vehicle sideways by R (1 - cos a).
    """
    if track.way is None:
        return False
    turn = abs(math.remainder(pose.heading - track.way, math.tau)) - 3 * pose.heading_sigma
    if turn < TRACKER_LIMITS.other_way_rad:
        return False
    x, y = (pose.place - track.last_pose.place).tolist()
    aside = abs(y * math.cos(track.way) - x * math.sin(track.way))
    sigma = math.sqrt(np.trace(pose.covariance + track.last_pose.covariance))
    return bool(TRACKER_LIMITS.lane_m <= aside < TRACKER_LIMITS.turning_radius_m * (1 - math.cos(turn)) - sigma)


def _by_box(live: list[OpenTrack], rest: list[Detection], least: float, time_s: float) -> list[Detection]:
    """Assign detections to tracks without one by the overlap with their last boxes; return the assigned detections.

    `least` is the minimum IoU at which a box continues a track.
    """
    free = [(track, box) for track in live if track.unseen and (box := track.box(time_s)) is not None]
    if not free or not rest:
        return []
    overlap = box_math.iou(
        box_math.xywh_to_xyxy(np.array([box for _, box in free])),
        box_math.xywh_to_xyxy(np.array([detection.bbox for detection in rest])),
    )
    same, elsewhere = _by_link([track for track, _ in free], rest)
    overlap = np.where(same, 1.0, np.where(elsewhere, 0.0, overlap))
    given = []
    for t, s in zip(*linear_sum_assignment(-overlap), strict=True):
        if overlap[t, s] >= least and _can_be(free[t][0], rest[s]):
            _take_by_box(free[t][0], rest[s])
            given.append(rest[s])
    return given


def _take_by_box(track: OpenTrack, detection: Detection) -> None:
    """Add a detection by its box only. After `TRACKER_LIMITS.most_jumps` poses elsewhere, create a successor."""
    step = track.steps[-1]
    step.detection = replace(detection, pose=None)
    if detection.pose is not None:
        track.elsewhere[step.frame] = detection
        if len(track.elsewhere) >= TRACKER_LIMITS.most_jumps:
            track.successor = _successor(track)


def _successor(track: OpenTrack) -> OpenTrack:
    """Return a track of the detections since the last pose, from the latest poses elsewhere that are consistent."""
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
