"""Vehicles followed through a video on the ground: association, smoothing, speed and acceleration.

Each vehicle is a point that moves with a slowly changing acceleration (a Kalman filter; Rauch, Tung and Striebel's
smoother afterwards, so that speeds know what came later). A detection joins the track from which it more likely comes
than from a vehicle that nobody has seen before (Jonker and Volgenant's assignment, as scipy has it): what counts is how
certain track and pose are and how much time has passed, not how many frames. For a vehicle without a pose, or whose
pose is elsewhere all of a sudden, the box in the image keeps the track. Trackers of boxes alone would lose what the
poses know: metres, headings and how certain they are.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from skope import boxes as box_math
from skope.eval.tracking.detections import Detection, PoseMeasurement
from skope.eval.tracking.headings import smoothed_headings

Array = NDArray[np.float64]

_JERK: Final = 1.0
"""Spectral density of the change of acceleration, m^2 / s^5: hard braking within a second or two."""
_MEMORY_S: Final = 1.5
"""How long an acceleration lasts."""
_SPEED: Final = 15.0
"""Standard deviation of the speed, m/s, along its heading, of a vehicle that is seen for the first time ..."""
_ASIDE: Final = 2.0
"""... and to its sides."""
_SLIDE: Final = 0.5
"""Standard deviation of a vehicle's speed to its side, m/s ..."""
_SLIP: Final = 0.15
"""... and as a share of its speed: in a turn its middle does not move where its front points."""
_BRAKES: Final = 2.0
"""Of its acceleration, m/s^2."""
_GATE: Final = 16.0
"""Squared distance, in variances, beyond which a detection is another vehicle's."""
_NEW: Final = 2 * math.log(20_000.0)
"""What it costs, as twice a negative log likelihood, to take a detection for a new vehicle: one in 20 000 m^2."""
_SLACK: Final = 0.5
"""Metres added to every prediction's standard deviation when vehicles are told apart ..."""
_SWERVE: Final = 6.0
"""... and how suddenly it may have turned or braked since it was last seen, m/s^2 ..."""
_SWERVE_S: Final = 1.0
"""... for so long."""
_OVERLAP: Final = 0.3
"""Least IoU by which a box without a pose continues a track ..."""
_JUMP: Final = 0.5
"""... and one whose pose says that it is elsewhere."""
_BOX_S: Final = 0.5
"""For how long an unseen vehicle's last box says where it is in the image."""
_JUMPS: Final = 3
"""After so many poses elsewhere that is where the vehicle is."""
_LOST_S: Final = 3.0
"""A track ends when nothing was seen of it for so long."""
_CONFIRMED: Final = 3
"""Fewer poses than this are no track ..."""
_CONFIRMED_S: Final = 0.4
"""... nor are poses over less time."""
_LAG_S: Final = 20.0
"""What was seen so long ago is not changed by what is seen now."""
_TWINS_S: Final = 0.5
"""Two tracks in one place for so long are one vehicle."""
_APART: Final = 2.0
"""One that never was farther from the other than this, metres, in the median, was no vehicle before either."""
_ELSEWHERE: Final = 1e6


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
    boxes: Array
    """(M, 4) of what was seen, x, y, width, height in pixels; NaN where it was missed."""
    scores: Array
    """(M,) NaN where it was missed."""
    truth_ids: NDArray[np.int64]
    """(M,) the ground-truth track that the detection is, or matches; -1 where there is none."""

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(M,) in which frames it was detected."""
        return np.isfinite(self.scores)

    @cached_property
    def speed(self) -> Array:
        """(M,) m/s."""
        return np.asarray(np.linalg.norm(self.velocity, axis=1))

    @cached_property
    def along(self) -> Array:
        """(M,) acceleration in the direction of travel, m/s^2; 0 for a vehicle that stands."""
        speed = self.speed
        dot = np.einsum("mi,mi->m", self.acceleration, self.velocity)
        return np.asarray(np.divide(dot, speed, out=np.zeros_like(speed), where=speed > 0.1))


@dataclass(eq=False, slots=True)
class _Step:
    """A frame of a track: state x, y, vx, vy, ax, ay with covariance, before and after its measurement."""

    frame: int
    time_s: float
    transition: Array
    """(6, 6) from the frame before."""
    predicted: tuple[Array, Array]
    filtered: tuple[Array, Array]
    detection: Detection | None = None


@dataclass(frozen=True, eq=False)
class _Part:
    """Consecutive frames of a track, smoothed, a row each; what was not seen is NaN."""

    frames: NDArray[np.intp]
    times_s: Array
    states: Array
    """(M, 6)"""
    heights: Array
    headings: Array
    """(M,) as measured."""
    heading_sigmas: Array
    sizes: Array
    """(M, 3)"""
    boxes: Array
    scores: Array
    truth_ids: NDArray[np.int64]


@dataclass(eq=False)
class _Open:
    """A track that is being followed."""

    steps: list[_Step]
    """The frames that can still change."""
    body: PoseMeasurement
    """Its last pose, for heading and size."""
    parts: list[_Part] = field(default_factory=list)
    """Those before."""
    kinds: Counter[str] = field(default_factory=Counter)
    last_pose_s: float = 0.0
    jumps: int = 0
    host: "_Open | None" = None
    """The track inside which this one is ..."""
    hosted_s: float = 0.0
    """... since when."""

    @property
    def state(self) -> tuple[Array, Array]:
        return self.steps[-1].filtered

    def box(self, time_s: float) -> Array | None:
        """The last one, unless it is old."""
        for step in reversed(self.steps):
            if time_s - step.time_s > _BOX_S:
                break
            if step.detection is not None:
                return step.detection.bbox
        return self.steps[-2].detection.bbox if len(self.steps) > 1 and self.steps[-2].detection is not None else None


def follow(images: Iterable[Sequence[Detection]], times_s: Sequence[float]) -> list[Track]:
    """Tracks of the vehicles in consecutive images of one camera; `times_s` rise.

    Images are taken one at a time; memory grows by 150 bytes for each vehicle and image.
    """
    live: list[_Open] = []
    done: list[_Open] = []
    before = -math.inf
    for frame, (image, time_s) in enumerate(zip(images, times_s, strict=True)):
        if time_s <= before:
            raise ValueError("times must rise")
        if live:
            F, Q = _motion(time_s - before)
            for track in live:
                _predict(track, frame, time_s, F, Q)
        left = _associate(live, image, time_s)
        ended = {id(track) for track in _twins(live, time_s)}
        ended |= {id(track) for track in live if time_s - track.last_pose_s > _LOST_S}
        for track in live:
            if id(track) in ended:
                _end(track)
                done.append(track)
            elif time_s - track.steps[0].time_s > 2 * _LAG_S:
                _settle(track, time_s - _LAG_S)
        live = [track for track in live if id(track) not in ended] + [_born(frame, time_s, *pair) for pair in left]
        before = time_s
    for track in live:
        _end(track)
    whole = [track for track in done + live if _confirmed(track)]
    whole.sort(key=lambda track: track.parts[0].frames[0])
    return [_whole(track, number) for number, track in enumerate(whole, start=1)]


def _confirmed(track: _Open) -> bool:
    times = [part.times_s for part in track.parts if len(part.times_s)]
    return track.kinds.total() >= _CONFIRMED and bool(times) and bool(times[-1][-1] - times[0][0] >= _CONFIRMED_S)


# ----------------------------------------------------------------------------------------------------- frame by frame


def _born(frame: int, time_s: float, detection: Detection, pose: PoseMeasurement) -> _Open:
    mean = np.array([*pose.place, 0, 0, 0, 0], dtype=np.float64)
    spread = np.zeros((6, 6))
    spread[:2, :2] = pose.covariance
    ahead = np.array([math.cos(pose.heading), math.sin(pose.heading)])
    aside = math.hypot(_ASIDE, _SPEED * min(pose.heading_sigma, 1.0))
    spread[2:4, 2:4] = aside**2 * np.eye(2) + (_SPEED**2 - aside**2) * np.outer(ahead, ahead)
    spread[4:, 4:] = _BRAKES**2 * np.eye(2)
    begin = _Step(frame, time_s, np.eye(6), (mean, spread), (mean, spread), detection)
    return _Open([begin], pose, kinds=Counter([pose.kind]), last_pose_s=time_s)


def _motion(dt: float) -> tuple[Array, Array]:
    """Transition and noise, (6, 6) each, of one step of Singer's model (IEEE Trans. AES, 1970).

    Acceleration fades away, so that what is unseen rolls on. The noise is that of constant acceleration (Bar-Shalom et
    al. 2001, section 6.2.3), the model's own for short steps.
    """
    fade = math.exp(-dt / _MEMORY_S)
    to_speed = _MEMORY_S * (1 - fade)
    F1 = np.array([[1, dt, _MEMORY_S * (dt - to_speed)], [0, 1, to_speed], [0, 0, fade]])
    Q1 = _JERK * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    both = np.eye(2)  # x and y move alike
    return np.asarray(np.kron(F1, both)), np.asarray(np.kron(Q1, both), dtype=np.float64)


def _predict(track: _Open, frame: int, time_s: float, F: Array, Q: Array) -> None:
    mean, spread = track.state
    ahead = (F @ mean, F @ spread @ F.T + Q)
    track.steps.append(_Step(frame, time_s, F, ahead, ahead))


def _associate(live: list[_Open], image: Sequence[Detection], time_s: float) -> list[tuple[Detection, PoseMeasurement]]:
    """Give detections to tracks, first by place, then by box; returns those with a pose that nobody took."""
    posed = [(detection, detection.pose) for detection in image if detection.pose is not None]
    cost = np.array([[_cost(track, pose) for _, pose in posed] for track in live]).reshape(len(live), len(posed))
    left = dict(enumerate(posed))
    for t, s in zip(*linear_sum_assignment(np.minimum(cost, _ELSEWHERE)), strict=True):
        if cost[t, s] < _NEW:
            _update(live[t], *posed[s])
            del left[s]
    _by_box(live, [detection for detection in image if detection.pose is None], _OVERLAP, time_s)
    for detection in _by_box(live, [detection for detection, _ in left.values()], _JUMP, time_s):
        del left[next(s for s, (own, _) in left.items() if own is detection)]
    return _without_twins(live, list(left.values()))


def _without_twins(
    live: Sequence[_Open], new: list[tuple[Detection, PoseMeasurement]]
) -> list[tuple[Detection, PoseMeasurement]]:
    """New vehicles but those in the middle of which another one stands: detectors see many a vehicle twice.

    A track that has not been seen in this image takes such a detection as its own.
    """
    out: list[tuple[Detection, PoseMeasurement]] = []
    for detection, pose in sorted(new, key=lambda pair: -pair[0].score):
        hosts = [track for track in live if _inside(track, pose.place, pose.covariance)]
        unseen = [track for track in hosts if track.steps[-1].detection is None]
        if unseen:
            _seen_elsewhere(unseen[0], detection)
        elif not hosts and not any(_within(other, pose.place - other.place, pose.covariance) for _, other in out):
            out.append((detection, pose))
    return out


def _inside(track: _Open, place: Array, spread: Array) -> bool:
    """Whether a place (2,), known as well as `spread` (2, 2) says, is inside a track's vehicle."""
    mean, own = track.state
    return _within(track.body, place - mean[:2], spread + own[:2, :2])


