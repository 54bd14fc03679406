"""Find gate crossings: one event each time that a road user moves to the other side of a gate."""

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
    """Settings for finding crossings."""

    camera_draws: int = 24
    """Number of sets of camera parameters sampled from the calibration covariance. Surveyed gates are counted again
    under each set."""
    gate_spots: int = 9
    """Number of points on a surveyed gate that are projected."""
    seed: int = 0
    """Random seed for sampling camera parameters."""
    slowest_mps: float = 0.05
    """Speed along the normal below which a position does not refine the time, m/s."""
    hysteresis_sigmas: float = 3.0
    """Minimum hysteresis, in standard deviations of a position along the gate's normal; enough for the position noise
    of a stopped vehicle."""
    near_m: float = 5.0
    """Positions within this distance of a gate set its hysteresis, metres."""
    vehicle_leave: float = 2.0
    """Distance at which a vehicle has left a line, in multiples of the least travel. Other road users: 1."""
    beside_probability: float = 0.05
    """Probability limit for the ends of a gate. A crossing outside the gate is kept only if its probability of being
    within the gate is above this limit. If that probability is below 1 minus this limit, the crossing is flagged
    "beside"."""


GATE_LIMITS: Final = GateLimits()


_ALONG_M: Final = {"bus": 0.6, "bicycle": 0.6, "lorry": 0.15}
"""Additional standard deviation of the body's centre along its path, by class, metres. The error is constant over a
track. Measured on 16 buses, 36 bicycles and 12 lorries of generated clips: median error 0.2, 0.5 and 0 m; spread 0.54,
0.45 and 0.17 m."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GateCrossing:
    """Crossing of a gate by a road user."""

    trajectory: Track
    gate: str
    direction: int
    """0: from the left of the gate, as it is drawn, to its right. 1: from right to left."""
    direction_name: str
    """Name of `direction`; "1" or "2" if the user gives none."""
    time_s: float
    """Time at which the body's centre crosses, seconds of the footage."""
    sigma_s: float
    """Standard deviation of `time_s`, from the uncertainty of the positions, seconds."""
    front_s: float
    """Time at which the front crosses, seconds of the footage; NaN if not available."""
    rear_s: float
    """Time at which the rear crosses, seconds of the footage; NaN if not available."""
    position: Array
    """(2,) position of the crossing, metres."""
    speed: float
    """Speed at the crossing, m/s."""
    speed_sigma: float
    """Standard deviation of `speed` for an exactly known camera, m/s; `Observation.total_sigma` adds the camera's
    error."""
    lane: str
    """Name of the lane; empty for a crossing outside all lanes."""
    lane_probability: float
    """Probability that `lane` is right."""
    probability: float
    """Probability that the crossing happened within the gate and is counted once."""
    uncertainty_flags: str
    """Flags, separated by spaces. "begins" or "ends": the track begins or ends on the gate. "beside": the road user
    may have passed outside the gate's end. Empty: the crossing is certain."""
    is_counted: bool
    """Whether the crossing is counted: it lies between the gate's ends, and is real with a probability of at least 0.5.
    A track that ends on the gate can be counted, with a flag in `uncertainty_flags`."""

    @cached_property
    def end_sigma_s(self) -> float:
        """Standard deviation of `front_s` and `rear_s`, seconds."""
        return math.hypot(self.sigma_s, VEHICLE_LENGTH_SIGMA_M / 2 / max(self.speed, GATE_LIMITS.slowest_mps))


def direction_names(gate: Gate) -> tuple[str, str]:
    """Return the names of the directions from left to right and from right to left."""
    return gate.directions or ("1", "2")


def gates_on_road(gates: Sequence[Gate], observation: Observation | None = None) -> tuple[Gate, ...]:
    """Return the gates with their lines in metres, without gates that have no line.

    The line of a gate drawn in the image is the projection of its pixels onto the road by the recording's camera. The
    camera's error then shifts tracks and line together and affects no crossing. Other gates keep their own line.

    Args:
        gates: The gates of the site.
        observation: The recording with its camera and road; None: every gate keeps its line.
    """
    lines = ((gate, _line_of(gate, observation)) for gate in gates)
    return tuple(replace(gate, line=line) for gate, line in lines if line)


