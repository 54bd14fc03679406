"""Movements: which gate, and in which direction, each road user crossed after which.

Each crossing is once a row's, as where somebody comes from, and once a column's, as where somebody goes. Who was not
seen before or after has a column or row of its own, so that rows and columns add up to the gates' counts, U-turns and
all.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from skope.site.marks import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.traffic.clock import ClockInterval
from skope.traffic.count_interval import CountInterval, joint_interval
from skope.traffic.event_probability import SEEN_IN_METRES, SeenAlike
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.observation import Observation
from skope.traffic.trajectories import Trajectory

Side = tuple[str, str]
"""A gate and the name of a direction."""
NOWHERE: Final[Side] = ("", "")
"""Not seen at a gate before, or after."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Movement:
    """A road user crosses one gate and then the next one; None: it is seen at no gate before, or after."""

    origin: GateCrossing | None
    destination: GateCrossing | None

    @property
    def time_s(self) -> float:
        """When it crosses the first of the two that it is seen at, seconds."""
        return self._first.time_s

    @property
    def sides(self) -> tuple[Side, Side]:
        """Where from and where to."""
        return _side(self.origin), _side(self.destination)

    @property
    def trajectory(self) -> Trajectory:
        """Whose it is."""
        return self._first.trajectory

    @property
    def _first(self) -> GateCrossing:
        first = self.origin or self.destination
        assert first is not None
        return first

    @property
    def probability(self) -> float:
        """Probability that it happened: both of its crossings did."""
        return min(one.probability for one in (self.origin, self.destination) if one is not None)


@dataclass(frozen=True, kw_only=True)
class TurningCount:
    """How many went from one gate to another in an interval."""

    interval: ClockInterval
    origin: Side
    destination: Side
    count: int | None
    """None: nothing was observed."""
    expected: CountInterval | None
    """Between which numbers the truth is; None where nothing was observed, or for who was not seen at one of the two:
    these went somewhere in truth."""


def _side(crossing: GateCrossing | None) -> Side:
    return NOWHERE if crossing is None else (crossing.gate, crossing.direction_name)


def movements(crossings: Sequence[GateCrossing], settings: TrafficSettings) -> list[Movement]:
    """The movements between the gates that `settings.turning` names, or all, in order of time."""
    chosen = [one for one in crossings if settings.turning is None or one.gate in settings.turning]
    by_track: dict[int, list[GateCrossing]] = {}
    for one in chosen:
        by_track.setdefault(one.trajectory.number, []).append(one)
    found = [
        Movement(origin=before, destination=after)
        for chain in by_track.values()
        for before, after in itertools.pairwise([None, *chain, None])
    ]
    return sorted(found, key=lambda one: one.time_s)


def turning_counts(
    found: Sequence[Movement],
    gates: Sequence[Gate],
    intervals: Sequence[ClockInterval],
    observation: Observation,
    settings: TrafficSettings,
    kinds: Mapping[str, Sequence[SeenAlike]] | None = None,
) -> list[TurningCount]:
    """The matrix of each interval: a count for each pair that anybody has driven in the whole footage.

    A movement counts in the interval of the crossing that it comes from, or, without one, of that which it goes to.
    `kinds` are who is missed at each gate; of a movement that which misses more counts.
    """
    chosen = [gate for gate in gates if settings.turning is None or gate.name in settings.turning]
    order = {side: k for k, side in enumerate([*((g.name, d) for g in chosen for d in direction_names(g)), NOWHERE])}
    pairs = sorted({one.sides for one in found}, key=lambda pair: (order[pair[0]], order[pair[1]]))
    share = _shares(found)
    out = []
    for interval in intervals:
        observed = observation.seconds_in(interval.begin_s, interval.end_s) > 0
        there = [one for one in found if interval.begin_s <= one.time_s < interval.end_s]
        for pair in pairs:
            own = [one for one in there if one.sides == pair]
            told = (
                None
                if not observed or NOWHERE in pair
                else _expected(own, there, pair, share, _missed_more(pair, kinds or {}))
            )
            out.append(
                TurningCount(
                    interval=interval,
                    origin=pair[0],
                    destination=pair[1],
                    count=len(own) if observed else None,
                    expected=told,
                )
            )
    return out


def _missed_more(pair: tuple[Side, Side], kinds: Mapping[str, Sequence[SeenAlike]]) -> list[SeenAlike]:
    """The kinds as the one of two gates misses them that misses more of them."""
    both = (kinds.get(gate, SEEN_IN_METRES) for gate, _ in pair)
    return [max(alike, key=lambda kind: kind.missed[0] / sum(kind.missed)) for alike in zip(*both, strict=True)]


def _shares(found: Sequence[Movement]) -> dict[tuple[Side, Side], float]:
    """Of those who come from a gate and were seen at another one, the share that went to each one."""
    whole = [one.sides for one in found if NOWHERE not in one.sides]
    rows = {origin: sum(pair[0] == origin for pair in whole) for origin, _ in whole}
    return {pair: whole.count(pair) / rows[pair[0]] for pair in set(whole)}


def _expected(
    own: Sequence[Movement],
    there: Sequence[Movement],
    pair: tuple[Side, Side],
    share: dict[tuple[Side, Side], float],
    kinds: Sequence[SeenAlike],
) -> CountInterval:
    """Who was lost after the first gate may have gone this way: with the share of the others from there that did."""
    lost = [one for one in there if one.sides == (pair[0], NOWHERE)]
    groups = []
    for kind in kinds:
        went, may = ([one for one in every if one.trajectory.class_name in kind.classes] for every in (own, lost))
        chances = [*(one.probability for one in went), *(one.probability * share.get(pair, 0.0) for one in may)]
        groups.append(kind.group(chances))
    return joint_interval(groups)
