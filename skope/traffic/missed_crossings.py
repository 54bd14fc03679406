"""Road users that may have crossed a gate uncounted: tracks lost before it or found behind it, doubtful crossings.

A gate where the camera loses vehicles counts few, and that few are seen there does not show in the count: only in the
tracks around it.
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
    """Speed along the gate's normal below which a lost road user was not about to cross it, m/s."""
    near_m: float = 10.0
    """A gate within this distance of which nobody was detected may be out of view, metres."""


MISSED_LIMITS: Final = MissedLimits()


@dataclass(frozen=True, kw_only=True, eq=False)
class LostTrack:
    """A track that was lost before a gate, or found behind it."""

    trajectory: Track
    gate: str
    direction: int
    """In which it would have crossed, or has: 0 from the gate's left to its right."""
    time_s: float
    """Time of that at the speed that it had, seconds of the footage."""
    begins: bool
    """Whether the track begins behind the gate; else it ends before."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MissedCrossings:
    """Road users that a camera may have missed at gates."""

    vanished: tuple[LostTrack, ...] = ()
    doubtful: tuple[GateCrossing, ...] = ()
    """Crossings that are not counted: more probably none than one, or just beside the gate."""
    kinds: Mapping[str, tuple[MissRateGroup, ...]] = field(default_factory=dict)
    """Miss rates at each gate; at a gate that is not named, those of `miss_rate_groups(None)`."""
    gates: frozenset[str] = frozenset()
    """Names of gates near which nobody was ever seen: whether somebody crossed them is not known."""
    learnt: Mapping[tuple[str, int], tuple[MissRateGroup, ...]] = field(default_factory=dict)
    """By gate and direction, the miss rates that manual counts lead to."""
    contradicted: frozenset[str] = frozenset()
    """Names of gates at which a manual count contradicts what was seen."""
    other_cameras: Mapping[str, Sequence[Sequence[GateCrossing]]] = field(default_factory=dict)
    """By surveyed gate, its crossings under each of several other cameras that are equally probable."""

    def kinds_at(self, gate: str, direction: int) -> tuple[MissRateGroup, ...]:
        """Miss rates at a gate, in a direction."""
        return self.learnt.get((gate, direction)) or self._prior(gate)

    def kind_sets(self, gate: str, direction: int) -> list[tuple[MissRateGroup, ...]]:
        """Miss rates that are all possible: with and without manual counts, where these contradict what was seen."""
        found = [self.kinds_at(gate, direction)]
        return [*found, self._prior(gate)] if gate in self.contradicted else found

    def _prior(self, gate: str) -> tuple[MissRateGroup, ...]:
        return self.kinds.get(gate) or miss_rate_groups(None)

    def most(self, gate: str, direction: int, interval: ClockInterval, classes: Collection[str]) -> int:
        """Count how many more may have crossed a gate.

        Who ends before a gate and who begins behind it may be one and the same: the larger of the two numbers counts.

        Args:
            gate: Name of the gate.
            direction: 0 from the gate's left to its right, 1 back.
            interval: The interval in which they would have crossed.
            classes: Their classes.
        """
        own = [
            one
            for one in self.vanished
            if (one.gate, one.direction) == (gate, direction)
            and interval.begin_s <= one.time_s < interval.end_s
            and one.trajectory.class_name in classes
        ]
        begun = sum(one.begins for one in own)
        return max(begun, len(own) - begun)


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
    """Gather who may have crossed gates without being counted.

    Args:
        trajectories: All tracks.
        gates: All gates.
        crossings: All crossings, counted or not.
        observation: When was observed, and how many pixels a metre is.
        settings: The classes that are counted.
        near: A gate is seen near where somebody was so far from it, in the unit of places.
        kinds: Miss rates by gate; None: by how many pixels a metre is at each.
        other_cameras: As in `MissedCrossings`.
    """
    crossed = {(one.trajectory.number, one.gate) for one in crossings}
    found = [
        LostTrack(trajectory=one, gate=gate.name, direction=direction, time_s=time_s, begins=begins)
        for one in trajectories
        if may_count(one, settings)
        for gate in gates
        if (one.number, gate.name) not in crossed
        for begins in (False, True)
        for direction, time_s in _would_cross(one, gate, begins, observation)
    ]
    confirmed = [one for one in trajectories if one.confirmed]
    blind = {gate.name for gate in gates if not any(near_gate(gate, one, near).any() for one in confirmed)}
    return MissedCrossings(
        vanished=tuple(sorted(found, key=lambda one: one.time_s)),
        doubtful=tuple(one for one in crossings if not one.counts),
        kinds=kinds
        or {gate.name: miss_rate_groups(observation.pixels_per_metre(np.mean(gate.line, axis=0))) for gate in gates},
        gates=frozenset(blind),
        other_cameras=other_cameras or {},
    )


def _would_cross(trajectory: Track, gate: Gate, begins: bool, observation: Observation) -> list[tuple[int, float]]:
    """Direction and time of the crossing that a track's end, or its beginning, speaks for; empty where it does not."""
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
    """(M,) at which moments a track is within a distance of a gate, in the unit of positions."""
    signed, along = signed_distances(gate, trajectory.xy)
    length = math.dist(*gate.line)
    beside = np.maximum(0.0, np.maximum(-along, along - length))
    return np.asarray(np.hypot(signed, beside) < near)
