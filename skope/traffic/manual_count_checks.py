"""Comparison of manual and automatic counts, and the update of the miss rates of gates.

A manual count at a gate reveals missed and false crossings. They are added to the Beta distributions of the gate's
shares as observed trials. The weight is highest for the same gate and direction, lower for the gate's other direction,
and small for other gates of the site (a power prior; Ibrahim and Chen, "Power prior distributions for regression
models", 2000).
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from typing import Final

import numpy as np
from scipy.special import ndtr

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.traffic.count_uncertainty import Beta, CountDistribution, CountErrors, CountInterval, in_words
from skope.traffic.event_probability import MissRateGroup
from skope.traffic.gate_counts import ALL_CLASSES, distribution_of
from skope.traffic.gates import GateCrossing
from skope.traffic.manual_count_file import ManualCount
from skope.traffic.missed_crossings import MissedCrossings

SignedGate = tuple[str, int]
"""Name of a gate, and direction."""


@dataclass(frozen=True)
class ManualCountModel:
    """Weights and errors of manual counts."""

    same_direction: float = 0.9
    """Weight of a manual count at the same gate and direction."""
    same_gate: float = 0.4
    """Weight of a manual count at the same gate in the other direction."""
    same_site: float = 0.05
    """Weight of a manual count at a different gate of the site."""
    most_trials: float = 150.0
    """Maximum number of trials from manual counts; limited because rates change with light and weather."""
    real_trials: float = 8.0
    """Number of trials that the usual share of real crossings counts as."""
    hour_s: float = 3600.0
    """Seconds per hour."""
    end_variance: float = 0.2
    """Variance of a manual count's error at the ends of its period (chosen, not measured)."""
    relative_error: float = 0.02
    """Relative error of a manual count (chosen, not measured)."""
    contradiction: float = 0.001
    """A manual count contradicts the automatic count if its two-sided tail probability is below this value."""


MANUAL_COUNTS: Final = ManualCountModel()


@dataclass(frozen=True, eq=False, kw_only=True)
class CountEvidence:
    """Manual count at a gate, with the automatic count of the same time."""

    side: SignedGate
    errors: Mapping[int, CountErrors]
    """Automatically counted crossings with their possible errors, by index of the miss-rate group."""
    number: int
    """The manual count."""


@dataclass
class _Trials:
    """Observed trials, successes and failures, for the shares of one group."""

    missed: float = 0.0
    seen: float = 0.0
    came: float = 0.0
    stayed: float = 0.0
    false: float = 0.0

    def add(self, other: "_Trials", weight: float) -> None:
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + weight * value)


def learnt_miss_rates(
    evidence: Sequence[CountEvidence], kinds: Mapping[SignedGate, Sequence[MissRateGroup]]
) -> dict[SignedGate, tuple[MissRateGroup, ...]]:
    """Return the miss rates of each gate and direction, updated by the manual counts.

    Args:
        evidence: The manual counts, without those that contradict the automatic count.
        kinds: The groups at each gate and direction to update. Each gate must have the same number of groups.

    Returns:
        The groups by gate and direction. A gate and direction with a manual count always has a confidence interval.
    """
    trials = [(count.side, _trials(count)) for count in evidence]
    out = {}
    for side, groups in kinds.items():
        counted = any(count.side == side for count in evidence)
        out[side] = tuple(_updated(kind, k, side, trials, counted=counted) for k, kind in enumerate(groups))
    return out


def _updated(
    kind: MissRateGroup,
    number: int,
    side: SignedGate,
    evidence: Sequence[tuple[SignedGate, Mapping[int, _Trials]]],
    *,
    counted: bool,
) -> MissRateGroup:
    total = _Trials()
    for trial_side, trials in evidence:
        if number in trials:
            total.add(trials[number], _weight(side, trial_side))
    scale = min(1.0, MANUAL_COUNTS.most_trials / max(1.0, total.missed + total.seen))
    a, b = kind.missed
    c, d = kind.came
    return replace(
        kind,
        missed=(a + scale * total.missed, b + scale * total.seen),
        came=(c + scale * total.came, d + scale * total.stayed),
        real=kind.real
        * (MANUAL_COUNTS.real_trials + scale * total.seen)
        / (MANUAL_COUNTS.real_trials + scale * (total.seen + total.false)),
        rejects_losing_gates=kind.rejects_losing_gates and not counted,
        too_small=kind.too_small and not counted,
    )


