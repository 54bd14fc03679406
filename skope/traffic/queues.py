"""Queues in lanes, and the stops and delays of those who pass.

A vehicle stands in a queue from when it is slower than one speed until it is faster than another one, and a queue ends
where the next such vehicle is too far behind, as the queue counters of traffic simulation (VISSIM) have it. Delay is
the Highway Capacity Manual's: travel time over a section less what it takes at the speed of free flow.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.confidence_level import INTERVAL_SIGMAS
from skope.schema import PEDESTRIAN_CATEGORY
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import KMH_PER_MPS, Track, worst_sigma
from skope.traffic.count_uncertainty import CountInterval, count_interval
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import event_probability, queue_miss_rate
from skope.traffic.lanes import LaneMap
from skope.traffic.observation import Observation
from skope.traffic.speeds import MOTOR_TRAFFIC, SegmentTraversal, SpeedGroup
from skope.types import Array


@dataclass(frozen=True)
class QueueTimes:
    """Times of queues and stops."""

    step_s: float = 1.0
    """Interval at which queues are measured, seconds."""
    stop_s: float = 1.0
    """Shortest stop, seconds."""


QUEUE_TIMES: Final = QueueTimes()

SPEED_SHIFTS: Final = (-INTERVAL_SIGMAS, -INTERVAL_SIGMAS / 2, INTERVAL_SIGMAS / 2, INTERVAL_SIGMAS)
"""Shifts of the speeds that are tried, in standard deviations. One stop at one speed may be two or none at another."""
Queue = tuple[float, float, tuple[float, ...]]
"""Length and its standard deviation, metres, and how probable each of the vehicles is."""
NO_QUEUE: Final[Queue] = (0.0, 0.0, ())


@dataclass(frozen=True, kw_only=True)
class QueueRecord:
    """The longest queue of a lane in an interval."""

    interval: ClockInterval
    lane: str
    longest_m: float
    """From the front of the first vehicle to the rear of the last one, metres; 0 without a queue."""
    sigma_m: float
    """Standard deviation of that, from both places, metres."""
    longest_at_s: float
    """Time at which it was so long, seconds; NaN without a queue."""
    vehicles: int
    """In the longest queue."""
    vehicles_expected: CountInterval
    """Between which numbers there were in it."""
    mean_vehicles: float
    """In the lane's longest queue, in the mean of the time that was observed."""
    mean_between: tuple[float, float]
    """Between which numbers that is: the mean of the bounds of all moments, as if all were off together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delay:
    """Stops and delay of a road user between two gates."""

    section: SegmentTraversal
    stops: int
    stops_bounds: CountInterval
    """Between which numbers of stops there were: where all speeds are off by as much as their errors allow."""
    stopped_s: float
    delay_s: float
    """Seconds; NaN where the speed of free flow is not known."""
    sigma_s: float
    """Standard deviation of the delay, seconds; NaN likewise."""


def standing(speed: Array, begin: float, end: float) -> NDArray[np.bool_]:
    """(M,) whether somebody stands; before the first speed that tells, it does not.

    Args:
        speed: (M,) of one road user, in order of time.
        begin: Who is slower begins to stand, in the unit of `speed`.
        end: Who is faster drives again.
    """
    told = np.where(speed < begin, 1, np.where(speed > end, 0, -1))
    known = np.flatnonzero(told >= 0)
    if not len(known):
        return np.zeros(len(speed), dtype=bool)
    latest = np.searchsorted(known, np.arange(len(speed)), side="right") - 1
    return np.asarray((latest >= 0) & (told[known[latest.clip(0)]] == 1))


def stops(
    trajectory: Track, begin_s: float, end_s: float, settings: TrafficSettings, shift: float = 0.0
) -> tuple[int, float]:
    """Number of stops between two times, and how many seconds they last in all.

    Args:
        trajectory: Who it is.
        begin_s: The one time, seconds.
        end_s: The other time, seconds.
        settings: Somebody stands from under `stop_kmh` until over twice that.
        shift: By how many of their standard deviations all speeds are taken to be larger.
    """
    times = trajectory.times_s
    rows = np.flatnonzero((times >= begin_s) & (times <= end_s))
    if not len(rows):
        return 0, 0.0
    speed = trajectory.speed[rows] + shift * trajectory.speed_sigma[rows]
    slow = standing(speed, settings.stop_kmh / KMH_PER_MPS, 2 * settings.stop_kmh / KMH_PER_MPS)
    runs = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(slow)) + 1)
    lengths = [float(times[rows[run[-1]]] - times[rows[run[0]]]) for run in runs if slow[run[0]]]
    lasting = [length for length in lengths if length >= QUEUE_TIMES.stop_s]
    return len(lasting), sum(lasting)


def queues(
    trajectories: Sequence[Track],
    lanes: LaneMap,
    intervals: Sequence[ClockInterval],
    observation: Observation,
    settings: TrafficSettings,
) -> list[QueueRecord]:
    """The longest queue of each lane, in each interval of which something was observed.

    Args:
        trajectories: All tracks, in metres.
        lanes: The lanes.
        intervals: The intervals.
        observation: When was observed.
        settings: Speeds at which queues begin and end, and the gap that ends one.
    """
    spans = observation.spans
    moments = np.unique(
        np.concatenate([np.arange(math.ceil(a), b, QUEUE_TIMES.step_s) for a, b in spans] or [np.zeros(0)])
    )
    found = [
        _in_lane(trajectories, lanes, k, moments, settings) if len(moments) else {} for k in range(len(lanes.lanes))
    ]
    out = []
    for interval in intervals:
        here = moments[(moments >= interval.begin_s) & (moments < interval.end_s)].tolist()
        if not here:
            continue
        for lane, of_moment in zip(lanes.lanes, found, strict=True):
            queue = [of_moment.get(moment, NO_QUEUE) for moment in here]
            k = max(range(len(here)), key=lambda k: queue[k][0])
            length, sigma, chances = queue[k]
            bounds = [_between(one[2]) for one in queue]
            out.append(
                QueueRecord(
                    interval=interval,
                    lane=lane.name,
                    longest_m=length,
                    sigma_m=sigma,
                    longest_at_s=here[k] if length else math.nan,
                    vehicles=len(chances),
                    vehicles_expected=bounds[k],
                    mean_vehicles=float(np.mean([len(one[2]) for one in queue])),
                    mean_between=(
                        float(np.mean([one.low for one in bounds])),
                        float(np.mean([one.high for one in bounds])),
                    ),
                )
            )
    return out


@cache
def _between(chances: tuple[float, ...]) -> CountInterval:
    """Interval of the number in a queue of vehicles that are so probable, with those that the queue hides."""
    return count_interval(chances, queue_miss_rate())


def _in_lane(
    trajectories: Sequence[Track], lanes: LaneMap, lane: int, moments: Array, settings: TrafficSettings
) -> dict[float, Queue]:
    """The lane's longest queue, where there is one, by moment."""
    waiting: dict[float, list[tuple[float, float, float, float]]] = {}
    for trajectory in trajectories:
        if not trajectory.confirmed or trajectory.category == PEDESTRIAN_CATEGORY:
            continue
        there = moments[(moments >= trajectory.times_s[0]) & (moments <= trajectory.times_s[-1])]
        begin, end = settings.queue_speed_kmh / KMH_PER_MPS, settings.queue_end_kmh / KMH_PER_MPS
        # A speed that is not known so well is no sign of standing.
        slow = standing(trajectory.speed + np.where(trajectory.speed_sigma > begin / 2, end, 0.0), begin, end)
        there = there[trajectory.at(slow.astype(float), there) > 0.5] if len(there) and slow.any() else there[:0]
        if not len(there):
            continue
        places = trajectory.at(trajectory.xy, there)
        spread = worst_sigma(trajectory.at(trajectory.total_covariance, there))
        inside = lanes.indices(places)[0] == lane
        along = lanes.along(lane, places)
        half = trajectory.size[0] / 2
        chance = round(event_probability(trajectory), 2)
        for moment, at, sigma in zip(there[inside].tolist(), along[inside], spread[inside], strict=True):
            waiting.setdefault(moment, []).append((float(at) + half, float(at) - half, float(sigma), chance))
    return {moment: max(_chains(ends, settings.queue_gap_m)) for moment, ends in waiting.items()}


