"""Vehicles followed through a video on the ground: association, smoothing, speed and acceleration.

Each vehicle is a point that moves with a slowly changing acceleration (a Kalman filter; Rauch, Tung and Striebel's
smoother afterwards, so that speeds know what came later). A detection joins the track whose predicted place it fits
best (Jonker and Volgenant's assignment, as scipy has it); for a vehicle that lost its pose the box in the image keeps
the track. Trackers of boxes alone would lose what the poses know: metres, headings and how certain they are.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from skope import boxes as box_math
from skope.eval.located import Located

Array = NDArray[np.float64]

_JERK: Final = 1.0
"""Spectral density of the change of acceleration, m^2 / s^5: hard braking within a second or two."""
_MEMORY_S: Final = 1.5
"""How long an acceleration lasts."""
_REACH: Final = 5.0
"""Metres beyond which a detection is another vehicle's, however uncertain the track; uncertain by more, it ends."""
_FLOOR: Final = 0.05
"""Least standard deviation of a measured place, metres: shape errors stay the same from frame to frame."""
_GATE: Final = 16.0
"""Squared distance, in variances, beyond which a detection is another vehicle's."""
_SLACK: Final = 0.5
"""Metres added to every prediction's standard deviation when vehicles are told apart."""
_OVERLAP: Final = 0.3
"""Least IoU by which a box without a pose continues a track."""
_LOST_S: Final = 3.0
"""A track ends when nothing was seen of it for so long."""
_CONFIRMED: Final = 3
"""Fewer poses than this are no track."""
_MOVING: Final = 1.5
"""Speed from which the direction of travel says where the front is, m/s."""
_WINDOW: Final = 12
"""Frames to either side over which headings are averaged."""
_ELSEWHERE: Final = 1e6


@dataclass(frozen=True, eq=False)
class Measured:
    """What a detection's pose says."""

    place: Array
    """(2,) world."""
    covariance: Array
    """(2, 2)"""
    height: float
    """z of the road there."""
    heading: float
    heading_sigma: float
    size_lwh: Array
    kind: str
    """Body type."""


@dataclass(frozen=True, eq=False)
class Sight:
    """One detection."""

    bbox: Array
    score: float
    truth_id: int | None
    """The track of the ground-truth vehicle that it is, or matches."""
    pose: Measured | None
    """None where it was refused."""


@dataclass(frozen=True, eq=False)
class Track:
    """A vehicle over the frames from its first to its last pose; M frames, all of them, seen or not."""

    number: int
    kind: str
    size_lwh: Array
    """(3,) median, metres."""
    frames: NDArray[np.intp]
    times_s: Array
    position: Array
    """(M, 3) smoothed, world, on the ground under the middle of the box."""
    velocity: Array
    """(M, 2) m/s."""
    acceleration: Array
    """(M, 2) m/s^2."""
    heading: Array
    """(M,) radians, counter-clockwise from world x."""
    sights: tuple[Sight | None, ...]
    """(M,) what was seen, None where it was missed."""

    @property
    def speed(self) -> Array:
        """(M,) m/s."""
        return np.asarray(np.linalg.norm(self.velocity, axis=1))

    @property
    def along(self) -> Array:
        """(M,) acceleration in the direction of travel, m/s^2; 0 for a vehicle that stands."""
        speed = self.speed
        dot = np.einsum("mi,mi->m", self.acceleration, self.velocity)
        return np.asarray(np.divide(dot, speed, out=np.zeros_like(speed), where=speed > 0.1))


@dataclass(eq=False)
class _Open:
    """A track that is being followed: state x, y, vx, vy, ax, ay of every frame, before and after its measurement."""

    sights: list[Sight | None]
    first: int
    predicted: list[tuple[Array, Array]] = field(default_factory=list)
    filtered: list[tuple[Array, Array]] = field(default_factory=list)
    steps: list[Array] = field(default_factory=list)
    """Transition into each frame."""
    last_pose: int = 0
    """Index of the last sight with a pose."""

    @property
    def state(self) -> tuple[Array, Array]:
        return self.filtered[-1]

    @property
    def spread(self) -> float:
        """Standard deviation of the place, metres."""
        return math.sqrt(max(self.state[1][0, 0], self.state[1][1, 1]))

    @property
    def last_sight(self) -> Sight:
        return next(s for s in reversed(self.sights) if s is not None)

    def poses(self) -> list[Measured | None]:
        return [None if s is None else s.pose for s in self.sights]


