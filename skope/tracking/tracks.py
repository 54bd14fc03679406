"""`OpenTrack`, the tracker's working state of a vehicle, which becomes a smoothed `Track` at its end."""

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from skope.tracking import kalman
from skope.tracking.headings import smoothed_headings
from skope.tracking.kalman import State
from skope.tracking.tracker_inputs import Detection, PoseMeasurement
from skope.tracks.track import Track
from skope.types import Array

VEHICLE_CLASS_NAMES: Final = ("car", "van", "lorry", "bus", "unknown")
OF_BODY_TYPE: Final[Mapping[str, str]] = {
    "van": "van",
    "box_truck": "lorry",
    "truck": "lorry",
    "articulated_truck": "lorry",
    "bus": "bus",
    "articulated_bus": "bus",
}
"""Classes of body types that are not cars."""


@dataclass(frozen=True)
class TrackLimits:
    """Limits for reporting a track."""

    independent_poses: float = 5.0
    """Maximum effective number of independent poses of a track. Poses of one vehicle share errors."""
    class_confidence: float = 0.6
    """Confidence at and above which a class is named; below it the class is `unknown`."""
    box_s: float = 0.5
    """Time for which a track's last box still locates it in the image, and for which boxes alone extend it,
    seconds."""
    fewest_poses: int = 2
    """Minimum number of poses of a track."""
    shortest_s: float = 0.4
    """Minimum duration of a track, seconds."""
    way_poses: int = 4
    """Minimum number of poses of a vehicle with a known direction of travel."""
    driving_mps: float = 2.0
    """Minimum speed at which the direction of travel is known, m/s."""


TRACK_LIMITS: Final = TrackLimits()


def vehicle_class(body_types: Mapping[str, int]) -> tuple[str, float]:
    """Return the vehicle class of a track and its confidence, 0 to 1.

    The confidence is the share of agreeing poses, shrunk towards 0.5. The fewer poses there are, the more it is shrunk.
    A class below `TRACK_LIMITS.class_confidence` is `unknown`.

    Args:
        body_types: Number of the track's poses with each body type.
    """
    votes = dict.fromkeys(VEHICLE_CLASS_NAMES, 0)
    for name, number in body_types.items():
        votes[OF_BODY_TYPE.get(name, "car")] += number
    total = sum(votes.values())
    best = max(votes, key=votes.__getitem__)
    independent = min(float(total), TRACK_LIMITS.independent_poses)
    confidence = (votes[best] / max(1, total) * independent + 0.5) / (independent + 1)
    return (best if confidence >= TRACK_LIMITS.class_confidence else "unknown", confidence)


@dataclass(eq=False, slots=True)
class TrackStep:
    """One frame of an open track."""

    frame: int
    time_s: float
    transition: Array
    """(6, 6) from the frame before."""
    predicted: State
    """State before the frame's measurement."""
    filtered: State
    """State after the frame's measurement."""
    detection: Detection | None = None


@dataclass(frozen=True, eq=False)
class TrackPart:
    """Consecutive frames of a track in final smoothed form, one row per frame; NaN where nothing was measured."""

    frames: NDArray[np.intp]
    times_s: Array
    states: Array
    """(M, 6) means of the smoothed states; `skope.tracking.kalman` defines their order."""
    covariances: Array
    """(M, 2, 2) covariances of the positions, square metres."""
    speed_sigmas: Array
    """(M,) standard deviations of the speeds, m/s."""
    heights: Array
    """(M,) z of the road, metres."""
    headings: Array
    """(M,) measured headings, radians."""
    heading_sigmas: Array
    """(M,) standard deviations of the headings, radians."""
    sizes: Array
    """(M, 3) length, width, height, metres."""
    boxes: Array
    """(M, 4) x, y, width, height, pixels."""
    scores: Array
    """(M,) detection scores, 0 to 1."""
    truth_ids: NDArray[np.int64]
    """(M,) ids of the labelled vehicles; -1 where there is none."""


Sighting: TypeAlias = tuple[int, float, Detection]
"""Frame, time in seconds and detection."""


