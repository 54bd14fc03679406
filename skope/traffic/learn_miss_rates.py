"""Miss rates of gates, updated by manual counts.

A manual count at a gate says how many were missed, or counted wrongly, beside those that skope counted. That is added
to the Beta distributions of the gate's shares as observed trials: whole for the same gate and direction at another
time, in part for its other direction, and hardly for other gates of the site, which differ as much as gates do anywhere
(a power prior; Ibrahim and Chen, "Power prior distributions for regression models", 2000).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from skope.traffic.count_uncertainty import Beta, CountErrors
from skope.traffic.event_probability import MissRateGroup

SignedGate = tuple[str, int]
"""Name of a gate, and direction."""
_SAME_SIDE: Final = 0.9
_SAME_GATE: Final = 0.4
_SAME_SITE: Final = 0.05
"""Weights of a manual count at the same gate and direction, in the other direction, and at other gates."""
_MOST_TRIALS: Final = 150.0
"""Number of trials that manual counts are worth at most: rates change with light and weather."""
_REAL_TRIALS: Final = 8.0
"""Number of trials that the usual share of real crossings is worth."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CountEvidence:
    """A manual count at a gate, and what skope saw there meanwhile."""

    side: SignedGate
    errors: Mapping[int, CountErrors]
    """By number of the miss-rate group: the crossings that were counted, with what may be wrong with them."""
    number: int
    """The manual count."""


@dataclass
class _Trials:
    """Observed trials of the shares of one group: successes and failures."""

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
    """The miss rates of each gate and direction, after the manual counts.

    Args:
        evidence: The manual counts, without those that contradict what was seen.
        kinds: The groups at each gate and direction that is asked for: as many at all.

    Returns:
        The groups by gate and direction. Where somebody has counted, no interval is withheld.
    """
    told = [(one.side, _trials(one)) for one in evidence]
    out = {}
    for side, own in kinds.items():
        counted = any(one.side == side for one in evidence)
        out[side] = tuple(_updated(kind, k, side, told, counted=counted) for k, kind in enumerate(own))
    return out


def _updated(
    kind: MissRateGroup,
    number: int,
    side: SignedGate,
    told: Sequence[tuple[SignedGate, Mapping[int, _Trials]]],
    *,
    counted: bool,
) -> MissRateGroup:
    total = _Trials()
    for other, trials in told:
        if number in trials:
            total.add(trials[number], _weight(side, other))
    scale = min(1.0, _MOST_TRIALS / max(1.0, total.missed + total.seen))
    a, b = kind.missed
    c, d = kind.came
    return replace(
        kind,
        missed=(a + scale * total.missed, b + scale * total.seen),
        came=(c + scale * total.came, d + scale * total.stayed),
        real=kind.real * (_REAL_TRIALS + scale * total.seen) / (_REAL_TRIALS + scale * (total.seen + total.false)),
        rejects_losing_gates=kind.rejects_losing_gates and not counted,
        too_small=kind.too_small and not counted,
    )


def _weight(side: SignedGate, other: SignedGate) -> float:
    if side == other:
        return _SAME_SIDE
    return _SAME_GATE if side[0] == other[0] else _SAME_SITE


def _trials(one: CountEvidence) -> dict[int, _Trials]:
    """What a manual count says of each group: the difference is shared out as it was expected."""
    counted = sum(len(errors.false) for errors in one.errors.values())
    lacking, excess = max(0, one.number - counted), max(0, counted - one.number)
    uncounted = {k: sum(errors.uncounted) for k, errors in one.errors.items()}
    lost = {k: errors.possible * _mean(errors.came) for k, errors in one.errors.items()}
    missed = {k: (len(errors.false) + 1) * _odds(errors.missed) for k, errors in one.errors.items()}
    false = {k: sum(errors.false) + 1e-9 for k, errors in one.errors.items()}
    every = sum((*uncounted.values(), *lost.values(), *missed.values())) or 1.0
    out = {}
    for k, errors in one.errors.items():
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