def _within(body: PoseMeasurement, away: Array, spread: Array) -> bool:
    """Whether what is `away` from a vehicle's middle is inside it, give or take a standard deviation.

    Of far ones that is more than the way to the next in a queue or a car park: at most half a width is given to the
    sides, and a quarter of the length ahead.
    """
    x, y = away.tolist()
    (a, b), (_, d) = spread.tolist()
    length, width, _ = body.size_lwh.tolist()
    cos, sin = math.cos(body.heading), math.sin(body.heading)
    along = math.sqrt(a * cos * cos + 2 * b * cos * sin + d * sin * sin)
    across = math.sqrt(a * sin * sin - 2 * b * cos * sin + d * cos * cos)
    ahead, aside = abs(x * cos + y * sin), abs(y * cos - x * sin)
    return bool(ahead <= length / 2 + min(along, length / 4) and aside <= width / 2 + min(across, width / 2))


def _twins(live: list[_Open], time_s: float) -> list[_Open]:
    """The tracks that have been inside another one for so long that both are one vehicle; they end before that.

    What was seen of them since then is the other's.
    """
    hosts: list[_Open] = []
    twins: list[_Open] = []
    for track in sorted(live, key=lambda one: -one.kinds.total()):
        mean, spread = track.state
        host = next((one for one in hosts if _inside(one, mean[:2], spread[:2, :2])), None)
        if host is None or host is not track.host:
            track.host, track.hosted_s = host, time_s
        if host is None or time_s - track.hosted_s < _TWINS_S:
            hosts.append(track)
        else:
            _join(host, track)
            twins.append(track)
    return twins