@dataclass(eq=False)
class OpenTrack:
    """Track that may still get detections in later frames."""

    steps: list[TrackStep]
    """The frames that can still change."""
    last_pose: PoseMeasurement
    """Latest pose: the current heading and size of the vehicle."""
    parts: list[TrackPart] = field(default_factory=list)
    """Final frames before `steps`."""
    kinds: Counter[str] = field(default_factory=Counter)
    """Number of poses with each body type."""
    last_pose_s: float = 0.0
    """Time of `last_pose`, seconds."""
    way: float | None = None
    """Latest direction of travel, radians; None: it is not known yet."""
    elsewhere: dict[int, Detection] = field(default_factory=dict)
    """Detections since `last_pose`, by frame, that match this vehicle by box but not by pose."""
    successor: "OpenTrack | None" = None
    """Track that continues from `elsewhere` in place of this one, which then ends with `last_pose`."""
    approach: list[Sighting] = field(default_factory=list)
    """Detections of the vehicle before its first pose, latest first."""
    surrounding: "OpenTrack | None" = None
    """Other track with a vehicle around the middle of this one; both may be the same vehicle."""
    surrounded_s: float = 0.0
    """Time since which `surrounding` has not changed, seconds."""

    @property
    def state(self) -> State:
        """The latest state."""
        return self.steps[-1].filtered

    @property
    def unseen(self) -> bool:
        """Whether the track has no detection in the latest frame (yet)."""
        return self.steps[-1].detection is None

    @property
    def link(self) -> int | None:
        """The `Detection.link` of its latest detection."""
        return next((step.detection.link for step in reversed(self.steps) if step.detection is not None), None)

    @property
    def poses(self) -> int:
        """Number of poses."""
        return self.kinds.total()

    def box(self, time_s: float) -> Array | None:
        """Return the last box (4,), or None if it is older than `TRACK_LIMITS.box_s` at `time_s`.

        A box of the frame before the latest is returned at any age.
        """
        for step in reversed(self.steps):
            if time_s - step.time_s > TRACK_LIMITS.box_s:
                break
            if step.detection is not None:
                return step.detection.bbox
        return self.steps[-2].detection.bbox if len(self.steps) > 1 and self.steps[-2].detection is not None else None

    def predict(self, frame: int, time_s: float, F: Array, Q: Array) -> None:
        """Advance to a frame with detections that are not known yet.

        Args:
            frame: The frame, from 0.
            time_s: Its time, seconds.
            F: (6, 6) transition, of `kalman.motion`.
            Q: (6, 6) covariance of the process noise of the step.
        """
        ahead = kalman.predicted_state(self.state, F, Q)
        self.steps.append(TrackStep(frame, time_s, F, ahead, ahead))

    def update(self, detection: Detection, pose: PoseMeasurement) -> None:
        """Update the state with the detection and pose of the latest frame."""
        step = self.steps[-1]
        step.filtered = kalman.updated(step.filtered, pose)
        step.detection = detection
        self.last_pose = pose
        self.kinds[pose.kind] += 1
        self.last_pose_s = step.time_s
        self.elsewhere = {}
        vx, vy = step.filtered[0][2:4].tolist()
        if self.poses >= TRACK_LIMITS.way_poses and math.hypot(vx, vy) >= TRACK_LIMITS.driving_mps:
            self.way = math.atan2(vy, vx)

    def settle(self, until_s: float) -> None:
        """Smooth all steps, and make those before `until_s` final."""
        self._keep(sum(step.time_s < until_s for step in self.steps))

    def end(self) -> None:
        """Smooth the remaining steps, up to the last pose and as far as the box continues after it."""
        self.steps = list(itertools.takewhile(self._lasts_until, self.steps))
        self._keep(len(self.steps))
        self.steps = []

    def _lasts_until(self, step: TrackStep) -> bool:
        since_s = step.time_s - self.last_pose_s
        return since_s <= 0 or (since_s <= TRACK_LIMITS.box_s and step.detection is not None and self.successor is None)

    def _keep(self, count: int) -> None:
        """Smooth all steps, and make the first `count` final; put the approach before the first one."""
        means, spreads = _smoothed(self.steps)
        if count and self.approach and not self.parts:
            self.parts.append(_part(*_approached(self.approach, self.steps[0], (means[0], spreads[0]))))
        self.parts.append(_part(self.steps[:count], means[:count], spreads[:count]))
        del self.steps[:count]

    @property
    def confirmed(self) -> bool:
        """Whether an ended track has enough poses and lasts long enough to be reported."""
        times = [part.times_s for part in self.parts if len(part.times_s)]
        return (
            self.poses >= TRACK_LIMITS.fewest_poses
            and bool(times)
            and bool(times[-1][-1] - times[0][0] >= TRACK_LIMITS.shortest_s)
        )


def is_confirmed(times_s: Array) -> bool:
    """Return whether a vehicle with poses at these times (P,) has enough poses and lasts long enough."""
    return len(times_s) >= TRACK_LIMITS.fewest_poses and bool(times_s[-1] - times_s[0] >= TRACK_LIMITS.shortest_s)


