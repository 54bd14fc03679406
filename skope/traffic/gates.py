"""Crossings of gates: one for each time that a road user goes from one side to the other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from skope.camera.ground_plane import Ground, intersect_ground
from skope.camera.model import Camera, same_aspect
from skope.camera.uncertain_camera import moved_camera
from skope.confidence_level import at_most
from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate, Outline, gate_at_size, line_on_road
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import VEHICLE_LENGTH_SIGMA_M, Track, is_in_traffic
from skope.traffic.event_probability import EVENT_FACTORS, crossing_probability, usual_step
from skope.traffic.lanes import LaneMap
from skope.traffic.line_crossings import LineCrossing, line_crossings
from skope.traffic.observation import Observation
from skope.types import Array


@dataclass(frozen=True)
class GateLimits:
    """Limits of crossings."""

    camera_draws: int = 24
    """Number of other cameras under which surveyed gates are counted again."""
    gate_spots: int = 9
    """Number of points of a surveyed gate that are projected."""
    seed: int = 0
    """Seed of these cameras."""
    slowest_mps: float = 0.05
    """Speed along the normal below which a position does not refine the time, m/s."""
    hysteresis_sigmas: float = 3.0
    """Least hysteresis, in standard deviations of a position along the normal. A standing vehicle jitters by that."""
    near_m: float = 5.0
    """Positions within this distance of a gate set its hysteresis, metres."""
    vehicle_leave: float = 2.0
    """A vehicle has left a line at this many times the least travel from it; other road users at one times it."""
    beside_probability: float = 0.05
    """A crossing with a lower probability of being within the gate passes beside its end, and the reverse."""


GATE_LIMITS: Final = GateLimits()


_ALONG_M: Final = {"bus": 0.6, "bicycle": 0.6, "lorry": 0.15}
"""By so much the middles of some bodies are off along the way besides, all the way, one standard deviation: of 16, 36
and 12 in generated clips by 0.2, 0.5 and 0 m in the median, and by 0.54, 0.45 and 0.17 m from there."""


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
        return math.hypot(self.sigma_s, VEHICLE_LENGTH_SIGMA_M / 2 / max(self.speed, GATE_LIMITS.slowest_mps))


def direction_names(gate: Gate) -> tuple[str, str]:
    """Names of crossings from left to right, and back."""
    return gate.directions or ("1", "2")


def gates_on_road(gates: Sequence[Gate], observation: Observation | None = None) -> tuple[Gate, ...]:
    """The gates with their lines among positions in metres; gates without one are left out.

    A gate that was drawn in the image keeps its pixels: its line is where the recording's own camera sees them on the
    road. The camera's error then moves tracks and line alike, and decides no crossing. Else the line is the gate's own.

    Args:
        gates: The gates of the site.
        observation: The recording, with its camera and road; None: every gate keeps its line.
    """
    lines = ((gate, _line_of(gate, observation)) for gate in gates)
    return tuple(replace(gate, line=line) for gate, line in lines if line)


def _line_of(gate: Gate, observation: Observation | None) -> Outline:
    """The line of a gate on the road; empty where it has none, as where its pixels lie above the horizon."""
    if not gate.pixels or observation is None or observation.camera is None:
        return gate.line
    camera = observation.camera
    size = (camera.width, camera.height)
    if not same_aspect(gate.size or size, size):
        return ()
    ground = observation.ground or Ground()
    return line_on_road(camera, np.array(gate_at_size(gate, size).pixels), ground)


def gates_of_other_cameras(gates: Sequence[Gate], observation: Observation) -> list[tuple[Gate, ...]]:
    """The surveyed gates as they would lie among the tracks under other cameras that are equally probable.

    A surveyed line is exact, and all tracks have the camera's error in common: the gate lies elsewhere among them, by
    one shift for all road users.

    Args:
        gates: The gates, with lines in metres.
        observation: The recording, with its camera and how well it is known.

    Returns:
        `GATE_LIMITS.camera_draws` times the gates that have no pixels; nothing where there are none, or the camera's
        error is not known.
    """
    surveyed = [gate for gate in gates if gate.line and not gate.pixels]
    known = observation.uncertainty
    if not surveyed or known is None or not known.covariance.any():
        return []
    ground = observation.ground or Ground()
    rng = np.random.default_rng(GATE_LIMITS.seed)
    steps = rng.multivariate_normal(np.zeros(len(known.parameters)), known.covariance, GATE_LIMITS.camera_draws)
    cameras = [moved_camera(known.camera, dict(zip(known.parameters, row, strict=True))) for row in steps.tolist()]
    return [tuple(_seen_by(gate, true, known.camera, ground) for gate in surveyed) for true in cameras]


def _seen_by(gate: Gate, true: Camera, used: Camera, ground: Ground) -> Gate:
    """The gate where tracks that were made with the camera `used` have it, if the camera `true` took the images.

    Where one of its ends is not in view, it moves as the nearest point of the gate that is.
    """
    ends = np.array(gate.line)
    spots = ends[0] + np.linspace(0, 1, GATE_LIMITS.gate_spots)[:, None] * (ends[1] - ends[0])
    pixels, _, valid = true.project(np.column_stack([spots, ground.heights(spots)]))
    found = intersect_ground(used, np.where(valid[:, None], pixels, 0.0), ground.height, slope=ground.slope,
                          about=ground.about)[:, :2]  # fmt: skip
    seen = np.flatnonzero(valid & np.isfinite(found).all(axis=1))
    if not len(seen):
        return gate
    moved = [ends[k] + found[i] - spots[i] for k, i in ((0, seen[0]), (1, seen[-1]))]
    return replace(gate, line=tuple((float(x), float(y)) for x, y in moved))


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
    step_s: float | None = None,
) -> list[GateCrossing]:
    """All crossings of all gates, in order of time; tracks that are not confirmed, or never moved, have none.

    Args:
        trajectories: All tracks.
        gates: All gates.
        lanes: The lanes; in which one crosses is said.
        settings: The classes that are counted, and how far somebody has to be seen on either side.
        metres: Whether positions are in metres; else in pixels.
        step_s: Usual time between positions in the footage, seconds. Default: that of `trajectories`.
    """
    step_s = usual_step(trajectories) if step_s is None else step_s
    found = [
        crossing
        for trajectory in trajectories
        if may_count(trajectory, settings)
        for gate in gates
        for crossing in _of_one(trajectory, gate, lanes, settings, step_s, metres)
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
    trajectory: Track, gate: Gate, lanes: LaneMap, settings: TrafficSettings, step_s: float, metres: bool
) -> list[GateCrossing]:
    signed, along = signed_distances(gate, trajectory.xy)
    if (signed > 0).all() or (signed < 0).all():
        return []
    length = math.dist(*gate.line)
    rule = _rule(trajectory, gate, signed, settings)
    found = []
    leave = leaving_distance(trajectory, rule["least_travel"])
    for passage in line_crossings(signed, trajectory.times_s, **rule, leave=leave, places=trajectory.xy):
        at = float(trajectory.at(along, passage.time_s))
        # Half-open along the gate too: of two gates that share an end, one counts.
        inside = 0 <= at < length
        between = float(inside)
        if metres:
            sigma = _sigma(_axis(gate)[1], trajectory.at(trajectory.total_covariance, passage.time_s))
            between = at_most(at / sigma) - at_most((at - length) / sigma) if sigma > 0 else between
        if inside or between > GATE_LIMITS.beside_probability:
            found.append(_crossing(trajectory, gate, passage, lanes, rule, (inside, between), step_s, metres))
    return found


def _rule(trajectory: Track, gate: Gate, signed: Array, settings: TrafficSettings) -> dict[str, float]:
    """Distances that it has to be seen on the other side, and to move: more where positions are noisier.

    Only noise lets a standing road user jitter across the line: what shifts the whole track does not.
    """
    near = trajectory.covariance[np.abs(signed) < GATE_LIMITS.near_m]
    normal = normal_of(gate)
    spread = float(np.median(np.einsum("i,mij,j->m", normal, near, normal))) if len(near) else 0.0
    hysteresis = max(settings.hysteresis_m, GATE_LIMITS.hysteresis_sigmas * math.sqrt(max(0.0, spread)))
    return {"hysteresis": hysteresis, "least_travel": max(settings.least_travel_m, hysteresis)}


def leaving_distance(trajectory: Track, least_travel: float) -> float:
    """Distance that a road user goes between a crossing and its return for both to count.

    A road user that stands on the line stays within it, although its position swings. It is about half a car's length;
    who turns round or reverses goes farther.

    Args:
        trajectory: The road user.
        least_travel: Distance of `TrafficSettings.least_travel_m`, or more where positions are noisier. The result has
            its unit.
    """
    return least_travel * (GATE_LIMITS.vehicle_leave if trajectory.category == VEHICLE_CATEGORY else 1.0)


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
    passage: LineCrossing,
    lanes: LaneMap,
    rule: dict[str, float],
    ends: tuple[bool, float],
    step_s: float,
    metres: bool,
) -> GateCrossing:
    """A crossing; `ends` says whether it is between the gate's ends, and how probably."""
    inside, between = ends
    time_s = passage.time_s
    normal = normal_of(gate)
    velocity = trajectory.at(trajectory.velocity, time_s)
    covariance = trajectory.at(trajectory.total_covariance, time_s)
    sigma_m = _sigma(normal, covariance)
    across = max(abs(float(normal @ velocity)), GATE_LIMITS.slowest_mps)
    place = trajectory.at(trajectory.xy, time_s)
    lane, lane_probability = lanes.lane_at(place, covariance)
    sure = at_most(passage.depth / sigma_m) if sigma_m > 0 else 1.0
    real = crossing_probability(trajectory, time_s, step_s, metres=metres)
    doubts = {"begins": passage.begins, "ends": passage.ends, "beside": between < 1 - GATE_LIMITS.beside_probability}
    return GateCrossing(
        trajectory=trajectory,
        gate=gate.name,
        direction=0 if passage.came_from > 0 else 1,
        direction_name=direction_names(gate)[0 if passage.came_from > 0 else 1],
        time_s=time_s,
        sigma_s=math.hypot(sigma_m / across, passage.spread_s, _along_s(trajectory, velocity, metres=metres)),
        front_s=_end_time(trajectory, gate, trajectory.front, passage, rule),
        rear_s=_end_time(trajectory, gate, trajectory.rear, passage, rule),
        place=place,
        speed=float(np.linalg.norm(velocity)),
        speed_sigma=float(trajectory.at(trajectory.speed_sigma, time_s)),
        lane=lane,
        lane_probability=lane_probability,
        probability=real * sure * between,
        doubt=" ".join(word for word, holds in doubts.items() if holds),
        counts=inside and real >= EVENT_FACTORS.counted_probability,
    )


def _along_s(trajectory: Track, velocity: Array, *, metres: bool) -> float:
    """By how much a crossing's time is off since the body's middle is off along its way, one standard deviation."""
    off = _ALONG_M.get(trajectory.class_name, 0.0) if metres else 0.0
    return off / max(float(np.linalg.norm(velocity)), GATE_LIMITS.slowest_mps)


def _end_time(trajectory: Track, gate: Gate, places: Array, passage: LineCrossing, rule: dict[str, float]) -> float:
    """Time at which the front or the rear (M, 2) crosses the gate's line in the same direction; NaN where that is not
    seen."""
    signed, _ = signed_distances(gate, places)
    times = [
        one.time_s
        for one in line_crossings(signed, trajectory.times_s, **rule, places=None)
        if one.came_from == passage.came_from and not one.begins
    ]
    return min(times, key=lambda time_s: abs(time_s - passage.time_s)) if times else math.nan
