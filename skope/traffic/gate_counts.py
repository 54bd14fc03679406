"""Numbers of crossings at each gate, by direction, lane, class and interval on the clock."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from skope.schema import VEHICLE
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import OF_VEHICLES, UNKNOWN, TrafficSettings
from skope.traffic.count_uncertainty import CountInterval, Group, joint_interval
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import SeenAlike
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.missed_crossings import Unseen
from skope.traffic.observation import Observation
from skope.traffic.passenger_cars import passenger_cars, pce_factors

ALL: Final = "all"
_WHOLE: Final = 0.999
"""An interval of which so much was observed was observed."""


@dataclass(frozen=True, kw_only=True)
class Count:
    """Number of a kind that crossed a gate in an interval."""

    interval: ClockInterval
    observed_s: float
    """Observed part of the interval, seconds."""
    gate: str
    direction: str
    lane: str
    """A lane's name, "" for who is in none, or `ALL`."""
    class_name: str
    """A class, `VEHICLE` for those on more than two wheels, or `ALL`."""
    count: int | None
    """None: nothing was observed."""
    expected: CountInterval | None
    """Between which numbers the truth is, of what was observed; None where nothing was, where nobody was ever seen near
    the gate, where more vehicles are lost at it than cross it, or of the class unknown, which nobody is in truth."""
    pce: float | None = None
    """Passenger-car equivalents of those counted. None for rows of one class or of vehicles, if nothing was observed,
    or if too few vehicles at the gate have a known class."""

    @property
    def observed(self) -> str:
        """Whether the interval was observed: all, part or nothing."""
        return observed_word(self.interval, self.observed_s)


def observed_word(interval: ClockInterval, observed_s: float) -> str:
    """All, part or nothing."""
    if observed_s <= 0:
        return "nothing"
    return "all" if observed_s >= _WHOLE * (interval.end_s - interval.begin_s) else "part"


def interval_counts(
    crossings: Sequence[GateCrossing],
    gates: Sequence[Gate],
    lanes: Sequence[str],
    intervals: Sequence[ClockInterval],
    observation: Observation,
    settings: TrafficSettings,
    unseen: Unseen,
    *,
    by_class: bool = True,
) -> list[Count]:
    """Count for each interval, gate and direction: all, vehicles, each class, and each lane.

    Nothing counted is 0; nothing observed has no count. Vehicles have rows of their own where others are counted too.

    Args:
        crossings: Those that are counted.
        gates: All gates.
        lanes: Names of all lanes; a gate has rows of those that anybody crosses it in.
        intervals: The intervals.
        observation: When was observed.
        settings: The classes that are counted.
        unseen: Who may have crossed and is not counted.
        by_class: Make rows of single classes too.
    """
    out = []
    factors = {
        (gate.name, k): pce_factors([one for one in crossings if (one.gate, one.direction) == (gate.name, k)], settings)
        for gate in gates
        for k in (0, 1)
    }
    for interval in intervals:
        observed_s = observation.seconds_in(interval.begin_s, interval.end_s)
        there, doubtful = (
            [one for one in every if interval.begin_s <= one.time_s < interval.end_s]
            for every in (crossings, unseen.doubtful)
        )
        for gate in gates:
            for k, direction in enumerate(direction_names(gate)):
                own, perhaps = (
                    [one for one in every if one.gate == gate.name and one.direction == k]
                    for every in (there, doubtful)
                )
                used = [lane for lane in lanes if any(one.lane == lane for one in crossings if one.gate == gate.name)]
                for lane, class_name in _kinds(used, settings, by_class=by_class):
                    told = None
                    if observed_s > 0 and gate.name not in unseen.gates:
                        most = partial(unseen.most, gate.name, k, interval)
                        kinds = unseen.kinds_at(gate.name, k)
                        told = expected([*own, *perhaps], kinds, most, lane, classes_of(class_name, settings))
                    pce = None
                    if observed_s > 0 and class_name == ALL:
                        in_lane = [one for one in own if lane in (ALL, one.lane)]
                        pce = passenger_cars(in_lane, factors[gate.name, k])
                    out.append(
                        Count(
                            interval=interval,
                            observed_s=observed_s,
                            gate=gate.name,
                            direction=direction,
                            lane=lane,
                            class_name=class_name,
                            count=_number(own, lane, classes_of(class_name, settings)) if observed_s > 0 else None,
                            expected=told,
                            pce=pce,
                        )
                    )
    return out


