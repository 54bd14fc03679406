"""Movements: which gate, and in which direction, each road user crossed after which.

Each crossing is once a row's, as where somebody comes from, and once a column's, as where somebody goes. Who was not
seen before or after has a column or row of its own, so that rows and columns add up to the gates' counts, U-turns and
all.
"""

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

from skope.schema import PEDESTRIAN_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.count_uncertainty import CountDistribution, CountErrors, CountInterval
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import EVENT_FACTORS, MissRateGroup, same_probability
from skope.traffic.gate_counts import classes_of, row_classes
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.missed_crossings import MissedCrossings
from skope.traffic.observation import Observation

GateDirection = tuple[str, str]
"""A gate and the name of a direction."""
LOST_PRIOR: Final = (0.2, 0.2)
"""Beta distribution of the share of lost road users on each movement."""
NOTHING_MISSED: Final = (0.0, 1.0)
"""Beta distribution of the missed share if nobody is there."""
NO_GATE: Final[GateDirection] = ("", "")
"""No gate before, or after."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Movement:
    """A road user crosses one gate and then the next one; None: it is seen at no gate before, or after."""

    origin: GateCrossing | None
    destination: GateCrossing | None
    same: float = 1.0
    """Probability that both are one road user's."""

    @property
    def time_s(self) -> float:
        """Time at which it crosses the first of the two gates that it is seen at, seconds."""
        return self._first.time_s

    @property
    def sides(self) -> tuple[GateDirection, GateDirection]:
        """Origin and destination, a gate and direction each."""
        return _side(self.origin), _side(self.destination)

    @property
    def trajectory(self) -> Track:
        """Track of the road user."""
        return self._first.trajectory

    @property
    def _first(self) -> GateCrossing:
        first = self.origin or self.destination
        assert first is not None
        return first

    @property
    def probability(self) -> float:
        """Probability that it happened: both of its crossings did, and are one road user's."""
        return self.same * min(one.probability for one in (self.origin, self.destination) if one is not None)


@dataclass(frozen=True, kw_only=True)
class TurningMovementCount:
    """Number that went from one gate to another in an interval."""

    interval: ClockInterval
    origin: GateDirection
    destination: GateDirection
    class_name: str
    """`VEHICLE_CATEGORY` for those on more than two wheels, or `ALL_CLASSES`."""
    count: int | None
    """None: nothing was observed."""
    expected: CountInterval | None
    """Between which numbers the truth is; None where nothing was observed, where too few of them are seen at one of the
    two gates, where people on foot are among those at either, or for who was not seen at one of the two: these went
    somewhere in truth."""


def on_foot(movement: Movement) -> bool:
    """Whether somebody walks."""
    return movement.trajectory.category == PEDESTRIAN_CATEGORY


def _side(crossing: GateCrossing | None) -> GateDirection:
    return NO_GATE if crossing is None else (crossing.gate, crossing.direction_name)


def movements(
    crossings: Sequence[GateCrossing], settings: TrafficSettings, step_s: float | None = None
) -> list[Movement]:
    """The movements between the gates that `settings.turning` names, or all, in order of time.

    A track that is more probably two road users' than one's between two gates makes no movement: somebody crosses the
    one and is not seen after, and somebody the other and is not seen before.

    Args:
        crossings: Everyone at all gates.
        settings: Which gates count.
        step_s: Usual time from place to place in the footage (`usual_step`); None: no track is two road users', or how
            probable that is is not known.
    """
    chosen = [one for one in crossings if settings.turning is None or one.gate in settings.turning]
    by_track: dict[int, list[GateCrossing]] = {}
    for one in chosen:
        by_track.setdefault(one.trajectory.number, []).append(one)
    found = [
        movement
        for chain in by_track.values()
        for before, after in itertools.pairwise([None, *chain, None])
        for movement in _between(before, after, step_s)
    ]
    return sorted(found, key=lambda one: one.time_s)