def begin(
    frame: int, time_s: float, detection: Detection, pose: PoseMeasurement, approach: Sequence[Sighting] = ()
) -> OpenTrack:
    """Begin the track of a vehicle that has had no pose before.

    Args:
        frame: The frame, from 0.
        time_s: Its time, seconds.
        detection: Detection of the vehicle in the frame.
        pose: Pose of the vehicle in the frame.
        approach: Earlier detections of the vehicle, latest first.
    """
    state = kalman.first_state(pose)
    step = TrackStep(frame, time_s, np.eye(6), state, state, detection)
    return OpenTrack([step], pose, kinds=Counter([pose.kind]), last_pose_s=time_s, approach=list(approach))


def finished(track: OpenTrack, number: int) -> Track:
    """Return an ended track as a whole. `track` is emptied."""
    names = [column.name for column in fields(TrackPart)]
    columns = {name: np.concatenate([getattr(part, name) for part in track.parts]) for name in names}
    track.parts = []  # otherwise both copies stay in memory
    states, located = columns["states"], np.isfinite(columns["headings"])
    times = columns["times_s"]
    vehicle, confidence = vehicle_class(track.kinds)
    z = np.interp(times, times[located], columns["heights"][located])
    length, width, height = np.median(columns["sizes"][located], axis=0).tolist()
    return Track(
        number=number,
        body_type=track.kinds.most_common(1)[0][0],
        class_name=vehicle,
        class_confidence=confidence,
        length=length,
        width=width,
        height=height,
        confirmed=is_confirmed(times[located]),
        detected=np.isfinite(columns["scores"]),
        frames=columns["frames"],
        times_s=times,
        position=np.column_stack([states[:, :2], z]),
        velocity=states[:, 2:4],
        acceleration=states[:, 4:6],
        heading=smoothed_headings(times, columns["headings"], columns["heading_sigmas"], states[:, 2:4]),
        covariance=columns["covariances"],
        speed_sigma=columns["speed_sigmas"],
        located=located,
        boxes=columns["boxes"],
        scores=columns["scores"],
        truth_ids=columns["truth_ids"],
    )


def _smoothed(steps: Sequence[TrackStep]) -> tuple[Array, Array]:
    """Return the means (M, 6) and covariances (M, 6, 6) of the smoothed states."""
    return kalman.smoothed(
        [step.transition for step in steps], [step.predicted for step in steps], [step.filtered for step in steps]
    )


def _approached(sightings: Sequence[Sighting], first: TrackStep, state: State) -> tuple[list[TrackStep], Array, Array]:
    """Return the steps before the first one of a track, and their (M, 6) means and (M, 6, 6) covariances.

    `state` is the smoothed state of `first`.
    """
    steps = []
    later_s = first.time_s
    for frame, time_s, detection in sightings:
        state = kalman.before(state, later_s - time_s)
        steps.append(TrackStep(frame, time_s, np.eye(6), state, state, detection))
        later_s = time_s
    steps.reverse()
    return steps, np.array([step.filtered[0] for step in steps]), np.array([step.filtered[1] for step in steps])


def _part(steps: Sequence[TrackStep], states: Array, spreads: Array) -> TrackPart:
    count = len(steps)
    covariances, speed_sigmas = kalman.position_and_speed_errors(states, spreads)
    heights, headings, heading_sigmas, scores = np.full((4, count), np.nan)
    sizes, boxes = np.full((count, 3), np.nan), np.full((count, 4), np.nan)
    truth_ids = np.full(count, -1, dtype=np.int64)
    for i, step in enumerate(steps):
        if step.detection is None:
            continue
        boxes[i], scores[i] = step.detection.bbox, step.detection.score
        truth_ids[i] = -1 if step.detection.truth_id is None else step.detection.truth_id
        if (pose := step.detection.pose) is not None:
            heights[i], headings[i], sizes[i] = pose.height, pose.heading, pose.size_lwh
            heading_sigmas[i] = pose.heading_sigma
    return TrackPart(
        frames=np.array([step.frame for step in steps], dtype=np.intp),
        times_s=np.array([step.time_s for step in steps]),
        states=states,
        covariances=covariances,
        speed_sigmas=speed_sigmas,
        heights=heights,
        headings=headings,
        heading_sigmas=heading_sigmas,
        sizes=sizes,
        boxes=boxes,
        scores=scores,
        truth_ids=truth_ids,
    )