def _join(host: _Open, twin: _Open) -> None:
    own = {step.frame: step for step in host.steps}
    before = [step for step in twin.steps if step.time_s < twin.hosted_s]
    apart = [
        float(np.linalg.norm(step.filtered[0][:2] - own[step.frame].filtered[0][:2])) if step.frame in own else math.inf
        for step in before
        if step.detection is not None
    ]
    if not twin.parts and float(np.median(apart or [0.0])) < _APART:
        before = []
    for step in twin.steps[len(before) :]:
        if step.detection is None:
            continue
        if step.detection.pose is not None:
            twin.kinds[step.detection.pose.kind] -= 1
        if (same := own.get(step.frame)) is not None and same.detection is None:
            same.detection = replace(step.detection, pose=None)
    twin.steps = before
    posed = [step.time_s for step in before if step.detection is not None and step.detection.pose is not None]
    twin.last_pose_s = posed[-1] if posed else -math.inf


def _cost(track: _Open, pose: PoseMeasurement) -> float:
    """Twice the negative log likelihood of a pose where the track should be; infinite out of its reach."""
    mean, spread = track.state
    away = pose.place - mean[:2]
    unseen_s = min(_SWERVE_S, track.steps[-1].time_s - track.last_pose_s)
    S = spread[:2, :2] + pose.covariance + (_SLACK**2 + (_SWERVE * unseen_s**2 / 2) ** 2) * np.eye(2)
    (a, b), (_, d) = S.tolist()
    x, y = away.tolist()
    det = a * d - b * b
    squared = (d * x * x - 2 * b * x * y + a * y * y) / det
    return squared + math.log(4 * math.pi**2 * det) if squared < _GATE else math.inf