def _line_of(gate: Gate, observation: Observation | None) -> Outline:
    """Return the line of a gate on the road; empty if there is none (for example, pixels above the horizon)."""
    if not gate.pixels or observation is None or observation.camera is None:
        return gate.line
    camera = observation.camera
    size = (camera.width, camera.height)
    if not same_aspect(gate.size or size, size):
        return ()
    ground = observation.ground or Ground()
    return line_on_road(camera, np.array(gate_at_size(gate, size).pixels), ground)


def gates_of_drawn_cameras(gates: Sequence[Gate], observation: Observation) -> list[tuple[Gate, ...]]:
    """Return the surveyed gates relative to the tracks, under camera parameters sampled from their covariance.

    A surveyed line is exact, but all tracks share the camera's error. The error therefore shifts the gate relative to
    the tracks, in the same way for all road users.

    Args:
        gates: The gates, with lines in metres.
        observation: The recording with its camera and the covariance of that camera.

    Returns:
        One tuple per sample (`GATE_LIMITS.camera_draws`) with the gates without pixels. Empty without such gates, or if
        the camera's error is not known.
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
    """Return the gate in the coordinates of tracks that were located with the camera `used`.

    The images were taken with the camera `true`. An end that is not in view moves like the nearest visible point.
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
    """Return the gates that have `pixels`, with lines in pixels (y is the negative image row)."""
    return tuple(replace(gate, line=tuple((u, -v) for u, v in gate.pixels)) for gate in gates if gate.pixels)


def may_count(trajectory: Track, settings: TrafficSettings) -> bool:
    """Return whether crossings of a track can count: it is in traffic and its class is counted."""
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
    """Return all crossings of all gates, in order of time.

    Tracks that are not confirmed or never moved have no crossings.

    Args:
        trajectories: All tracks.
        gates: All gates.
        lanes: The lanes. Each crossing gets the name of its lane.
        settings: The classes that are counted, the hysteresis and the least travel.
        metres: Whether positions are in metres; else in pixels.
        step_s: Usual time between positions in the footage, seconds. Default: that of `trajectories`.
    """
    step_s = usual_step(trajectories) if step_s is None else step_s
    found = [
        crossing
        for trajectory in trajectories
        if may_count(trajectory, settings)
        for gate in gates
        for crossing in _crossings_of_track(trajectory, gate, lanes, settings, step_s, metres)
    ]
    return sorted(found, key=lambda crossing: (crossing.time_s, crossing.trajectory.number, crossing.gate))


def _axis(gate: Gate) -> tuple[Array, Array]:
    """Return the (2,) first end of a gate and the (2,) unit vector from there to its second end."""
    start, end = np.array(gate.line)
    return start, (end - start) / np.linalg.norm(end - start)


def signed_distances(gate: Gate, places: Array) -> tuple[Array, Array]:
    """Return distances across and along a gate, in the unit of the positions.

    Args:
        gate: The gate.
        places: (M, 2) positions.

    Returns:
        (M,) distances from the gate's line, positive to its left, and (M,) distances along it from its first end.
    """
    start, along = _axis(gate)
    away = places - start
    return along[0] * away[:, 1] - along[1] * away[:, 0], away @ along


