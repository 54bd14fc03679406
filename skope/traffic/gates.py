"""Crossings of gates: one for each time that a road user goes from one side to the other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import VEHICLE_LENGTH_SIGMA_M, Track, is_in_traffic
from skope.traffic.event_probability import COUNTED_FROM, crossing_probability, event_probability, usual_step
from skope.traffic.lanes import LaneMap
from skope.traffic.normal_distribution import at_most
from skope.traffic.passages import Passage, passages
from skope.types import Array

_SLOWEST: Final = 0.05
"""Speed along the normal, m/s, under which a place says nothing more of the time."""

_SURE: Final = 3.0
"""The hysteresis is so many standard deviations of a place along the normal at least: who stands jitters by that."""
_NEAR_M: Final = 5.0
"""So near to a gate it counts how certain places are."""
_ALONG_M: Final = {"bus": 0.6, "bicycle": 0.6, "lorry": 0.15}
"""By so much the middles of some bodies are off along the way besides, all the way, one standard deviation: of 16, 36
and 12 in generated clips by 0.2, 0.5 and 0 m in the median, and by 0.54, 0.45 and 0.17 m from there."""
_BESIDE: Final = 0.05
"""A crossing that is less probably through the gate than this goes past its end without doubt, and the reverse."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GateCrossing:
    """A road user crosses a gate."""

    trajectory: Track
    gate: str
    direction: int
    """0 from the gate's left to its right as it is drawn, 1 back."""
    direction_name: str
    """Name of that direction; "1" and "2" where the user gives none."""
    time_s: float
    """Time at which the body's middle crosses, seconds of the footage."""
    sigma_s: float
    """Standard deviation of the times, from how well the places are known."""
    front_s: float
    """Time at which the front crosses; NaN where the track does not show it."""
    rear_s: float
    """Time at which the rear does; NaN likewise."""
    place: Array
    """(2,) where, metres."""
    speed: float
    """m/s."""
    speed_sigma: float
    lane: str
    """Name of the lane; empty where it is in none."""
    lane_probability: float
    """Probability that it is right."""
    probability: float
    """Probability that this happened, once."""
    doubt: str
    """Reason for doubt: begins or ends, where the track does so on the gate; beside, where it may have gone past the
    gate's end, or through it; else empty."""
    counts: bool
    """Whether it is counted: between the ends of the gate, by a track that more probably crosses there than not. One
    that ends on the gate is counted, and is in doubt."""

    @cached_property
    def end_sigma_s(self) -> float:
        """Standard deviation of the times of front and rear, seconds."""
        return math.hypot(self.sigma_s, VEHICLE_LENGTH_SIGMA_M / 2 / max(self.speed, _SLOWEST))


def direction_names(gate: Gate) -> tuple[str, str]:
    """Names of crossings from left to right, and back."""
    return gate.directions or ("1", "2")


def gates_on_road(gates: Sequence[Gate]) -> tuple[Gate, ...]:
    """The gates that have a `line` on the road."""
    return tuple(gate for gate in gates if gate.line)


def gates_in_image(gates: Sequence[Gate]) -> tuple[Gate, ...]:
    """The gates that have `pixels`, as lines among positions whose y is the negative image row."""
    return tuple(replace(gate, line=tuple((u, -v) for u, v in gate.pixels)) for gate in gates if gate.pixels)


def may_count(trajectory: Track, settings: TrafficSettings) -> bool:
    """Whether who crosses a gate counts: a road user in traffic, of the classes that are counted."""
    return is_in_traffic(trajectory) and trajectory.class_name in settings.classes


def gate_crossings(
    trajectories: Sequence[Track],
    gates: Sequence[Gate],
    lanes: LaneMap,
    settings: TrafficSettings,
    *,
    metres: bool = True,
) -> list[GateCrossing]:
    """All crossings of all gates, in order of time; tracks that are not confirmed, or never moved, have none.

    Args:
        trajectories: All tracks.
        gates: All gates.
        lanes: The lanes; in which one crosses is said.
        settings: The classes that are counted, and how far somebody has to be seen on either side.
        metres: Places are in metres, with how certain they are, which tells how probable a crossing is; in pixels
            nothing does.
    """
    step_s = usual_step(trajectories) if metres else None
    found = [
        crossing
        for trajectory in trajectories
        if may_count(trajectory, settings)
        for gate in gates
        for crossing in _of_one(trajectory, gate, lanes, settings, step_s)
    ]
    return sorted(found, key=lambda one: (one.time_s, one.trajectory.number, one.gate))


def _axis(gate: Gate) -> tuple[Array, Array]:
    """(2,) a gate's first end, and the (2,) unit vector from there to the other one."""
    start, end = np.array(gate.line)
    return start, (end - start) / np.linalg.norm(end - start)


