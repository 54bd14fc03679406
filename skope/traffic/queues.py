"""Queues in lanes, and stops and delays of road users.

A vehicle is in a queue from the time at which its speed falls below a first limit until the speed exceeds a second one.
A queue ends where the next such vehicle is too far behind. This is the definition of queue counters in traffic
simulation (VISSIM). Delay follows the Highway Capacity Manual: travel time over a section minus the travel time at
free-flow speed.
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
"""Shifts of all speeds for the bounds of the number of stops, in standard deviations."""
Queue = tuple[float, float, tuple[float, ...]]
"""Length and its standard deviation, metres, and the probability of each vehicle to be real."""
NO_QUEUE: Final[Queue] = (0.0, 0.0, ())


@dataclass(frozen=True, kw_only=True)
class QueueRecord:
    """Longest queue of a lane in a counting interval."""

    interval: ClockInterval
    lane: str
    longest_m: float
    """Length from the front of the first vehicle to the rear of the last vehicle, metres; 0 without a queue."""
    sigma_m: float
    """Standard deviation of `longest_m`, from the positions of both vehicles, metres."""
    longest_at_s: float
    """Time of the longest queue, seconds; NaN without a queue."""
    vehicles: int
    """Number of vehicles in the longest queue."""
    vehicles_expected: CountInterval
    """90% confidence interval of the true number of vehicles in the longest queue."""
    mean_vehicles: float
    """Number of vehicles in the lane's longest queue, averaged over the observed time."""
    mean_between: tuple[float, float]
    """Bounds of `mean_vehicles`: the means over time of the lower and upper bounds, as if all errors were common."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delay:
    """Stops and delay of a road user between two gates."""

    section: SegmentTraversal
    stops: int
    stops_bounds: CountInterval
    """Smallest and largest number of stops if all speeds are shifted by `SPEED_SHIFTS`."""
    stopped_s: float
    """Total duration of the stops, seconds."""
    delay_s: float
    """Delay, seconds; NaN if the free-flow speed is not known."""
    sigma_s: float
    """Standard deviation of the delay, seconds; NaN if the free-flow speed is not known."""


def standing(speed: Array, begin: float, end: float) -> NDArray[np.bool_]:
    """Return whether a road user is stopped at each position.

    Speeds between the two limits keep the state. The initial state is "not stopped".

    Args:
        speed: (M,) speeds of one road user, in order of time.
        begin: Speed below which a stop begins, in the unit of `speed`.
        end: Speed above which a stop ends, in the unit of `speed`.

    Returns:
        (M,) True while the road user is stopped.
    """
    states = np.where(speed < begin, 1, np.where(speed > end, 0, -1))
    known = np.flatnonzero(states >= 0)
    if not len(known):
        return np.zeros(len(speed), dtype=bool)
    latest = np.searchsorted(known, np.arange(len(speed)), side="right") - 1
    return np.asarray((latest >= 0) & (states[known[latest.clip(0)]] == 1))


def stops(
    trajectory: Track, begin_s: float, end_s: float, settings: TrafficSettings, shift: float = 0.0
) -> tuple[int, float]:
    """Return the number of stops in a period and their total duration, seconds.

    Args:
        trajectory: The road user.
        begin_s: Start of the period, seconds.
        end_s: End of the period, seconds.
        settings: A stop begins below `stop_kmh` and ends above twice `stop_kmh`.
        shift: Number of standard deviations that is added to all speeds.
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
    """Return the longest queue of each lane in each counting interval that was observed at least in part.

    Args:
        trajectories: All tracks, in metres.
        lanes: The lanes.
        intervals: The intervals.
        observation: The observed times.
        settings: Speeds at which queues begin and end, and the gap that ends a queue.
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
            bounds = [_between(at_moment[2]) for at_moment in queue]
            out.append(
                QueueRecord(
                    interval=interval,
                    lane=lane.name,
                    longest_m=length,
                    sigma_m=sigma,
                    longest_at_s=here[k] if length else math.nan,
                    vehicles=len(chances),
                    vehicles_expected=bounds[k],
                    mean_vehicles=float(np.mean([len(at_moment[2]) for at_moment in queue])),
                    mean_between=(
                        float(np.mean([bound.low for bound in bounds])),
                        float(np.mean([bound.high for bound in bounds])),
                    ),
                )
            )
    return out


@cache
def _between(chances: tuple[float, ...]) -> CountInterval:
    """Return the confidence interval of the number of vehicles in a queue, including hidden vehicles."""
    return count_interval(chances, queue_miss_rate())


def _in_lane(
    trajectories: Sequence[Track], lanes: LaneMap, lane: int, moments: Array, settings: TrafficSettings
) -> dict[float, Queue]:
    """Return the lane's longest queue by time, for times with a queue."""
    waiting: dict[float, list[tuple[float, float, float, float]]] = {}
    for trajectory in trajectories:
        if not trajectory.confirmed or trajectory.category == PEDESTRIAN_CATEGORY:
            continue
        present = moments[(moments >= trajectory.times_s[0]) & (moments <= trajectory.times_s[-1])]
        begin, end = settings.queue_speed_kmh / KMH_PER_MPS, settings.queue_end_kmh / KMH_PER_MPS
        # An uncertain speed is no evidence of a stopped vehicle.
        slow = standing(trajectory.speed + np.where(trajectory.speed_sigma > begin / 2, end, 0.0), begin, end)
        present = (
            present[trajectory.at(slow.astype(float), present) > 0.5] if len(present) and slow.any() else present[:0]
        )
        if not len(present):
            continue
        places = trajectory.at(trajectory.xy, present)
        spread = worst_sigma(trajectory.at(trajectory.total_covariance, present))
        inside = lanes.indices(places)[0] == lane
        along = lanes.along(lane, places)
        half = trajectory.size[0] / 2
        chance = round(event_probability(trajectory), 2)
        for moment, at, sigma in zip(present[inside].tolist(), along[inside], spread[inside], strict=True):
            waiting.setdefault(moment, []).append((float(at) + half, float(at) - half, float(sigma), chance))
    return {moment: max(_chains(ends, settings.queue_gap_m)) for moment, ends in waiting.items()}