def follow(images: Sequence[Located], times_s: Sequence[float]) -> list[Track]:
    """Tracks of the vehicles in consecutive images of one camera; `times_s` rise."""
    live: list[_Open] = []
    done: list[_Open] = []
    for frame, (image, time) in enumerate(zip(images, times_s, strict=True)):
        if frame and time <= times_s[frame - 1]:
            raise ValueError("times must rise")
        for track in live:
            _predict(track, time - times_s[frame - 1])
        left = _associate(live, _sights(image))
        ended = [t for t in live if time - times_s[t.first + t.last_pose] > _LOST_S or t.spread > _REACH]
        done += ended
        live = [t for t in live if t not in ended] + [_born(frame, sight, pose) for sight, pose in left]
    whole = [t for t in done + live if sum(pose is not None for pose in t.poses()) >= _CONFIRMED]
    whole.sort(key=lambda t: t.first)
    return [_smoothed(track, number, times_s) for number, track in enumerate(whole, start=1)]


def _sights(image: Located) -> list[Sight]:
    view, poses = image.view, image.poses
    out = []
    for i, good in enumerate(image.good):
        pose = Measured(
            place=poses.position[i, :2],
            covariance=poses.covariance[i, :2, :2] + _FLOOR**2 * np.eye(2),
            height=float(poses.position[i, 2]),
            heading=float(poses.yaw[i]),
            heading_sigma=float(np.sqrt(poses.covariance[i, 3, 3])),
            size_lwh=poses.size_lwh[i],
            kind=poses.types[i],
        )
        vehicle = view.truth[i]
        truth = vehicle.track_id if vehicle else None
        out.append(Sight(view.boxes[i], float(view.scores[i]), truth, pose if good else None))
    return out


def _born(frame: int, sight: Sight, pose: Measured) -> _Open:
    mean = np.array([*pose.place, 0, 0, 0, 0], dtype=np.float64)
    spread = np.diag([0, 0, 15.0**2, 15.0**2, 2.0**2, 2.0**2]).astype(np.float64)
    spread[:2, :2] = pose.covariance
    return _Open([sight], frame, [(mean, spread)], [(mean, spread)], [np.eye(6)])


def _predict(track: _Open, dt: float) -> None:
    """One step of Singer's model (IEEE Trans. AES, 1970): acceleration fades away, so that what is unseen rolls on.

    The noise is that of constant acceleration (Bar-Shalom et al. 2001, section 6.2.3), the model's own for short steps.
    """
    fade = math.exp(-dt / _MEMORY_S)
    to_speed = _MEMORY_S * (1 - fade)
    F1 = np.array([[1, dt, _MEMORY_S * (dt - to_speed)], [0, 1, to_speed], [0, 0, fade]])
    Q1 = _JERK * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    F, Q = np.kron(F1, np.eye(2)), np.kron(Q1, np.eye(2))
    mean, spread = track.state
    ahead = (F @ mean, F @ spread @ F.T + Q)
    track.steps.append(F)
    track.predicted.append(ahead)
    track.filtered.append(ahead)
    track.sights.append(None)


def _associate(live: list[_Open], sights: list[Sight]) -> list[tuple[Sight, Measured]]:
    """Give sights to tracks, first by place, then by box; returns those with a pose that nobody took."""
    posed = [(sight, sight.pose) for sight in sights if sight.pose is not None]
    rest = [sight for sight in sights if sight.pose is None]
    cost = np.array([[_distance(track, pose) for _, pose in posed] for track in live]).reshape(len(live), len(posed))
    taken = set()
    for t, s in zip(*linear_sum_assignment(np.minimum(cost, _ELSEWHERE)), strict=True):
        if cost[t, s] < _GATE:
            _update(live[t], *posed[s])
            taken.add(s)
    free = [track for track in live if track.sights[-1] is None]
    if free and rest:
        overlap = box_math.iou(
            box_math.xywh_to_xyxy(np.array([track.last_sight.bbox for track in free])),
            box_math.xywh_to_xyxy(np.array([sight.bbox for sight in rest])),
        )
        for t, s in zip(*linear_sum_assignment(-overlap), strict=True):
            if overlap[t, s] >= _OVERLAP:
                free[t].sights[-1] = rest[s]
    return [pair for i, pair in enumerate(posed) if i not in taken]