def _between(before: GateCrossing | None, after: GateCrossing | None, step_s: float | None) -> list[Movement]:
    """Movements of two crossings of a track that follow each other: one, or two that lack the other gate."""
    if before is None or after is None or step_s is None:
        return [Movement(origin=before, destination=after)]
    same = same_probability(before.trajectory, before.time_s, after.time_s, step_s)
    if same >= EVENT_FACTORS.counted_probability:
        return [Movement(origin=before, destination=after, same=same)]
    return [Movement(origin=before, destination=None), Movement(origin=None, destination=after)]


def turning_counts(
    found: Sequence[Movement],
    gates: Sequence[Gate],
    intervals: Sequence[ClockInterval],
    observation: Observation,
    settings: TrafficSettings,
    missed: MissedCrossings,
) -> list[TurningMovementCount]:
    """The matrix of each interval: a count for each pair that anybody has driven in the whole footage.

    Each pair has a count of all, and of vehicles where others are counted too. A movement counts in the interval of the
    crossing that it comes from, or, without one, of that which it goes to.

    Args:
        found: All movements.
        gates: All gates; `settings.turning` may name those that count.
        intervals: The intervals.
        observation: When was observed.
        settings: The classes that are counted.
        missed: Who may have crossed and is not counted. Of the two gates of a movement that one counts which misses
            more, with what hand counts tell of it.
    """
    chosen = [gate for gate in gates if settings.turning is None or gate.name in settings.turning]
    kinds = {
        (gate.name, name): missed.kinds_at(gate.name, k)
        for gate in chosen
        for k, name in enumerate(direction_names(gate))
    }
    order = {side: k for k, side in enumerate([*((g.name, d) for g in chosen for d in direction_names(g)), NO_GATE])}
    pairs = sorted({one.sides for one in found}, key=lambda pair: (order[pair[0]], order[pair[1]]))
    out = []
    for interval in intervals:
        observed = observation.seconds_in(interval.begin_s, interval.end_s) > 0
        there = [one for one in found if interval.begin_s <= one.time_s < interval.end_s]
        for pair in pairs:
            alike = None if not observed or NO_GATE in pair else _missed_more(kinds[pair[0]], kinds[pair[1]])
            for class_name in row_classes(settings):
                classes = classes_of(class_name, settings)
                members = [one for one in there if one.trajectory.class_name in classes]
                out.append(
                    TurningMovementCount(
                        interval=interval,
                        origin=pair[0],
                        destination=pair[1],
                        class_name=class_name,
                        count=sum(one.sides == pair for one in members) if observed else None,
                        expected=None if alike is None else _expected(members, pair, alike, classes),
                    )
                )
    return out


def _missed_more(origin: Sequence[MissRateGroup], destination: Sequence[MissRateGroup]) -> list[MissRateGroup]:
    """The kinds as the one of two gates misses them that misses more of them."""
    pairs = zip(origin, destination, strict=True)
    return [max(alike, key=lambda kind: (kind.too_small, kind.mean_missed)) for alike in pairs]


def _expected(
    members: Sequence[Movement],
    pair: tuple[GateDirection, GateDirection],
    kinds: Sequence[MissRateGroup],
    classes: Collection[str],
) -> CountInterval | None:
    """Interval of a count. Road users that were lost after the first gate may have gone this way: nearly none of them,
    or nearly all, as where they went has no gate, or has one that loses them.

    None where people are among those at either gate: more than half of their tracks go over to others on the way.
    """
    if any(on_foot(one) and (one.sides[0] == pair[0] or one.sides[1] == pair[1]) for one in members):
        return None
    errors = []
    for kind in kinds:
        own = [one for one in members if one.trajectory.class_name in kind.classes]
        if kind.classes.isdisjoint(classes):
            continue
        if kind.too_small:
            return None
        false = [1 - kind.real * one.probability for one in own if one.sides == pair]
        lost = sum(one.sides == (pair[0], NO_GATE) for one in own)
        # Where only lost ones may have gone this way, none is missed in addition: those who are seen tell that.
        missed = kind.missed if false or not lost else NOTHING_MISSED
        errors.append(CountErrors(false, possible=lost, came=LOST_PRIOR, missed=missed))
    return CountDistribution(sum(len(one.false) for one in errors), errors).interval()