def _by_box(live: list[_Open], rest: list[Detection], least: float, time_s: float) -> list[Detection]:
    """Give detections to tracks that have none yet by the overlap with their last boxes; returns those it gave."""
    unseen = [track for track in live if track.steps[-1].detection is None]
    free = [(track, box) for track in unseen if (box := track.box(time_s)) is not None]
    if not free or not rest:
        return []
    overlap = box_math.iou(
        box_math.xywh_to_xyxy(np.array([box for _, box in free])),
        box_math.xywh_to_xyxy(np.array([detection.bbox for detection in rest])),
    )
    given = []
    for t, s in zip(*linear_sum_assignment(-overlap), strict=True):
        if overlap[t, s] >= least:
            _seen_elsewhere(free[t][0], rest[s])
            given.append(rest[s])
    return given


def _seen_elsewhere(track: _Open, detection: Detection) -> None:
    """Note a detection by its box; where it keeps saying that the vehicle is elsewhere, believe it."""
    track.jumps += detection.pose is not None
    if detection.pose is None or track.jumps < _JUMPS:
        track.steps[-1].detection = replace(detection, pose=None)
        return
    step = track.steps[-1]
    mean, spread = step.filtered
    away = detection.pose.place - mean[:2]
    wider = spread.copy()
    wider[:2, :2] += away @ away * np.eye(2)
    wider[2:4, 2:4] += _SPEED**2 * np.eye(2)
    step.predicted = step.filtered = (mean, wider)
    _update(track, detection, detection.pose)