def _weight(side: SignedGate, evidence_side: SignedGate) -> float:
    if side == evidence_side:
        return MANUAL_COUNTS.same_direction
    return MANUAL_COUNTS.same_gate if side[0] == evidence_side[0] else MANUAL_COUNTS.same_site


def _trials(evidence: CountEvidence) -> dict[int, _Trials]:
    """Return the trials of each group. The difference of the counts is divided in proportion to the expected errors."""
    counted = sum(len(errors.false) for errors in evidence.errors.values())
    lacking, excess = max(0, evidence.number - counted), max(0, counted - evidence.number)
    uncounted = {k: sum(errors.uncounted) for k, errors in evidence.errors.items()}
    lost = {k: errors.possible * _mean(errors.came) for k, errors in evidence.errors.items()}
    missed = {k: (len(errors.false) + 1) * _odds(errors.missed) for k, errors in evidence.errors.items()}
    false = {k: sum(errors.false) + 1e-9 for k, errors in evidence.errors.items()}
    every = sum((*uncounted.values(), *lost.values(), *missed.values())) or 1.0
    out = {}
    for k, errors in evidence.errors.items():
        wrong = min(float(len(errors.false)), excess * false[k] / sum(false.values()))
        came = min(float(errors.possible), lacking * lost[k] / every)
        out[k] = _Trials(
            missed=lacking * missed[k] / every,
            seen=len(errors.false) - wrong,
            came=came,
            stayed=errors.possible - came,
            false=wrong,
        )
    return out


def _mean(share: Beta) -> float:
    return share[0] / sum(share)


