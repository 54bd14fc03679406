"""Headways and gaps between vehicles at a gate, and occupancy of the gate.

The definitions are those of the Highway Capacity Manual. Headway is from front to front, gap from rear to front, in
seconds. Occupancy is the share of time in which a vehicle is over the detector, here the gate's line.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from skope.schema import PEDESTRIAN_CATEGORY, VEHICLE_CATEGORY
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gates import GateCrossing
from skope.traffic.observation import Observation


@dataclass(frozen=True, kw_only=True, eq=False)
class Headway:
    """Headway and gap between two consecutive vehicles at a gate."""

    leader: GateCrossing
    follower: GateCrossing
    headway_s: float
    """Time between the fronts of both vehicles, seconds; NaN if the crossing of a front was not seen."""
    gap_s: float
    """Time from the rear of the first vehicle to the front of the second, seconds; NaN if either was not seen."""
    sigma_s: float
    """Standard deviation of `headway_s` and `gap_s`, seconds."""


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """Time for which the line of a gate was occupied in a counting interval."""

    interval: ClockInterval
    gate: str
    direction: str
    lane: str
    """Name of the lane. Empty for vehicles in no lane; if the site has no lanes, for the whole gate."""
    observed_s: float
    occupied_s: float
    sigma_s: float
    """Standard deviation of `occupied_s`, seconds."""
    excluded_vehicles: int
    """Number of vehicles excluded because the crossing of their front or rear was not seen."""


def lane_streams(crossings: Sequence[GateCrossing]) -> Iterator[list[GateCrossing]]:
    """Yield the road users of each gate, direction and lane, in order of the crossing of their fronts.

    Pedestrians are excluded.
    """

    def key(crossing: GateCrossing) -> tuple[str, int, str]:
        return crossing.gate, crossing.direction, crossing.lane

    driving = [crossing for crossing in crossings if crossing.trajectory.category != PEDESTRIAN_CATEGORY]
    for _, stream in itertools.groupby(sorted(driving, key=key), key):
        yield sorted(stream, key=lambda crossing: crossing.time_s if math.isnan(crossing.front_s) else crossing.front_s)


def headways(crossings: Sequence[GateCrossing], observation: Observation) -> list[Headway]:
    """Return the headways of consecutive vehicles, if the time between them was fully observed."""
    out = [
        Headway(
            leader=leader,
            follower=follower,
            headway_s=follower.front_s - leader.front_s,
            gap_s=follower.front_s - leader.rear_s,
            sigma_s=math.hypot(leader.end_sigma_s, follower.end_sigma_s),
        )
        for stream in lane_streams(crossings)
        for leader, follower in itertools.pairwise(stream)
        if observation.together(leader.time_s, follower.time_s)
    ]
    return sorted(out, key=lambda headway: headway.follower.time_s)


def occupancies(
    crossings: Sequence[GateCrossing], intervals: Sequence[ClockInterval], observation: Observation
) -> list[Occupancy]:
    """Return the occupancy of each gate, direction and lane in each counting interval, if observed at least in part.

    Only vehicles are included, because lengths of two-wheelers and pedestrians are not measured.

    Args:
        crossings: The crossings that are counted.
        intervals: The intervals.
        observation: The observed times.
    """
    out = []
    for stream in lane_streams(
        [crossing for crossing in crossings if crossing.trajectory.category == VEHICLE_CATEGORY]
    ):
        for interval in intervals:
            observed_s = observation.seconds_in(interval.begin_s, interval.end_s)
            if observed_s <= 0:
                continue
            in_interval = [crossing for crossing in stream if interval.begin_s <= crossing.time_s < interval.end_s]
            whole = [crossing for crossing in stream if not math.isnan(crossing.rear_s - crossing.front_s)]
            spans = [
                (max(crossing.front_s, interval.begin_s), min(crossing.rear_s, interval.end_s)) for crossing in whole
            ]
            inside = [(span, crossing) for span, crossing in zip(spans, whole, strict=True) if span[1] > span[0]]
            out.append(
                Occupancy(
                    interval=interval,
                    gate=stream[0].gate,
                    direction=stream[0].direction_name,
                    lane=stream[0].lane,
                    observed_s=observed_s,
                    occupied_s=_union([span for span, _ in inside]),
                    sigma_s=math.sqrt(sum(2 * crossing.end_sigma_s**2 for _, crossing in inside)),
                    excluded_vehicles=sum(math.isnan(crossing.rear_s - crossing.front_s) for crossing in in_interval),
                )
            )
    return out


def _union(spans: Sequence[tuple[float, float]]) -> float:
    """Return the length of the union of time spans, seconds."""
    total, until = 0.0, -math.inf
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total
