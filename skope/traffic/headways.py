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
    """Time from front to front, seconds; NaN if the crossing of a front was not seen."""
    gap_s: float
    """Time from rear to front, seconds; NaN if the crossing of the rear or the front was not seen."""
    sigma_s: float
    """Standard deviation of `headway_s` and `gap_s`, seconds."""


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """Time for which the line of a gate was occupied in an interval."""

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
    """Number of excluded vehicles: the crossing of their front or rear was not seen."""


def lane_streams(crossings: Sequence[GateCrossing]) -> Iterator[list[GateCrossing]]:
    """Yield the road users of each gate, direction and lane, in order of the crossing of their fronts.

    Pedestrians are excluded.
    """

    def key(one: GateCrossing) -> tuple[str, int, str]:
        return one.gate, one.direction, one.lane

    driving = [one for one in crossings if one.trajectory.category != PEDESTRIAN_CATEGORY]
    for _, own in itertools.groupby(sorted(driving, key=key), key):
        yield sorted(own, key=lambda one: one.time_s if math.isnan(one.front_s) else one.front_s)


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
        for own in lane_streams(crossings)
        for leader, follower in itertools.pairwise(own)
        if observation.together(leader.time_s, follower.time_s)
    ]
    return sorted(out, key=lambda one: one.follower.time_s)


def occupancies(
    crossings: Sequence[GateCrossing], intervals: Sequence[ClockInterval], observation: Observation
) -> list[Occupancy]:
    """Return the occupancy of each gate, direction and lane in each interval that was observed at least in part.

    Only vehicles are included, because the length of other road users is not measured.

    Args:
        crossings: The crossings that are counted.
        intervals: The intervals.
        observation: The observed times.
    """
    out = []
    for own in lane_streams([one for one in crossings if one.trajectory.category == VEHICLE_CATEGORY]):
        for interval in intervals:
            observed_s = observation.seconds_in(interval.begin_s, interval.end_s)
            if observed_s <= 0:
                continue
            there = [one for one in own if interval.begin_s <= one.time_s < interval.end_s]
            whole = [one for one in own if not math.isnan(one.rear_s - one.front_s)]
            spans = [(max(one.front_s, interval.begin_s), min(one.rear_s, interval.end_s)) for one in whole]
            inside = [(span, one) for span, one in zip(spans, whole, strict=True) if span[1] > span[0]]
            out.append(
                Occupancy(
                    interval=interval,
                    gate=own[0].gate,
                    direction=own[0].direction_name,
                    lane=own[0].lane,
                    observed_s=observed_s,
                    occupied_s=_union([span for span, _ in inside]),
                    sigma_s=math.sqrt(sum(2 * one.end_sigma_s**2 for _, one in inside)),
                    excluded_vehicles=sum(math.isnan(one.rear_s - one.front_s) for one in there),
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
