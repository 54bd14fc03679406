"""How many crossed each gate, by direction, lane, class and interval on the clock."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from skope.site.marks import Gate
from skope.site.traffic_settings import CLASSES, UNKNOWN, TrafficSettings
from skope.traffic.clock import ClockInterval
from skope.traffic.count_interval import CountInterval, Group, joint_interval
from skope.traffic.event_probability import SeenAlike
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.observation import Observation
from skope.traffic.vanished import Unseen

ALL: Final = "all"
_WHOLE: Final = 0.999
"""An interval of which so much was observed was observed."""


@dataclass(frozen=True, kw_only=True)
class Count:
    """How many of a kind crossed a gate in an interval."""

    interval: ClockInterval
    observed_s: float
    """How much of the interval was observed, seconds."""
    gate: str
    direction: str
    lane: str
    """A lane's name, "" for who is in none, or `ALL`."""
    class_name: str
    """A class, or `ALL`."""
    count: int | None
    """None: nothing was observed."""
    expected: CountInterval | None
    """Between which numbers the truth is, of what was observed; None where nothing was, where nobody was ever seen near
    the gate, or of the class unknown, which nobody is in truth."""

    @property
    def observed(self) -> str:
        """Whether the interval was observed: all, part or nothing."""
        return observed_word(self.interval, self.observed_s)


def observed_word(interval: ClockInterval, observed_s: float) -> str:
    """All, part or nothing."""
    if observed_s <= 0:
        return "nothing"
    return "all" if observed_s >= _WHOLE * (interval.end_s - interval.begin_s) else "part"


def counts(
    crossings: Sequence[GateCrossing],
    gates: Sequence[Gate],
    lanes: Sequence[str],
    intervals: Sequence[ClockInterval],
    observation: Observation,
    settings: TrafficSettings,
    unseen: Unseen,
) -> list[Count]:
    """A count for each interval, gate and direction: of all, of each class, and of each lane.

    Nothing counted is 0; nothing observed has no count.
    """
    out = []
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
                for lane, class_name in _kinds(used, settings):
                    told = None
                    if observed_s > 0 and gate.name not in unseen.gates:
                        most = partial(unseen.most, gate.name, k, interval)
                        told = expected([*own, *perhaps], unseen.kinds_at(gate.name, k), most, lane, class_name)
                    out.append(
                        Count(
                            interval=interval,
                            observed_s=observed_s,
                            gate=gate.name,
                            direction=direction,
                            lane=lane,
                            class_name=class_name,
                            count=_number(own, lane, class_name) if observed_s > 0 else None,
                            expected=told,
                        )
                    )
    return out


def _kinds(lanes: Sequence[str], settings: TrafficSettings) -> Iterator[tuple[str, str]]:
    """The lane and class of each row."""
    yield ALL, ALL
    for name in settings.classes:
        yield ALL, name
    if lanes:
        for lane in (*lanes, ""):
            yield lane, ALL


def _number(crossings: Sequence[GateCrossing], lane: str, class_name: str) -> int:
    return sum(lane in (ALL, one.lane) and class_name in (ALL, one.trajectory.class_name) for one in crossings)


def expected(
    crossings: Sequence[GateCrossing],
    kinds: Sequence[SeenAlike],
    most: Callable[[Collection[str]], int],
    lane: str,
    class_name: str,
) -> CountInterval | None:
    """The interval of how many there were, of all in a lane and of a class.

    Who is counted in another lane or class may be of this one: each counts with the probability that it is. `most` is
    how many more there may have been of classes.
    """
    if class_name == UNKNOWN:
        return None
    classes = CLASSES if class_name == ALL else (class_name,)
    groups = (group_of(kind, crossings, most, lane, classes) for kind in kinds)
    return joint_interval([one for one in groups if one is not None])


def group_of(
    kind: SeenAlike,
    crossings: Sequence[GateCrossing],
    most: Callable[[Collection[str]], int],
    lane: str,
    classes: Collection[str],
) -> Group | None:
    """Those of a kind who may have been of one of the classes, and in the lane; None where the kind has none of them.

    `most` is how many more there may have been of classes.
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