def _crossings_of_track(
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
        # Half-open along the gate too: if two gates share an end, only one of them counts.
        inside = 0 <= at < length
        between = float(inside)
        if metres:
            sigma = _sigma(_axis(gate)[1], trajectory.at(trajectory.total_covariance, passage.time_s))
            between = at_most(at / sigma) - at_most((at - length) / sigma) if sigma > 0 else between
        if inside or between > GATE_LIMITS.beside_probability:
            found.append(_crossing(trajectory, gate, passage, lanes, rule, (inside, between), step_s, metres))
    return found


def _rule(trajectory: Track, gate: Gate, signed: Array, settings: TrafficSettings) -> dict[str, float]:
    """Return the hysteresis and the least travel at a gate, which grow with the noise of the positions.

    Errors that shift the whole track are excluded, because they do not make a stopped road user jitter across the line.
    """
    near = trajectory.covariance[np.abs(signed) < GATE_LIMITS.near_m]
    normal = normal_of(gate)
    spread = float(np.median(np.einsum("i,mij,j->m", normal, near, normal))) if len(near) else 0.0
    hysteresis = max(settings.hysteresis_m, GATE_LIMITS.hysteresis_sigmas * math.sqrt(max(0.0, spread)))
    return {"hysteresis": hysteresis, "least_travel": max(settings.least_travel_m, hysteresis)}


def leaving_distance(trajectory: Track, least_travel: float) -> float:
    """Return the minimum distance between a crossing and the return of the road user for both to count.

    The measured position of a road user that stops on the line drifts by less than this distance. A vehicle that turns
    round or reverses moves farther.

    Args:
        trajectory: The road user.
        least_travel: `TrafficSettings.least_travel_m`, or more for noisier positions. The result has the same unit.
    """
    return least_travel * (GATE_LIMITS.vehicle_leave if trajectory.category == VEHICLE_CATEGORY else 1.0)


def _sigma(direction: Array, covariance: Array) -> float:
    """Return the standard deviation of a position along a unit vector, metres."""
    return math.sqrt(max(0.0, float(direction @ covariance @ direction)))


def normal_of(gate: Gate) -> Array:
    """Return the (2,) unit normal of a gate, which points to its left."""
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
    """Return a crossing. `ends`: whether it is between the gate's ends, and the probability of that."""
    inside, between = ends
    time_s = passage.time_s
    normal = normal_of(gate)
    velocity = trajectory.at(trajectory.velocity, time_s)
    covariance = trajectory.at(trajectory.total_covariance, time_s)
    sigma_m = _sigma(normal, covariance)
    across = max(abs(float(normal @ velocity)), GATE_LIMITS.slowest_mps)
    position = trajectory.at(trajectory.xy, time_s)
    lane, lane_probability = lanes.lane_at(position, covariance)
    sure = at_most(passage.depth / sigma_m) if sigma_m > 0 else 1.0
    real = crossing_probability(trajectory, time_s, step_s, metres=metres)
    doubts = {"begins": passage.begins, "ends": passage.ends, "beside": between < 1 - GATE_LIMITS.beside_probability}
    return GateCrossing(
        trajectory=trajectory,
        gate=gate.name,
        direction=0 if passage.from_side > 0 else 1,
        direction_name=direction_names(gate)[0 if passage.from_side > 0 else 1],
        time_s=time_s,
        sigma_s=math.hypot(sigma_m / across, passage.spread_s, _along_s(trajectory, velocity, metres=metres)),
        front_s=_end_time(trajectory, gate, trajectory.front, passage, rule),
        rear_s=_end_time(trajectory, gate, trajectory.rear, passage, rule),
        position=position,
        speed=float(np.linalg.norm(velocity)),
        speed_sigma=float(trajectory.at(trajectory.speed_sigma, time_s)),
        lane=lane,
        lane_probability=lane_probability,
        probability=real * sure * between,
        uncertainty_flags=" ".join(word for word, holds in doubts.items() if holds),
        is_counted=inside and real >= EVENT_FACTORS.counted_probability,
    )


def _along_s(trajectory: Track, velocity: Array, *, metres: bool) -> float:
    """Return the standard deviation of a crossing's time due to the error of the body's centre along its path."""
    off = _ALONG_M.get(trajectory.class_name, 0.0) if metres else 0.0
    return off / max(float(np.linalg.norm(velocity)), GATE_LIMITS.slowest_mps)


def _end_time(trajectory: Track, gate: Gate, places: Array, passage: LineCrossing, rule: dict[str, float]) -> float:
    """Return the time at which the front or the rear, with positions (M, 2), crosses the gate's line.

    Only crossings in the direction of `passage` are used. NaN if there is none.
    """
    signed, _ = signed_distances(gate, places)
    times = [
        end_passage.time_s
        for end_passage in line_crossings(signed, trajectory.times_s, **rule, places=None)
        if end_passage.from_side == passage.from_side and not end_passage.begins
    ]
    return min(times, key=lambda time_s: abs(time_s - passage.time_s)) if times else math.nan
