"""Find road users that may have crossed a gate uncounted: lost tracks and doubtful crossings.

If the camera loses vehicles near a gate, its count is too low. Tracks that end before the gate, or begin behind it,
show this.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import MissRateGroup, miss_rate_groups
from skope.traffic.gates import GateCrossing, may_count, signed_distances
from skope.traffic.observation import Observation


@dataclass(frozen=True)
class MissedLimits:
    """Limits of crossings that may have been missed."""

    soon_s: float = 3.0
    """Time after the end, or before the start, of a track within which it may have crossed a gate, seconds."""
    slowest_mps: float = 0.5
    """Speed along the gate's normal below which a lost road user was not about to cross the gate, m/s."""
    near_m: float = 10.0
    """A gate may be out of view if no road user was detected within this distance of it, metres."""


MISSED_LIMITS: Final = MissedLimits()


@dataclass(frozen=True, kw_only=True, eq=False)
class LostTrack:
    """Track that was lost before a gate or found behind it."""

    trajectory: Track
    gate: str
    direction: int
    """Direction of the possible crossing. 0: from the gate's left to its right. 1: from right to left."""
    time_s: float
    """Time of the possible crossing at the last (or first) measured velocity, seconds of the footage."""
    begins: bool
    """Whether the track begins behind the gate; otherwise it ends before the gate."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MissedCrossings:
    """Road users that a camera may have missed at gates."""

    vanished: tuple[LostTrack, ...] = ()
    """Tracks that were lost before a gate or found behind it, in order of time."""
    doubtful: tuple[GateCrossing, ...] = ()
    """Crossings that are not counted, because their probability is below 0.5 or they are beside the gate."""
    kinds: Mapping[str, tuple[MissRateGroup, ...]] = field(default_factory=dict)
    """Miss rates by gate. A gate without an entry has those of `miss_rate_groups(None)`."""
    gates: frozenset[str] = frozenset()
    """Names of gates near which no road user was ever detected. The number of crossings there is not known."""
    learnt: Mapping[tuple[str, int], tuple[MissRateGroup, ...]] = field(default_factory=dict)
    """Miss rates after the manual counts, by gate and direction."""
    contradicted: frozenset[str] = frozenset()
    """Names of gates at which a manual count contradicts the automatic count."""
    other_cameras: Mapping[str, Sequence[Sequence[GateCrossing]]] = field(default_factory=dict)
    """Crossings of each surveyed gate under each sampled set of camera parameters."""

    def kinds_at(self, gate: str, direction: int) -> tuple[MissRateGroup, ...]:
        """Return the miss rates at a gate in a direction."""
        return self.learnt.get((gate, direction)) or self._prior(gate)

    def kind_sets(self, gate: str, direction: int) -> list[tuple[MissRateGroup, ...]]:
        """Return the possible sets of miss rates at a gate in a direction.

        The first set includes the manual counts. If the manual counts contradict the automatic count, a second set
        excludes them.
        """
        found = [self.kinds_at(gate, direction)]
        return [*found, self._prior(gate)] if gate in self.contradicted else found

    def _prior(self, gate: str) -> tuple[MissRateGroup, ...]:
        return self.kinds.get(gate) or miss_rate_groups(None)

    def most(self, gate: str, direction: int, interval: ClockInterval, classes: Collection[str]) -> int:
        """Return the maximum number of lost road users that may have crossed a gate.

        A track that ends before the gate and a track that begins behind it may belong to the same road user. The
        result is therefore the larger of the two numbers.

        Args:
            gate: Name of the gate.
            direction: 0: from the gate's left to its right. 1: from right to left.
            interval: The interval of the possible crossings.
            classes: The classes that are counted.
        """
        lost = [
            lost_track
            for lost_track in self.vanished
            if (lost_track.gate, lost_track.direction) == (gate, direction)
            and interval.begin_s <= lost_track.time_s < interval.end_s
            and lost_track.trajectory.class_name in classes
        ]
        begun = sum(lost_track.begins for lost_track in lost)
        return max(begun, len(lost) - begun)


def unseen(
    trajectories: Sequence[Track],
    gates: Sequence[Gate],
    crossings: Sequence[GateCrossing],
    observation: Observation,
    settings: TrafficSettings,
    near: float = MISSED_LIMITS.near_m,
    kinds: Mapping[str, tuple[MissRateGroup, ...]] | None = None,
    other_cameras: Mapping[str, Sequence[Sequence[GateCrossing]]] | None = None,
) -> MissedCrossings:
    """Collect the road users that may have crossed gates without being counted.

    Args:
        trajectories: All tracks.
        gates: All gates.
        crossings: All crossings, counted or not.
        observation: The observed times, and the image scale at each gate.
        settings: The classes that are counted.
        near: A gate is in view if a confirmed track came within this distance of it, in the unit of positions.
        kinds: Miss rates by gate; None: from the image scale at each gate.
        other_cameras: As in `MissedCrossings`.
    """
    crossed = {(crossing.trajectory.number, crossing.gate) for crossing in crossings}
    found = [
        LostTrack(trajectory=track, gate=gate.name, direction=direction, time_s=time_s, begins=begins)
        for track in trajectories
        if may_count(track, settings)
        for gate in gates
        if (track.number, gate.name) not in crossed
        for begins in (False, True)
        for direction, time_s in _would_cross(track, gate, begins, observation)
    ]
    confirmed = [track for track in trajectories if track.confirmed]
    blind = {gate.name for gate in gates if not any(near_gate(gate, track, near).any() for track in confirmed)}
    return MissedCrossings(
        vanished=tuple(sorted(found, key=lambda lost: lost.time_s)),
        doubtful=tuple(crossing for crossing in crossings if not crossing.is_counted),
        kinds=kinds
        or {gate.name: miss_rate_groups(observation.pixels_per_metre(np.mean(gate.line, axis=0))) for gate in gates},
        gates=frozenset(blind),
        other_cameras=other_cameras or {},
    )


def _would_cross(trajectory: Track, gate: Gate, begins: bool, observation: Observation) -> list[tuple[int, float]]:
    """Return direction and time of the crossing that a track's end (or start) suggests; empty if it suggests none."""
    row = 0 if begins else -1
    end_s = float(trajectory.times_s[row])
    if observation.is_cut(end_s):
        return []
    velocity = trajectory.velocity[row]
    places = np.stack([trajectory.xy[row], trajectory.xy[row] + velocity])
    (signed, ahead), (along, later) = signed_distances(gate, places)
    across = ahead - signed
    if abs(across) < MISSED_LIMITS.slowest_mps:
        return []
    after_s = float(-signed / across)
    if not (-MISSED_LIMITS.soon_s < after_s <= 0 if begins else 0 <= after_s < MISSED_LIMITS.soon_s):
        return []
    at = along + (later - along) * after_s
    length = math.dist(*gate.line)
    return [(0 if across < 0 else 1, end_s + after_s)] if 0 <= at < length else []


def near_gate(gate: Gate, trajectory: Track, near: float) -> NDArray[np.bool_]:
    """Return (M,) whether each position of a track is within a distance of a gate, in the unit of positions."""
    signed, along = signed_distances(gate, trajectory.xy)
    length = math.dist(*gate.line)
    beside = np.maximum(0.0, np.maximum(-along, along - length))
    return np.asarray(np.hypot(signed, beside) < near)
