"""Find turning movements: pairs of gates and directions that a road user crosses in sequence.

In the matrix of movements each crossing counts once in a row, as an origin, and once in a column, as a destination.
Road users that were not seen before or after have a separate row or column. Rows and columns therefore add up to the
counts of the gates, including U-turns.
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
"""Beta distribution of a missed share that is exactly 0, for gates without road users."""
NO_GATE: Final[GateDirection] = ("", "")
"""Origin or destination of a road user that crossed no gate before or after."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Movement:
    """Movement of a road user from one gate to the next."""

    origin: GateCrossing | None
    """Crossing of the first gate; None: not seen at a gate before `destination`."""
    destination: GateCrossing | None
    """Crossing of the next gate; None: not seen at a gate after `origin`."""
    same: float = 1.0
    """Probability that both crossings belong to the same road user."""

    @property
    def time_s(self) -> float:
        """Time of the first known crossing, seconds."""
        return self._first.time_s

    @property
    def sides(self) -> tuple[GateDirection, GateDirection]:
        """Gate and direction of the origin, and of the destination."""
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
        """Probability that the movement happened: both crossings are real and belong to the same road user."""
        return self.same * min(
            crossing.probability for crossing in (self.origin, self.destination) if crossing is not None
        )


@dataclass(frozen=True, kw_only=True)
class TurningMovementCount:
    """Number of road users that moved from one gate to a second gate in a counting interval."""

    interval: ClockInterval
    origin: GateDirection
    destination: GateDirection
    class_name: str
    """`VEHICLE_CATEGORY` for vehicles with more than two wheels, or `ALL_CLASSES`."""
    count: int | None
    """Number of counted movements; None if nothing was observed."""
    confidence_interval: CountInterval | None
    """90% confidence interval of the true number. None if nothing was observed, too few road users are detected at one
    of the gates, pedestrians use either gate, or origin or destination is not known."""


def on_foot(movement: Movement) -> bool:
    """Return whether the road user of a movement is a pedestrian."""
    return movement.trajectory.category == PEDESTRIAN_CATEGORY


def _side(crossing: GateCrossing | None) -> GateDirection:
    return NO_GATE if crossing is None else (crossing.gate, crossing.direction_name)


def movements(
    crossings: Sequence[GateCrossing], settings: TrafficSettings, step_s: float | None = None
) -> list[Movement]:
    """Return the movements between the gates that `settings.turning` names, or between all gates, in order of time.

    A track that probably switches to a second road user between two gates makes two movements: one without a
    destination, and one without an origin.

    Args:
        crossings: All counted crossings of all gates.
        settings: The gates that are used.
        step_s: Usual time between positions in the footage (`usual_step`), seconds. None: tracks are assumed not to
            switch.
    """
    chosen = [crossing for crossing in crossings if settings.turning is None or crossing.gate in settings.turning]
    by_track: dict[int, list[GateCrossing]] = {}
    for crossing in chosen:
        by_track.setdefault(crossing.trajectory.number, []).append(crossing)
    found = [
        movement
        for chain in by_track.values()
        for before, after in itertools.pairwise([None, *chain, None])
        for movement in _between(before, after, step_s)
    ]
    return sorted(found, key=lambda movement: movement.time_s)


def _between(before: GateCrossing | None, after: GateCrossing | None, step_s: float | None) -> list[Movement]:
    """Return the movements of two consecutive crossings of a track: one, or two with an unknown gate each."""
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
    """Return the matrix of each counting interval: a count for each pair of gates that occurs in the whole footage.

    Each pair has a count of all road users, and of vehicles if further classes are counted. A movement belongs to the
    counting interval of its first known crossing.

    Args:
        found: All movements.
        gates: All gates; `settings.turning` may limit them.
        intervals: The intervals.
        observation: The observed times.
        settings: The classes that are counted.
        missed: Road users that may have crossed and are not counted. A movement uses the miss rates, after manual
            counts, of whichever of its two gates misses more.
    """
    chosen = [gate for gate in gates if settings.turning is None or gate.name in settings.turning]
    kinds = {
        (gate.name, name): missed.kinds_at(gate.name, k)
        for gate in chosen
        for k, name in enumerate(direction_names(gate))
    }
    order = {side: k for k, side in enumerate([*((g.name, d) for g in chosen for d in direction_names(g)), NO_GATE])}
    pairs = sorted({movement.sides for movement in found}, key=lambda pair: (order[pair[0]], order[pair[1]]))
    out = []
    for interval in intervals:
        observed = observation.seconds_in(interval.begin_s, interval.end_s) > 0
        in_interval = [movement for movement in found if interval.begin_s <= movement.time_s < interval.end_s]
        for pair in pairs:
            alike = None if not observed or NO_GATE in pair else _missed_more(kinds[pair[0]], kinds[pair[1]])
            for class_name in row_classes(settings):
                classes = classes_of(class_name, settings)
                members = [movement for movement in in_interval if movement.trajectory.class_name in classes]
                out.append(
                    TurningMovementCount(
                        interval=interval,
                        origin=pair[0],
                        destination=pair[1],
                        class_name=class_name,
                        count=sum(movement.sides == pair for movement in members) if observed else None,
                        confidence_interval=None
                        if alike is None
                        else _confidence_interval(members, pair, alike, classes),
                    )
                )
    return out


def _missed_more(origin: Sequence[MissRateGroup], destination: Sequence[MissRateGroup]) -> list[MissRateGroup]:
    """Return for each group of classes the miss rates of the gate with the higher mean miss rate."""
    pairs = zip(origin, destination, strict=True)
    return [max(alike, key=lambda kind: (kind.too_small, kind.mean_missed)) for alike in pairs]


def _confidence_interval(
    members: Sequence[Movement],
    pair: tuple[GateDirection, GateDirection],
    kinds: Sequence[MissRateGroup],
    classes: Collection[str],
) -> CountInterval | None:
    """Return the confidence interval of a count; None with pedestrians, or if too few road users are detected.

    Nearly none or nearly all of the road users lost after the first gate may have made this movement. The share is
    extreme because their destination has no gate, or has a gate that loses them. Movements with pedestrians get no
    confidence interval, because more than half of the tracks of pedestrians switch to another pedestrian between gates.
    """
    if any(
        on_foot(movement) and (movement.sides[0] == pair[0] or movement.sides[1] == pair[1]) for movement in members
    ):
        return None
    errors = []
    for kind in kinds:
        group_members = [movement for movement in members if movement.trajectory.class_name in kind.classes]
        if kind.classes.isdisjoint(classes):
            continue
        if kind.too_small:
            return None
        false = [1 - kind.real * movement.probability for movement in group_members if movement.sides == pair]
        lost = sum(movement.sides == (pair[0], NO_GATE) for movement in group_members)
        # If only lost road users may have made this movement, no further ones are assumed to be missed.
        missed = kind.missed if false or not lost else NOTHING_MISSED
        errors.append(CountErrors(false, possible=lost, came=LOST_PRIOR, missed=missed))
    return CountDistribution(sum(len(group_errors.false) for group_errors in errors), errors).interval()
