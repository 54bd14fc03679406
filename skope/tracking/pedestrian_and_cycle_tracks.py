"""Track pedestrians and two-wheelers by their positions on the road.

They have no pose: the position is that of the box's lower edge, the heading is the direction of motion. A detection
joins the track that shares its number (from `skope eval predict`), or else the nearest track in variances. The motion
model is the filter for vehicles. A detector may take a rider for a cyclist in one frame and for a pedestrian in the
next. A track therefore joins detections of any category and has the category with the highest summed confidence.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from skope.schema import CATEGORY_NAMES, PEDESTRIAN_CATEGORY
from skope.tracking import kalman
from skope.tracking.box_links import cheapest_pairs
from skope.tracking.ground_points import GroundDetection, GroundPoint
from skope.tracking.headings import with_body_error
from skope.tracking.kalman import KALMAN_SETTINGS, State
from skope.tracking.track_flags import box_never_moved
from skope.tracks.track import Track
from skope.types import Array

Link = tuple[int, int]
"""Category and number of a road user, as a detector's results have them."""
FIRST_SPEED_SIGMAS: Final = {"bicycle": 5.0, "motorcycle": 12.0, "pedestrian": 1.5}
"""Standard deviation of a new road user's speed by category, m/s."""


@dataclass(frozen=True)
class FootTrackLimits:
    """Limits and noise of tracks of pedestrians and two-wheelers."""

    slack_m: float = 0.3
    """Standard deviation added to each prediction when detections are assigned, metres."""
    lost_s: float = 1.0
    """Time without a detection after which a track ends, seconds."""
    lag_s: float = 20.0
    """Age above which detections are final, seconds."""
    link_variances: float = 36.0
    """Maximum squared distance, in variances, at which a detection with a track's number joins it. Numbers may jump
    between pedestrians who meet."""
    foot_mps: float = 4.0
    """Median speed above which a road user is a two-wheeler, regardless of the boxes, m/s."""
    other_category_cost: float = 4.0
    """Squared distance, in variances, added for a detection of another category than the track's."""
    fewest_positions: int = 3
    """Minimum number of positions of a track."""
    shortest_s: float = 0.4
    """Minimum duration of a track, seconds."""
    half_wheelbase_m: float = 0.6
    """Distance from the middle of a two-wheeler to the wheel at the lower edge of its box, seen from the front or
    back, metres."""
    moving_sigmas: float = 2.0
    """Minimum speed with a heading, in standard deviations of the speed. `least_speed_mps` must be reached, too."""
    least_speed_mps: float = 0.5
    """Minimum speed with a heading, m/s."""


FOOT_TRACKS: Final = FootTrackLimits()

_ON_WHEELS: Final = (CATEGORY_NAMES.index("bicycle") + 1, CATEGORY_NAMES.index("motorcycle") + 1)
_HEIGHTS_M: Final = {"bicycle": 0.06, "motorcycle": 0.06, "pedestrian": 0.1}
"""Standard deviation of the height over the road of the lower edge of boxes, constant over a track, metres. A kerb is
10 to 15 cm high, and a box that ends too low by 3% of its height does so in consecutive frames."""


def of_body(track: Track, camera_position: Array) -> Track:
    """Move a track from the foot of the box to the middle of the body, and add the error that its positions share.

    Args:
        track: A track of `follow_road_users`.
        camera_position: (3,) world, metres.
    """
    line = track.xy - camera_position[:2]
    position = track.position.copy()
    if track.category != PEDESTRIAN_CATEGORY:
        along = np.abs(np.cos(track.heading - np.arctan2(line[:, 1], line[:, 0])))
        # Whether a standing two-wheeler faces the camera is not known.
        shift = FOOT_TRACKS.half_wheelbase_m * np.where(np.isnan(along), 0.5, along)
        position[:, :2] += line * (shift / np.maximum(np.linalg.norm(line, axis=1), 1e-9))[:, None]
    return with_body_error(replace(track, position=position), camera_position, _HEIGHTS_M[track.category])


def _headings(velocity: Array, speed_sigma: Array) -> Array:
    """Return (M,) directions of motion, radians, counter-clockwise from world x; NaN without significant motion."""
    speed = np.linalg.norm(velocity, axis=1)
    moves = speed > np.maximum(FOOT_TRACKS.least_speed_mps, FOOT_TRACKS.moving_sigmas * speed_sigma)
    return np.where(moves, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)


