"""Count crossings at each gate by direction, lane, class and counting interval, with passenger-car equivalents."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from skope.schema import PEDESTRIAN_CATEGORY, VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import OF_VEHICLES, UNKNOWN_CLASS, VEHICLE_CLASSES, TrafficSettings
from skope.traffic.count_uncertainty import CountDistribution, CountErrors, CountInterval, hull
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import MissRateGroup
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.missed_crossings import MissedCrossings
from skope.traffic.observation import Observation


@dataclass(frozen=True)
class CountLimits:
    """Minimum shares for complete counts and known classes."""

    known_share: float = 0.5
    """Minimum share of vehicles with a known class at a gate and direction. Below it, passenger-car equivalents are not
    available."""
    observed_share: float = 0.999
    """Fraction of a counting interval that must be observed for its count to be complete."""


COUNT_LIMITS: Final = CountLimits()


def pce_factors(crossings: Sequence[GateCrossing], settings: TrafficSettings) -> dict[str, float] | None:
    """Return the passenger-car equivalent of each class at one gate and direction.

    A vehicle of class unknown gets the mean factor of the vehicles with a known class (car, van, lorry, bus) there.

    Args:
        crossings: All crossings of the gate and direction that are counted, over the whole footage.
        settings: The factors of the site.

    Returns:
        Class -> factor. None if fewer than half of the vehicles have a known class.
    """
    factors = {"car": 1.0, PEDESTRIAN_CATEGORY: 0.0, **settings.pce}
    classes = [crossing.trajectory.class_name for crossing in crossings]
    known = [factors[name] for name in classes if name in VEHICLE_CLASSES]
    unknown = classes.count(UNKNOWN_CLASS)
    if not unknown:
        return factors
    if len(known) < COUNT_LIMITS.known_share * (len(known) + unknown):
        return None
    return {**factors, UNKNOWN_CLASS: sum(known) / len(known)}


def passenger_cars(crossings: Sequence[GateCrossing], factors: Mapping[str, float] | None) -> float | None:
    """Return the sum of the passenger-car equivalents of crossings, to three decimals; None without factors.

    Args:
        crossings: Crossings of one gate and direction.
        factors: Result of `pce_factors` for this gate and direction.
    """
    return None if factors is None else round(sum(factors[crossing.trajectory.class_name] for crossing in crossings), 3)


ALL_CLASSES: Final = "all"


@dataclass(frozen=True, kw_only=True)
class Count:
    """Number of road users of a class, or in a lane, that crossed a gate in a counting interval."""

    interval: ClockInterval
    observed_s: float
    """Observed part of the counting interval, seconds."""
    gate: str
    direction: str
    lane: str
    """Name of a lane, "" for road users in no lane, or `ALL_CLASSES`."""
    class_name: str
    """A class, `VEHICLE_CATEGORY` for vehicles with more than two wheels, or `ALL_CLASSES`."""
    count: int | None
    """Number of counted crossings; None if nothing was observed."""
    confidence_interval: CountInterval | None
    """90% confidence interval of the true number in the observed time. None if nothing was observed, no road user was
    ever seen near the gate, more vehicles are lost than counted there, or for class `unknown`."""
    pce: float | None = None
    """Passenger-car equivalents of the counted road users. None for rows of one class or of vehicles, if nothing was
    observed, or if too few vehicles at the gate have a known class."""

    @property
    def observed(self) -> str:
        """Observed part of the counting interval: "full", "partial" or "none"."""
        return observed_word(self.interval, self.observed_s)


def observed_word(interval: ClockInterval, observed_s: float) -> str:
    """Return how much of a counting interval was observed: "full", "partial" or "none"."""
    if observed_s <= 0:
        return "none"
    return "full" if observed_s >= COUNT_LIMITS.observed_share * (interval.end_s - interval.begin_s) else "partial"


def interval_counts(
    crossings: Sequence[GateCrossing],
    gates: Sequence[Gate],
    lanes: Sequence[str],
    intervals: Sequence[ClockInterval],
    observation: Observation,
    settings: TrafficSettings,
    unseen: MissedCrossings,
    *,
    by_class: bool = True,
) -> list[Count]:
    """Count crossings for each counting interval, gate and direction: all, vehicles, each class and each lane.

    A count is 0 if nothing crossed, and None if nothing was observed. Vehicles have separate rows if further
    classes are counted.

    Args:
        crossings: The crossings that are counted.
        gates: All gates.
        lanes: Names of all lanes. A gate has rows only for lanes in which it is crossed.
        intervals: The intervals.
        observation: The observed times.
        settings: The classes that are counted.
        unseen: Road users that may have crossed and are not counted.
        by_class: Whether to add rows for single classes.
    """
    out = []
    factors = {
        (gate.name, k): pce_factors(
            [crossing for crossing in crossings if (crossing.gate, crossing.direction) == (gate.name, k)], settings
        )
        for gate in gates
        for k in (0, 1)
    }
    for interval in intervals:
        observed_s = observation.seconds_in(interval.begin_s, interval.end_s)
        in_interval, doubtful_in_interval = (
            [crossing for crossing in every if interval.begin_s <= crossing.time_s < interval.end_s]
            for every in (crossings, unseen.doubtful)
        )
        for gate in gates:
            for k, direction in enumerate(direction_names(gate)):
                at_gate, doubtful_at_gate = (
                    [crossing for crossing in every if crossing.gate == gate.name and crossing.direction == k]
                    for every in (in_interval, doubtful_in_interval)
                )
                used = [
                    lane
                    for lane in lanes
                    if any(crossing.lane == lane for crossing in crossings if crossing.gate == gate.name)
                ]
                for lane, class_name in _kinds(used, settings, by_class=by_class):
                    bounds = None
                    if observed_s > 0 and gate.name not in unseen.gates:
                        classes = classes_of(class_name, settings)
                        bounds = row_interval(
                            [*at_gate, *doubtful_at_gate], unseen, (gate.name, k), interval, lane, classes
                        )
                    pce = None
                    if observed_s > 0 and class_name == ALL_CLASSES:
                        in_lane = [crossing for crossing in at_gate if lane in (ALL_CLASSES, crossing.lane)]
                        pce = passenger_cars(in_lane, factors[gate.name, k])
                    out.append(
                        Count(
                            interval=interval,
                            observed_s=observed_s,
                            gate=gate.name,
                            direction=direction,
                            lane=lane,
                            class_name=class_name,
                            count=_number(at_gate, lane, classes_of(class_name, settings)) if observed_s > 0 else None,
                            confidence_interval=bounds,
                            pce=pce,
                        )
                    )
    return out


def _kinds(lanes: Sequence[str], settings: TrafficSettings, *, by_class: bool) -> Iterator[tuple[str, str]]:
    """Yield the lane and class of each row."""
    for name in row_classes(settings):
        yield ALL_CLASSES, name
    if by_class:
        for name in settings.classes:
            yield ALL_CLASSES, name
    if lanes:
        for lane in (*lanes, ""):
            yield lane, ALL_CLASSES


def row_classes(settings: TrafficSettings) -> tuple[str, ...]:
    """Return `ALL_CLASSES`, and `VEHICLE_CATEGORY` if both vehicles and other classes are counted."""
    mixed = not OF_VEHICLES.isdisjoint(settings.classes) and not OF_VEHICLES.issuperset(settings.classes)
    return (ALL_CLASSES, VEHICLE_CATEGORY) if mixed else (ALL_CLASSES,)


def classes_of(class_name: str, settings: TrafficSettings) -> frozenset[str]:
    """Return the classes that a row includes."""
    if class_name == VEHICLE_CATEGORY:
        return OF_VEHICLES & set(settings.classes)
    return frozenset(settings.classes) if class_name == ALL_CLASSES else frozenset({class_name})


def _number(crossings: Sequence[GateCrossing], lane: str, classes: Collection[str]) -> int:
    return sum(
        lane in (ALL_CLASSES, crossing.lane) and crossing.trajectory.class_name in classes for crossing in crossings
    )


def is_in_row(crossing: GateCrossing, lane: str, classes: Collection[str]) -> bool:
    """Return whether a crossing is counted in a row of a lane (or `ALL_CLASSES`) and classes."""
    return crossing.is_counted and lane in (ALL_CLASSES, crossing.lane) and crossing.trajectory.class_name in classes


def row_interval(
    crossings: Sequence[GateCrossing],
    unseen: MissedCrossings,
    side: tuple[str, int],
    interval: ClockInterval,
    lane: str,
    classes: Collection[str],
) -> CountInterval | None:
    """Return the confidence interval of the true number of a row at a gate.

    The confidence interval accounts for road users that may have been missed, manual counts, and the error of the
    camera parameters.

    Args:
        crossings: Crossings of the gate, direction and interval, including those that are not counted.
        unseen: Road users that may have been missed.
        side: Name of the gate, and direction.
        interval: The interval.
        lane: Name of a lane, or `ALL_CLASSES`.
        classes: The classes of the row.

    Returns:
        The confidence interval; None if `confidence_interval` returns None.
    """
    most = partial(unseen.most, *side, interval)
    count = sum(is_in_row(crossing, lane, classes) for crossing in crossings)
    shifts = [
        sum(
            (crossing.gate, crossing.direction) == side
            and interval.begin_s <= crossing.time_s < interval.end_s
            and is_in_row(crossing, lane, classes)
            for crossing in drawn_crossings
        )
        - count
        for drawn_crossings in unseen.other_cameras.get(side[0], ())
    ]
    found = [confidence_interval(crossings, kinds, most, lane, classes, shifts) for kinds in unseen.kind_sets(*side)]
    known = [bounds for bounds in found if bounds is not None]
    return hull(known) if len(known) == len(found) else None


def confidence_interval(
    crossings: Sequence[GateCrossing],
    kinds: Sequence[MissRateGroup],
    most: Callable[[Collection[str]], int],
    lane: str,
    classes: Collection[str],
    shifts: Sequence[int] = (),
) -> CountInterval | None:
    """Return the confidence interval of the true number of a row of classes, in one lane or in all lanes.

    Args:
        crossings: Crossings of the gate, direction and interval, including those that are not counted.
        kinds: The miss rates at the gate.
        most: Maps classes to the number of their lost tracks that may have crossed.
        lane: Name of a lane, or `ALL_CLASSES`.
        classes: The classes of the row.
        shifts: Changes of the row's count under sampled camera parameters (`CountDistribution.shifts`).

    Returns:
        The confidence interval. None for class `unknown`, or if too few of the road users are detected at the gate.
    """
    distribution = distribution_of(crossings, kinds, most, lane, classes, shifts)
    return None if distribution is None else distribution.interval()


def distribution_of(
    crossings: Sequence[GateCrossing],
    kinds: Sequence[MissRateGroup],
    most: Callable[[Collection[str]], int],
    lane: str,
    classes: Collection[str],
    shifts: Sequence[int] = (),
) -> CountDistribution | None:
    """Return the count of a row with its errors.

    Arguments, and the cases of None, are those of `confidence_interval`.
    """
    errors, count = [], 0
    for kind in kinds:
        named = kind.classes - {UNKNOWN_CLASS}
        if not named & set(classes):
            continue
        group_crossings = [crossing for crossing in crossings if crossing.trajectory.class_name in kind.classes]
        if kind.loses(sum(crossing.is_counted for crossing in group_crossings), most(kind.classes)):
            return None
        whole = named <= set(classes)
        false, uncounted = [], []
        for crossing in group_crossings:
            chance = (
                kind.real
                * crossing.probability
                * _in_lane(crossing, lane)
                * (1.0 if whole else _of_classes(crossing, classes))
            )
            if is_in_row(crossing, lane, kind.classes if whole else classes):
                false.append(1 - chance)
            elif chance > 0:
                uncounted.append(chance)
        possible = most(kind.classes if whole else kind.classes & {*classes, UNKNOWN_CLASS})
        errors.append(CountErrors(false, uncounted, possible, kind.came, kind.missed))
        count += len(false)
    return CountDistribution(count, errors, shifts) if errors else None


def _in_lane(crossing: GateCrossing, lane: str) -> float:
    if lane == ALL_CLASSES:
        return 1.0
    if crossing.lane == lane:
        return crossing.lane_probability
    # If the lane is wrong, a lane on either side or none is right: each has half of the remaining probability.
    return (1 - crossing.lane_probability) / 2 if crossing.lane else 0.0


def _of_classes(crossing: GateCrossing, classes: Collection[str]) -> float:
    return sum(crossing.trajectory.class_probability(name) for name in classes)