def _kinds(lanes: Sequence[str], settings: TrafficSettings, *, by_class: bool) -> Iterator[tuple[str, str]]:
    """The lane and class of each row."""
    for name in row_classes(settings):
        yield ALL, name
    if by_class:
        for name in settings.classes:
            yield ALL, name
    if lanes:
        for lane in (*lanes, ""):
            yield lane, ALL


def row_classes(settings: TrafficSettings) -> tuple[str, ...]:
    """`ALL`, and `VEHICLE` where vehicles and others are counted."""
    mixed = not OF_VEHICLES.isdisjoint(settings.classes) and not OF_VEHICLES.issuperset(settings.classes)
    return (ALL, VEHICLE) if mixed else (ALL,)


def classes_of(class_name: str, settings: TrafficSettings) -> frozenset[str]:
    """The classes that a row is of."""
    if class_name == VEHICLE:
        return OF_VEHICLES & set(settings.classes)
    return frozenset(settings.classes) if class_name == ALL else frozenset({class_name})


def _number(crossings: Sequence[GateCrossing], lane: str, classes: Collection[str]) -> int:
    return sum(lane in (ALL, one.lane) and one.trajectory.class_name in classes for one in crossings)


def expected(
    crossings: Sequence[GateCrossing],
    kinds: Sequence[SeenAlike],
    most: Callable[[Collection[str]], int],
    lane: str,
    classes: Collection[str],
) -> CountInterval | None:
    """The interval of how many there were, of classes, in a lane or in all.

    Who is counted in another lane or class may be of these: each counts with the probability that it is.

    Args:
        crossings: Of the gate, direction and interval: those that are counted, and doubtful ones.
        kinds: What is missed at the gate, of whom.
        most: How many more may have crossed, of the classes that it is called with.
        lane: Name of a lane, or `ALL`.
        classes: The classes that are asked for.

    Returns:
        The interval; None: nobody is of the class in truth, or the gate sees so few of them that nothing can be said.
    """
    groups = []
    for kind in kinds:
        group = group_of(kind, crossings, most, lane, classes)
        if group is None:
            continue
        crossed = sum(one.counts and one.trajectory.class_name in kind.classes for one in crossings)
        if kind.loses(crossed, most(kind.classes)):
            return None
        groups.append(group)
    return joint_interval(groups) if groups else None


def group_of(
    kind: SeenAlike,
    crossings: Sequence[GateCrossing],
    most: Callable[[Collection[str]], int],
    lane: str,
    classes: Collection[str],
) -> Group | None:
    """Those of a kind who may have been of one of the classes, and in the lane.

    Args:
        kind: Road users that are missed alike.
        crossings: Of the gate, direction and interval: those that are counted, and doubtful ones.
        most: How many more may have crossed, of the classes that it is called with.
        lane: Name of a lane, or `ALL`.
        classes: The classes that are asked for.

    Returns:
        Their probabilities, and what is missed; None where the kind has none of the classes.
    """
    named = kind.classes - {UNKNOWN}
    if not named & set(classes):
        return None
    whole = named <= set(classes)
    own = [one for one in crossings if one.trajectory.class_name in kind.classes]
    chances = [one.probability * _in_lane(one, lane) * (1.0 if whole else _of_classes(one, classes)) for one in own]
    possible = most(kind.classes if whole else kind.classes & {*classes, UNKNOWN})
    return kind.group([p for p in chances if p > 0], possible)


def _in_lane(crossing: GateCrossing, lane: str) -> float:
    if lane == ALL:
        return 1.0
    if crossing.lane == lane:
        return crossing.lane_probability
    # Who is not in the lane that it is counted in is in one beside it, or in none: each has a half.
    return (1 - crossing.lane_probability) / 2 if crossing.lane else 0.0


def _of_classes(crossing: GateCrossing, classes: Collection[str]) -> float:
    return sum(crossing.trajectory.class_probability(name) for name in classes)