@dataclass(eq=False, slots=True)
class _Step:
    """One frame of an open track."""

    frame: int
    time_s: float
    transition: Array
    predicted: State
    filtered: State
    detection: GroundDetection | None = None


@dataclass(eq=False)
class _Open:
    """Track that may still get detections in later frames."""

    steps: list[_Step]
    """The frames that can still change."""
    last_s: float
    """Time of the latest position, seconds."""
    scores: Counter[int] = field(default_factory=Counter)
    """Confidence in each category, summed over all detections."""
    rows: list[tuple[float, ...]] = field(default_factory=list)
    """Final frames before `steps`: frame, time, x, y, vx, vy, 3 variances, sigma of speed, z, box, score."""

    @property
    def state(self) -> State:
        return self.steps[-1].filtered

    def take(self, detection: GroundDetection) -> None:
        """Update the state with the detection in the latest frame."""
        step = self.steps[-1]
        step.detection = detection
        self.scores.update(detection.scores)
        if detection.point is not None:
            step.filtered = kalman.updated_at(step.filtered, detection.point.position, detection.point.covariance)
            self.last_s = step.time_s

    @property
    def category_id(self) -> int:
        """Category with the highest summed confidence."""
        return max(self.scores, key=lambda category_id: self.scores[category_id])

    def category(self, speed: float) -> str:
        """Return the category from the confidences and the median speed, m/s."""
        on_foot = CATEGORY_NAMES[self.category_id - 1] == PEDESTRIAN_CATEGORY
        if on_foot and speed > FOOT_TRACKS.foot_mps:
            return CATEGORY_NAMES[max(_ON_WHEELS, key=lambda category_id: self.scores[category_id]) - 1]
        return CATEGORY_NAMES[self.category_id - 1]

    def settle(self, until_s: float) -> None:
        """Smooth all steps, and make those before `until_s` final."""
        steps = self.steps
        means, spreads = kalman.smoothed(
            [step.transition for step in steps], [step.predicted for step in steps], [step.filtered for step in steps]
        )
        count = sum(step.time_s < until_s for step in steps)
        covariances, speeds = kalman.position_and_speed_errors(means[:count], spreads[:count])
        variances = covariances.reshape(-1, 4)[:, [0, 1, 3]].tolist()
        for step, mean, spread, speed in zip(steps[:count], means, variances, speeds.tolist(), strict=False):
            height = np.nan if step.detection is None or step.detection.point is None else step.detection.point.height
            seen = [np.nan] * 5 if step.detection is None else [*step.detection.bbox, step.detection.score]
            self.rows.append((step.frame, step.time_s, *mean[:4], *spread, speed, height, *seen))
        del steps[:count]

    def finished(self) -> Track | None:
        """Return the whole track up to its last position, as number 0; None if it is too short."""
        del self.steps[sum(step.time_s <= self.last_s for step in self.steps) :]
        self.settle(np.inf)
        rows = np.array(self.rows)
        located = np.isfinite(rows[:, 10])
        times, velocity, speed_sigma = rows[:, 1], rows[:, 4:6], rows[:, 9]
        if located.sum() < FOOT_TRACKS.fewest_positions or times[-1] - times[0] < FOOT_TRACKS.shortest_s:
            return None
        category = self.category(float(np.median(np.hypot(*velocity[located].T))))
        detected = np.isfinite(rows[:, 15])
        return Track(
            number=0,
            category=category,
            class_name=category,
            class_confidence=1.0,
            frames=rows[:, 0].astype(np.intp),
            times_s=times,
            position=np.column_stack([rows[:, 2:4], np.interp(times, times[located], rows[located, 10])]),
            velocity=velocity,
            heading=_headings(velocity, speed_sigma),
            covariance=rows[:, [[6, 7], [7, 8]]],
            speed_sigma=speed_sigma,
            located=located,
            detected=detected,
            boxes=rows[:, 11:15],
            scores=rows[:, 15],
            flags=("never_moved",) if box_never_moved(rows[detected, 11:15], times[detected]) else (),
        )