def signed_distances(gate: Gate, places: Array) -> tuple[Array, Array]:
    """(M,) distances of places (M, 2) from the gate's line, positive to its left, and (M,) how far along it they lie.

    Both in metres; along it counts from the first end.
    """
    start, along = _axis(gate)
    away = places - start
    return along[0] * away[:, 1] - along[1] * away[:, 0], away @ along


def _of_one(
    trajectory: Track, gate: Gate, lanes: LaneMap, settings: TrafficSettings, step_s: float | None
) -> list[GateCrossing]:
    signed, along = signed_distances(gate, trajectory.xy)
    length = math.dist(*gate.line)
    rule = _rule(trajectory, gate, signed, settings)
    found = []
    for passage in passages(signed, trajectory.times_s, **rule):
        at = float(trajectory.at(along, passage.time_s))
        # Half-open along the gate too: of two gates that share an end, one counts.
        inside = 0 <= at < length
        between = float(inside)
        if step_s is not None:
            sigma = _sigma(_axis(gate)[1], trajectory.at(trajectory.total_covariance, passage.time_s))
            between = at_most(at / sigma) - at_most((at - length) / sigma) if sigma > 0 else between
        if inside or between > _BESIDE:
            found.append(_crossing(trajectory, gate, passage, lanes, rule, step_s, inside, between))
    return found


def _rule(trajectory: Track, gate: Gate, signed: Array, settings: TrafficSettings) -> dict[str, float]:
    """Distances that it has to be seen on the other side, and to move: more where places are less certain."""
    near = trajectory.covariance[np.abs(signed) < _NEAR_M]
    normal = normal_of(gate)
    spread = float(np.median(np.einsum("i,mij,j->m", normal, near, normal))) if len(near) else 0.0
    hysteresis = max(settings.hysteresis_m, _SURE * math.sqrt(max(0.0, spread)))
    return {"hysteresis": hysteresis, "least_travel": max(settings.least_travel_m, hysteresis)}


def _sigma(direction: Array, covariance: Array) -> float:
    """Standard deviation of a place in a direction, metres."""
    return math.sqrt(max(0.0, float(direction @ covariance @ direction)))


def normal_of(gate: Gate) -> Array:
    """(2,) unit vector to the left of the gate."""
    _, along = _axis(gate)
    return np.array([-along[1], along[0]])


def _crossing(
    trajectory: Track,
    gate: Gate,
    passage: Passage,
    lanes: LaneMap,
    rule: dict[str, float],
    step_s: float | None,
    inside: bool,
    between: float,
) -> GateCrossing:
    time_s = passage.time_s
    normal = normal_of(gate)
    velocity = trajectory.at(trajectory.velocity, time_s)
    covariance = trajectory.at(trajectory.total_covariance, time_s)
    sigma_m = _sigma(normal, covariance)
    across = max(abs(float(normal @ velocity)), _SLOWEST)
    place = trajectory.at(trajectory.xy, time_s)
    lane, lane_probability = lanes.lane_at(place, covariance)
    sure = at_most(passage.depth / sigma_m) if sigma_m > 0 else 1.0
    real = event_probability(trajectory) if step_s is None else crossing_probability(trajectory, time_s, step_s)
    doubts = {"begins": passage.begins, "ends": passage.ends, "beside": between < 1 - _BESIDE}
    return GateCrossing(
        trajectory=trajectory,
        gate=gate.name,
        direction=0 if passage.came_from > 0 else 1,
        direction_name=direction_names(gate)[0 if passage.came_from > 0 else 1],
        time_s=time_s,
        sigma_s=math.hypot(
            sigma_m / across, passage.spread_s, _along_s(trajectory, velocity, metres=step_s is not None)
        ),
        front_s=_end_time(trajectory, gate, trajectory.front, passage, rule),
        rear_s=_end_time(trajectory, gate, trajectory.rear, passage, rule),
        place=place,
        speed=float(np.linalg.norm(velocity)),
        speed_sigma=float(trajectory.at(trajectory.speed_sigma, time_s)),
        lane=lane,
        lane_probability=lane_probability,
        probability=real * sure * between,
        doubt=" ".join(word for word, holds in doubts.items() if holds),
        counts=inside and real >= COUNTED_FROM,
    )


def _along_s(trajectory: Track, velocity: Array, *, metres: bool) -> float:
    """By how much a crossing's time is off since the body's middle is off along its way, one standard deviation."""
    off = _ALONG_M.get(trajectory.class_name, 0.0) if metres else 0.0
    return off / max(float(np.linalg.norm(velocity)), _SLOWEST)


def _end_time(trajectory: Track, gate: Gate, places: Array, passage: Passage, rule: dict[str, float]) -> float:
    """Time at which the front or the rear (M, 2) crosses the gate's line in the same direction; NaN where that is not
    seen."""
    signed, _ = signed_distances(gate, places)
    times = [
        one.time_s
        for one in passages(signed, trajectory.times_s, **rule)
        if one.came_from == passage.came_from and not one.begins
    ]
    return min(times, key=lambda time_s: abs(time_s - passage.time_s)) if times else math.nan
