"""Hand counts beside what skope counted, and what they change in what is said of the gates."""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from typing import Final

import numpy as np
from scipy.special import ndtr

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.traffic.count_uncertainty import CountDistribution, CountErrors, CountInterval, in_words
from skope.traffic.event_probability import MissRateGroup
from skope.traffic.gate_counts import ALL, distribution_of
from skope.traffic.gates import GateCrossing
from skope.traffic.hand_count_file import HandCount
from skope.traffic.learn_miss_rates import CountEvidence, learnt_miss_rates
from skope.traffic.missed_crossings import Unseen

_HOUR_S: Final = 3600.0
_END_VARIANCE: Final = 0.2
_SLIPS: Final = 0.02
"""Variance of a manual count's error at the ends of its period, and its relative error (chosen, not measured)."""
_CONTRADICTS: Final = 0.001
"""A hand count as far from what is expected as fewer than this share of them would be contradicts it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HandCheck:
    """A count by hand, and what skope says of the same gate, direction, classes and time."""

    hand: HandCount
    count: int
    """Number that skope counted."""
    near: bool
    """Whether anybody was ever seen near the gate: of another one nothing is learnt."""
    expected: CountInterval | None
    """Between which numbers the truth is by what was seen alone; None where counts have no interval either."""
    contradicts: bool
    """Whether the hand count is so far from what was seen that one of the two must be wrong."""

    @property
    def geh(self) -> float:
        """The GEH statistic of the two as vehicles per hour (Design Manual for Roads and Bridges, volume 12)."""
        interval = self.hand.interval
        hourly = _HOUR_S / (interval.end_s - interval.begin_s)
        together = self.count + self.hand.number
        return math.sqrt(hourly * 2 * (self.count - self.hand.number) ** 2 / together) if together else 0.0


def hand_checks(
    hands: Sequence[HandCount], crossings: Sequence[GateCrossing], unseen: Unseen, settings: TrafficSettings
) -> list[HandCheck]:
    """Put each hand count beside what was counted.

    Args:
        hands: The hand counts.
        crossings: All crossings that are counted.
        unseen: Who may have crossed and is not counted.
        settings: The classes that are counted.
    """
    out = []
    for one in hands:
        near = one.gate not in unseen.gates
        own = _seen(one, crossings, unseen)
        found = _distribution(one, own, unseen, settings) if near else None
        out.append(
            HandCheck(
                hand=one,
                count=sum(each.counts and each.trajectory.class_name in one.classes for each in own),
                near=near,
                expected=None if found is None else found.interval(),
                contradicts=found is not None and _contradicts(one.number, found),
            )
        )
    return out


def hand_lines(checks: Sequence[HandCheck]) -> Iterator[str]:
    """Hand counts that contradict what was seen, and those of which nothing was learnt, in sentences."""
    for one in checks:
        hand = one.hand
        ends = (hand.interval.begin or hand.interval.begin_s, hand.interval.end or hand.interval.end_s)
        begin, end = (f"{end:%H:%M:%S}" if isinstance(end, datetime) else f"{end:g} s" for end in ends)
        where = f"gate {hand.gate!r} ({hand.direction_name}), {hand.class_name} from {begin} to {end}"
        if not one.near:
            yield f"{where}: {hand.number} counted by hand where nobody was ever seen: its counts stay unknown"
        elif one.contradicts:
            yield (
                f"{where}: {hand.number} counted by hand, {one.count} by skope, "
                f"{in_words(one.expected)} expected: they contradict each other (gate, direction, class or clock of "
                "the hand count, or a gate like no other); intervals at this gate hold both, others learn "
                "nothing from it"
            )


def counts_adjusted_by_hand(
    checks: Sequence[HandCheck],
    crossings: Sequence[GateCrossing],
    unseen: Unseen,
    gates: Sequence[Gate],
    settings: TrafficSettings,
) -> Unseen:
    """Learn from hand counts what gates miss.

    Args:
        checks: The hand counts beside what was counted.
        crossings: All crossings that are counted.
        unseen: Who may have crossed and is not counted.
        gates: All gates.
        settings: The classes that are counted.

    Returns:
        `unseen` with what is learnt of each gate and direction; counts at gates that nobody was ever seen near teach
        nothing.
    """
    evidence = [
        CountEvidence(
            side=(one.hand.gate, one.hand.direction),
            errors=_errors(one.hand, _seen(one.hand, crossings, unseen), unseen, settings),
            number=one.hand.number,
        )
        for one in checks
        if one.near and not one.contradicts
    ]
    sides = [(gate.name, direction) for gate in gates for direction in (0, 1)]
    kinds = {side: unseen.kinds_at(*side) for side in sides}
    doubted = [one for one in checks if one.contradicts]
    learnt = learnt_miss_rates(evidence, kinds) if evidence else dict[tuple[str, int], tuple[MissRateGroup, ...]]()
    for one in doubted:
        # At this gate alone the contradicting count is believed too, beside what was seen.
        side = (one.hand.gate, one.hand.direction)
        own = _errors(one.hand, _seen(one.hand, crossings, unseen), unseen, settings)
        believed = learnt_miss_rates([CountEvidence(side=side, errors=own, number=one.hand.number)], kinds)
        learnt |= {other: rates for other, rates in believed.items() if other[0] == side[0]}
    return replace(unseen, learnt=learnt, contradicted=frozenset(one.hand.gate for one in doubted))


def _seen(hand: HandCount, crossings: Sequence[GateCrossing], unseen: Unseen) -> list[GateCrossing]:
    """The crossings of the gate and direction, doubtful ones too, while somebody counted."""
    side, interval = (hand.gate, hand.direction), hand.interval
    return [
        one
        for one in (*crossings, *unseen.doubtful)
        if (one.gate, one.direction) == side and interval.begin_s <= one.time_s < interval.end_s
    ]


def _most(hand: HandCount, unseen: Unseen) -> Callable[[Collection[str]], int]:
    """Make a function of classes that gives how many more of them may have crossed meanwhile."""
    return partial(unseen.most, hand.gate, hand.direction, hand.interval)


def _errors(
    hand: HandCount, own: Sequence[GateCrossing], unseen: Unseen, settings: TrafficSettings
) -> dict[int, CountErrors]:
    """What may be wrong with the count beside a manual one, by the gate's miss-rate groups."""
    out = {}
    for k, kind in enumerate(unseen.kinds_at(hand.gate, hand.direction)):
        counted = hand.classes & set(settings.classes)
        whole = replace(kind, rejects_losing_gates=False, too_small=False)
        found = distribution_of(own, [whole], _most(hand, unseen), ALL, counted)
        if found is not None:
            (out[k],) = found.errors
    return out


def _distribution(
    hand: HandCount, own: Sequence[GateCrossing], unseen: Unseen, settings: TrafficSettings
) -> CountDistribution | None:
    """skope's count beside a manual one, with its errors; None where counts have no interval either."""
    kinds = unseen.kinds_at(hand.gate, hand.direction)
    return distribution_of(own, kinds, _most(hand, unseen), ALL, hand.classes & set(settings.classes))


def _contradicts(number: int, found: CountDistribution) -> bool:
    """Whether hardly any manual count would be as far away, by what was seen alone."""
    first, pmf = found.number_pmf()
    true = first + np.arange(len(pmf))
    sigma = np.hypot(math.sqrt(_END_VARIANCE), _SLIPS * true)
    fewer, more = (float(pmf @ ndtr(sign * (number - true + sign * 0.5) / sigma)) for sign in (1, -1))
    return 2 * min(fewer, more) < _CONTRADICTS