def follow_road_users(
    images: Iterable[Sequence[GroundDetection]], times_s: Sequence[float], first_number: int = 1
) -> list[Track]:
    """Track pedestrians and two-wheelers through consecutive images of one camera.

    Args:
        images: Detected road users of each image.
        times_s: Time of each image, seconds, rising.
        first_number: Number of the first track. Further tracks follow by their first frames.
    """
    live: list[_Open] = []
    ended: list[_Open] = []
    owners: dict[Link, _Open] = {}
    before = times_s[0] if times_s else 0.0
    for frame, (detections, time_s) in enumerate(zip(images, times_s, strict=True)):
        F, Q = kalman.motion(time_s - before)
        ended += [track for track in live if time_s - track.last_s > FOOT_TRACKS.lost_s]
        live = [track for track in live if time_s - track.last_s <= FOOT_TRACKS.lost_s]
        for track in live:
            ahead = kalman.predicted_state(track.state, F, Q)
            track.steps.append(_Step(frame, time_s, F, ahead, ahead))
        for known, detection in _pairs(live, detections, owners):
            if known is not None:
                known.take(detection)
            elif detection.point is not None:
                known = _begun(frame, time_s, detection, detection.point)
                live.append(known)
            if known is not None:
                _claim_links(owners, known, detection.links, live)
        for track in live:
            if time_s - track.steps[0].time_s > 2 * FOOT_TRACKS.lag_s:
                track.settle(time_s - FOOT_TRACKS.lag_s)
        before = time_s
    tracks = [track for track in map(_Open.finished, ended + live) if track is not None]
    tracks.sort(key=lambda track: int(track.frames[0]))
    return [replace(track, number=number) for number, track in enumerate(tracks, start=first_number)]


def _claim_links(owners: dict[Link, _Open], track: _Open, links: Sequence[Link], live: Sequence[_Open]) -> None:
    """Give a track the numbers of its detection that no other open track has."""
    for link in links:
        if link not in owners or owners[link] not in live:
            owners[link] = track


def _begun(frame: int, time_s: float, detection: GroundDetection, point: GroundPoint) -> _Open:
    speed = FIRST_SPEED_SIGMAS[CATEGORY_NAMES[detection.category_id - 1]]
    state = kalman.first_state_at(point.position, point.covariance, speed)
    begun = _Open([_Step(frame, time_s, np.eye(6), state, state, detection)], time_s)
    begun.scores.update(detection.scores)
    return begun


def _pairs(
    live: Sequence[_Open], detections: Sequence[GroundDetection], owners: Mapping[Link, _Open]
) -> list[tuple[_Open | None, GroundDetection]]:
    """Return each detection with its track; None if it has none. `owners` are the tracks of known numbers."""
    of_detection: dict[int, _Open] = {}
    for i, detection in enumerate(detections):
        known = [owners[link] for link in detection.links if link in owners]
        # Of two detections with one number only the first gets the track.
        of_detection.update(
            (i, track)
            for track in known[:1]
            if track in live and track not in of_detection.values() and _may_be(track, detection)
        )
    taken = {id(track) for track in of_detection.values()}
    free = [track for track in live if id(track) not in taken]
    rest = [
        (i, detection)
        for i, detection in enumerate(detections)
        if i not in of_detection and detection.point is not None
    ]
    points = [(detection.category_id, detection.point) for _, detection in rest if detection.point is not None]
    for row, column in cheapest_pairs(_distances(free, points), KALMAN_SETTINGS.gate_variances):
        of_detection[rest[column][0]] = free[row]
    return [(of_detection.get(i), detection) for i, detection in enumerate(detections)]


def _may_be(track: _Open, detection: GroundDetection) -> bool:
    """Return whether a detection with the track's number may be the same road user: its position must not jump."""
    if detection.point is None:
        return True
    return float(_distances([track], [(track.category_id, detection.point)])[0, 0]) < FOOT_TRACKS.link_variances


def _distances(tracks: Sequence[_Open], points: Sequence[tuple[int, GroundPoint]]) -> Array:
    """Return (T, P) squared distances of positions, with their categories, from the predicted tracks, in variances.

    `FOOT_TRACKS.other_category_cost` is added if the category differs from the track's.
    """
    means = np.array([track.state[0][:2] for track in tracks]).reshape(-1, 1, 2)
    spreads = np.array([track.state[1][:2, :2] for track in tracks]).reshape(-1, 1, 2, 2)
    places = np.array([point.position for _, point in points]).reshape(1, -1, 2)
    covariances = np.array([point.covariance for _, point in points]).reshape(1, -1, 2, 2)
    away = places - means
    total = spreads + covariances + FOOT_TRACKS.slack_m**2 * np.eye(2)
    squared = np.einsum("tpi,tpij,tpj->tp", away, np.linalg.inv(total), away)
    alike = np.equal.outer([track.category_id for track in tracks], [category for category, _ in points])
    return np.asarray(squared + np.where(alike, 0.0, FOOT_TRACKS.other_category_cost))