def _chains(ends: Sequence[tuple[float, float, float, float]], most_m: float) -> Iterator[Queue]:
    """Yield each queue.

    `ends` has for each vehicle front and rear along the lane, standard deviation of its position (metres), and
    probability.
    """
    ordered = sorted(ends, reverse=True)
    chain = ordered[:1]
    for vehicle in ordered[1:]:
        if chain[-1][1] - vehicle[0] > most_m:
            yield _queue(chain)
            chain = []
        chain.append(vehicle)
    yield _queue(chain)


def _queue(chain: Sequence[tuple[float, float, float, float]]) -> Queue:
    first, last = chain[0], chain[-1]
    return first[0] - last[1], math.hypot(first[2], last[2]), tuple(sorted(vehicle[3] for vehicle in chain))


def delays(
    sections: Sequence[SegmentTraversal], groups: Sequence[SpeedGroup], settings: TrafficSettings
) -> list[Delay]:
    """Return stops and delay of each traversal between two gates.

    Args:
        sections: The traversals between two gates.
        groups: Speeds of the sections, with 85th percentiles of motor vehicles.
        settings: `free_flow_kmh` is the free-flow speed of all sections. None: the section's 85th percentile of speed,
            if available.
    """
    free: dict[str, tuple[float, float]] = {}
    for group in groups:
        v85 = group.percentiles["v85"]
        if group.kind == "section" and group.interval is None and group.class_name == MOTOR_TRAFFIC and v85.value:
            assert v85.low is not None
            assert v85.high is not None
            free[group.where] = v85.value, (v85.high - v85.low) / 2 / INTERVAL_SIGMAS
    out = []
    for section in sections:
        origin, destination = section.movement.origin, section.movement.destination
        assert origin is not None
        assert destination is not None
        arguments = origin.trajectory, origin.time_s, destination.time_s, settings
        number, stopped_s = stops(*arguments)
        numbers = [number, *(stops(*arguments, shift)[0] for shift in SPEED_SHIFTS)]
        free_flow_kmh = settings.free_flow_kmh
        speed, sigma = (
            (free_flow_kmh / KMH_PER_MPS, 0.0) if free_flow_kmh else free.get(section.name, (math.nan, math.nan))
        )
        out.append(
            Delay(
                section=section,
                stops=number,
                stops_bounds=CountInterval(min(numbers), max(numbers)),
                stopped_s=stopped_s,
                delay_s=section.seconds - section.length_m / speed,
                sigma_s=math.hypot(section.seconds_sigma, section.length_m / speed * sigma / speed),
            )
        )
    return out