def _chains(ends: Sequence[tuple[float, float, float, float]], most_m: float) -> Iterator[Queue]:
    """Each queue.

    `ends` are the fronts and rears of vehicles along the lane, the standard deviations of their places, metres, and how
    probable they are.
    """
    ordered = sorted(ends, reverse=True)
    chain = ordered[:1]
    for one in ordered[1:]:
        if chain[-1][1] - one[0] > most_m:
            yield _queue(chain)
            chain = []
        chain.append(one)
    yield _queue(chain)


def _queue(chain: Sequence[tuple[float, float, float, float]]) -> Queue:
    first, last = chain[0], chain[-1]
    return first[0] - last[1], math.hypot(first[2], last[2]), tuple(sorted(one[3] for one in chain))


def delays(
    sections: Sequence[SegmentTraversal], groups: Sequence[SpeedGroup], settings: TrafficSettings
) -> list[Delay]:
    """Stops and delay of everyone who was seen at two gates.

    Args:
        sections: Everyone who was seen at two gates.
        groups: Speeds of the sections, with 85th percentiles of motor vehicles.
        settings: `free_flow_kmh` is the speed of free flow on all sections; None: the 85th percentile, where it is
            known.
    """
    free: dict[str, tuple[float, float]] = {}
    for group in groups:
        v85 = group.percentiles["v85"]
        if group.kind == "section" and group.interval is None and group.class_name == MOTOR_TRAFFIC and v85.value:
            assert v85.low is not None
            assert v85.high is not None
            free[group.where] = v85.value, (v85.high - v85.low) / 2 / INTERVAL_SIGMAS
    out = []
    for one in sections:
        origin, destination = one.movement.origin, one.movement.destination
        assert origin is not None
        assert destination is not None
        told_of = origin.trajectory, origin.time_s, destination.time_s, settings
        number, stopped_s = stops(*told_of)
        numbers = [number, *(stops(*told_of, shift)[0] for shift in SPEED_SHIFTS)]
        told = settings.free_flow_kmh
        speed, sigma = (told / KMH_PER_MPS, 0.0) if told else free.get(one.name, (math.nan, math.nan))
        out.append(
            Delay(
                section=one,
                stops=number,
                stops_bounds=CountInterval(min(numbers), max(numbers)),
                stopped_s=stopped_s,
                delay_s=one.seconds - one.length_m / speed,
                sigma_s=math.hypot(one.seconds_sigma, one.length_m / speed * sigma / speed),
            )
        )
    return out