def _distance(track: _Open, pose: Measured) -> float:
    """Squared distance of a pose from where the track should be, in variances."""
    mean, spread = track.state
    away = pose.place - mean[:2]
    if away @ away > _REACH**2:
        return _ELSEWHERE
    S = spread[:2, :2] + pose.covariance + _SLACK**2 * np.eye(2)
    return float(away @ np.linalg.solve(S, away))


def _update(track: _Open, sight: Sight, pose: Measured) -> None:
    mean, spread = track.state
    gain = np.linalg.solve(spread[:2, :2] + pose.covariance, spread[:2]).T
    kept = np.eye(len(mean))
    kept[:, :2] -= gain
    # Joseph's form stays symmetric and positive over any number of steps.
    after = kept @ spread @ kept.T + gain @ pose.covariance @ gain.T
    track.filtered[-1] = (mean + gain @ (pose.place - mean[:2]), after)
    track.sights[-1] = sight
    track.last_pose = len(track.sights) - 1


def _smoothed(track: _Open, number: int, times_s: Sequence[float]) -> Track:
    count = track.last_pose + 1
    means = np.array([mean for mean, _ in track.filtered[:count]])
    for k in range(count - 2, -1, -1):
        ahead, spread_ahead = track.predicted[k + 1]
        gain = np.linalg.solve(spread_ahead, track.steps[k + 1] @ track.filtered[k][1]).T
        means[k] += gain @ (means[k + 1] - ahead)
    poses = track.poses()[:count]
    frames = np.arange(track.first, track.first + count)
    known = [(frame, pose) for frame, pose in zip(frames, poses, strict=True) if pose is not None]
    kinds = [pose.kind for _, pose in known]
    z = np.interp(frames, [frame for frame, _ in known], [pose.height for _, pose in known])
    return Track(
        number=number,
        kind=max(set(kinds), key=kinds.count),
        size_lwh=np.median([pose.size_lwh for _, pose in known], axis=0),
        frames=frames,
        times_s=np.asarray(times_s)[frames],
        position=np.column_stack([means[:, :2], z]),
        velocity=means[:, 2:4],
        acceleration=means[:, 4:6],
        heading=_headings(poses, means[:, 2:4]),
        sights=tuple(track.sights[:count]),
    )


def _headings(poses: Sequence[Measured | None], velocity: Array) -> Array:
    """(M,) measured headings, front and rear as travel has them, averaged over a second; travel's where none was seen.

    Vehicles drive forwards. One that stands keeps the sense that it has when it moves next, or moved last; one that
    never moves that of most of its poses.
    """
    known = np.array([pose is not None for pose in poses])
    weight = np.array([0.0 if pose is None else 1 / pose.heading_sigma**2 for pose in poses])
    unit = np.array([0j if pose is None else cmath.rect(1, pose.heading) for pose in poses])
    travel: NDArray[np.complex128] = velocity[:, 0] + 1j * velocity[:, 1]
    moving = np.flatnonzero(known & (np.abs(travel) > _MOVING))
    if moving.size:
        unit[moving] = unit[moving] * _sense(unit[moving], travel[moving])
        nearest = moving[np.abs(np.arange(len(unit))[:, None] - moving).argmin(axis=1)]
        unit = unit * _sense(unit, unit[nearest])
    else:
        sense = _sense(unit, unit[weight.argmax()])
        unit = unit * sense * (1 if sense[known].sum() >= 0 else -1)
    window = np.abs(np.arange(len(unit))[:, None] - np.arange(len(unit))) <= _WINDOW
    smooth = (window * weight) @ unit
    return np.asarray(np.angle(np.where(np.abs(smooth) > 0, smooth, travel)))


def _sense(unit: NDArray[np.complex128], reference: NDArray[np.complex128] | complex) -> Array:
    """1 where directions agree with the reference to 90 degrees, else -1."""
    return np.where(np.real(unit * np.conj(reference)) < 0, -1.0, 1.0)