def _odds(share: Beta) -> float:
    return share[0] / share[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class ManualCountComparison:
    """Manual count with the automatic count of the same gate, direction, classes and time."""

    hand: ManualCount
    count: int
    """Number that skope counted."""
    near: bool
    """Whether a road user was ever detected near the gate; otherwise the manual count is not used."""
    confidence_interval: CountInterval | None
    """90% confidence interval of the true number without the manual count; None if counts have none there."""
    contradicts: bool
    """Whether the manual count is too far from the automatic count for both to be right."""

    @property
    def geh(self) -> float:
        """GEH statistic of the two counts as hourly volumes (Design Manual for Roads and Bridges, volume 12)."""
        interval = self.hand.interval
        hourly = MANUAL_COUNTS.hour_s / (interval.end_s - interval.begin_s)
        together = self.count + self.hand.number
        return math.sqrt(hourly * 2 * (self.count - self.hand.number) ** 2 / together) if together else 0.0


def manual_count_checks(
    hands: Sequence[ManualCount], crossings: Sequence[GateCrossing], unseen: MissedCrossings, settings: TrafficSettings
) -> list[ManualCountComparison]:
    """Compare each manual count with the automatic count.

    Args:
        hands: The manual counts.
        crossings: All crossings that are counted.
        unseen: Road users that may have crossed and are not counted.
        settings: The classes that are counted.
    """
    out = []
    for hand in hands:
        near = hand.gate not in unseen.gates
        crossings_then = _seen(hand, crossings, unseen)
        found = _distribution(hand, crossings_then, unseen, settings) if near else None
        out.append(
            ManualCountComparison(
                hand=hand,
                count=sum(
                    crossing.is_counted and crossing.trajectory.class_name in hand.classes
                    for crossing in crossings_then
                ),
                near=near,
                confidence_interval=None if found is None else found.interval(),
                contradicts=found is not None and _contradicts(hand.number, found),
            )
        )
    return out


def hand_lines(checks: Sequence[ManualCountComparison]) -> Iterator[str]:
    """Yield a sentence for each manual count that contradicts the automatic count or is not used."""
    for check in checks:
        hand = check.hand
        ends = (hand.interval.begin or hand.interval.begin_s, hand.interval.end or hand.interval.end_s)
        begin, end = (f"{end:%H:%M:%S}" if isinstance(end, datetime) else f"{end:g} s" for end in ends)
        where = f"gate {hand.gate!r} ({hand.direction_name}), {hand.class_name} from {begin} to {end}"
        if not check.near:
            yield (
                f"{where}: manual count {hand.number}, but no road user was ever detected near the gate: its counts "
                "stay unknown"
            )
        elif check.contradicts:
            yield (
                f"{where}: manual count {hand.number}, skope {check.count}, expected "
                f"{in_words(check.confidence_interval)}: they contradict each other; check gate, direction, class and "
                "clock of the manual count, or the gate is unusual; intervals at this gate include both, and other "
                "gates do not use this manual count"
            )


def counts_adjusted_by_manual_counts(
    checks: Sequence[ManualCountComparison],
    crossings: Sequence[GateCrossing],
    unseen: MissedCrossings,
    gates: Sequence[Gate],
    settings: TrafficSettings,
) -> MissedCrossings:
    """Update the miss rates of gates with manual counts.

    Args:
        checks: The manual counts with the automatic counts.
        crossings: All crossings that are counted.
        unseen: Road users that may have crossed and are not counted.
        gates: All gates.
        settings: The classes that are counted.

    Returns:
        `unseen` with updated miss rates for each gate and direction. Manual counts at gates near which no road user
        was ever detected are not used.
    """
    evidence = [
        CountEvidence(
            side=(check.hand.gate, check.hand.direction),
            errors=_errors(check.hand, _seen(check.hand, crossings, unseen), unseen, settings),
            number=check.hand.number,
        )
        for check in checks
        if check.near and not check.contradicts
    ]
    sides = [(gate.name, direction) for gate in gates for direction in (0, 1)]
    kinds = {side: unseen.kinds_at(*side) for side in sides}
    doubted = [check for check in checks if check.contradicts]
    learnt = learnt_miss_rates(evidence, kinds) if evidence else dict[tuple[str, int], tuple[MissRateGroup, ...]]()
    for check in doubted:
        # Only this gate uses the contradicting count. Its intervals also include the rates without it.
        side = (check.hand.gate, check.hand.direction)
        errors = _errors(check.hand, _seen(check.hand, crossings, unseen), unseen, settings)
        believed = learnt_miss_rates([CountEvidence(side=side, errors=errors, number=check.hand.number)], kinds)
        learnt |= {learnt_side: rates for learnt_side, rates in believed.items() if learnt_side[0] == side[0]}
    return replace(unseen, learnt=learnt, contradicted=frozenset(check.hand.gate for check in doubted))


def _seen(hand: ManualCount, crossings: Sequence[GateCrossing], unseen: MissedCrossings) -> list[GateCrossing]:
    """Return the crossings of the gate and direction during a manual count, including doubtful ones."""
    side, interval = (hand.gate, hand.direction), hand.interval
    return [
        crossing
        for crossing in (*crossings, *unseen.doubtful)
        if (crossing.gate, crossing.direction) == side and interval.begin_s <= crossing.time_s < interval.end_s
    ]


def _most(hand: ManualCount, unseen: MissedCrossings) -> Callable[[Collection[str]], int]:
    """Return a function that maps classes to the number of lost road users that may have crossed during the count."""
    return partial(unseen.most, hand.gate, hand.direction, hand.interval)


def _errors(
    hand: ManualCount, crossings: Sequence[GateCrossing], unseen: MissedCrossings, settings: TrafficSettings
) -> dict[int, CountErrors]:
    """Return the possible errors of the automatic count, by index of the gate's miss-rate groups."""
    out = {}
    for k, kind in enumerate(unseen.kinds_at(hand.gate, hand.direction)):
        counted = hand.classes & set(settings.classes)
        whole = replace(kind, rejects_losing_gates=False, too_small=False)
        found = distribution_of(crossings, [whole], _most(hand, unseen), ALL_CLASSES, counted)
        if found is not None:
            (out[k],) = found.errors
    return out


def _distribution(
    hand: ManualCount, crossings: Sequence[GateCrossing], unseen: MissedCrossings, settings: TrafficSettings
) -> CountDistribution | None:
    """Return the automatic count with its errors; None if counts have no confidence interval there."""
    kinds = unseen.kinds_at(hand.gate, hand.direction)
    return distribution_of(crossings, kinds, _most(hand, unseen), ALL_CLASSES, hand.classes & set(settings.classes))


def _contradicts(number: int, found: CountDistribution) -> bool:
    """Return whether a manual count this far from the automatic count is improbable."""
    first, pmf = found.number_pmf()
    true = first + np.arange(len(pmf))
    sigma = np.hypot(math.sqrt(MANUAL_COUNTS.end_variance), MANUAL_COUNTS.relative_error * true)
    fewer, more = (float(pmf @ ndtr(sign * (number - true + sign * 0.5) / sigma)) for sign in (1, -1))
    return 2 * min(fewer, more) < MANUAL_COUNTS.contradiction