def _update(track: _Open, detection: Detection, pose: PoseMeasurement) -> None:
    step = track.steps[-1]
    mean, spread = step.filtered
    gain = np.linalg.solve(spread[:2, :2] + pose.covariance, spread[:2]).T
    kept = np.eye(len(mean))
    kept[:, :2] -= gain
    # Joseph's form stays symmetric and positive over any number of steps.
    after = kept @ spread @ kept.T + gain @ pose.covariance @ gain.T
    step.filtered = _rolling(mean + gain @ (pose.place - mean[:2]), after, pose)
    step.detection = detection
    track.body = pose
    track.kinds[pose.kind] += 1
    track.last_pose_s = step.time_s
    track.jumps = 0


def _rolling(mean: Array, spread: Array, pose: PoseMeasurement) -> tuple[Array, Array]:
    """State and covariance, knowing that wheels roll where the vehicle heads, or back: it hardly slides to its side."""
    aside = np.array([0, 0, -math.sin(pose.heading), math.cos(pose.heading), 0, 0])
    speed = float(np.linalg.norm(mean[2:4]))
    slides = float(aside @ mean)
    variance = _SLIDE**2 + (speed * math.hypot(_SLIP, pose.heading_sigma)) ** 2
    across = spread @ aside
    total = float(aside @ across) + variance
    if slides**2 > _GATE * total:  # the pose is turned
        return mean, spread
    gain = across / total
    kept = np.eye(len(mean)) - np.outer(gain, aside)
    return mean - gain * slides, kept @ spread @ kept.T + variance * np.outer(gain, gain)


# ---------------------------------------------------------------------------------------------------------- smoothing


def _settle(track: _Open, until_s: float) -> None:
    """Smooth a long track and keep what came before `until_s` for good."""
    count = sum(step.time_s < until_s for step in track.steps)
    track.parts.append(_part(track.steps[:count], _smoothed(track.steps)[:count]))
    del track.steps[:count]


def _end(track: _Open) -> None:
    """Smooth the rest of a track, up to its last pose."""
    track.steps = [step for step in track.steps if step.time_s <= track.last_pose_s]
    track.parts.append(_part(track.steps, _smoothed(track.steps)))
    track.steps = []


def _smoothed(steps: Sequence[_Step]) -> Array:
    """(M, 6)"""
    states = np.array([step.filtered[0] for step in steps]).reshape(-1, 6)
    for k in range(len(steps) - 2, -1, -1):
        ahead, spread_ahead = steps[k + 1].predicted
        gain = np.linalg.solve(spread_ahead, steps[k + 1].transition @ steps[k].filtered[1]).T
        states[k] += gain @ (states[k + 1] - ahead)
    return states


def _part(steps: Sequence[_Step], states: Array) -> _Part:
    count = len(steps)
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
    return _Part(
        frames=np.array([step.frame for step in steps], dtype=np.intp),
        times_s=np.array([step.time_s for step in steps]),
        states=states,
        heights=heights,
        headings=headings,
        heading_sigmas=heading_sigmas,
        sizes=sizes,
        boxes=boxes,
        scores=scores,
        truth_ids=truth_ids,
    )


def _whole(track: _Open, number: int) -> Track:
    names = [one.name for one in fields(_Part)]
    all_of = {name: np.concatenate([getattr(part, name) for part in track.parts]) for name in names}
    track.parts = []  # twice the memory otherwise
    states, known = all_of["states"], np.isfinite(all_of["headings"])
    times = all_of["times_s"]
    z = np.interp(times, times[known], all_of["heights"][known])
    return Track(
        number=number,
        kind=track.kinds.most_common(1)[0][0],
        size_lwh=np.median(all_of["sizes"][known], axis=0),
        frames=all_of["frames"],
        times_s=times,
        position=np.column_stack([states[:, :2], z]),
        velocity=states[:, 2:4],
        acceleration=states[:, 4:6],
        heading=smoothed_headings(times, all_of["headings"], all_of["heading_sigmas"], states[:, 2:4]),
        boxes=all_of["boxes"],
        scores=all_of["scores"],
        truth_ids=all_of["truth_ids"],
    )
