"""Interval of a true number: each event that was counted is more or less sure, and some were missed.

How many of the events happened is a Poisson binomial number: a sum of trials that each have a probability of their own
(Hong, "On computing the distribution function for the Poisson binomial distribution", 2013). How many happened besides
that nothing saw is, where each is seen with probability d and nothing else is known of their number, negative binomial;
d itself is known as a Beta distribution.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import betainc
from scipy.stats import betabinom

from skope.traffic.gate_shares import Beta, LearntShares, chances_at, share_at
from skope.traffic.normal_distribution import COUNT_INTERVAL_LEVEL
from skope.types import Array

_NODES: Final = 24
"""So many values stand for the distribution of a share."""
_QUANTILES: Final = (np.arange(_NODES) + 0.5) / _NODES
DRAWS: Final = 20_000
_TAIL: Final = 1e-6
"""Probabilities of a Poisson binomial number that are left out at either end."""


@dataclass(frozen=True)
class CountInterval:
    """The numbers between which the truth lies with `COUNT_INTERVAL_LEVEL`, both included."""

    low: int
    high: int


def in_words(expected: CountInterval | None) -> str:
    """The numbers, as people read them."""
    return "not known" if expected is None else f"{expected.low} to {expected.high}"


def in_cells(expected: CountInterval | None) -> tuple[int | None, int | None]:
    """Cells of a table: low and high, empty where nothing is known."""
    return (None, None) if expected is None else (expected.low, expected.high)


def in_json(expected: CountInterval | None) -> dict[str, int]:
    """Entries of an object; none where nothing is known."""
    return {} if expected is None else {"low": expected.low, "high": expected.high}


def poisson_binomial(probabilities: Sequence[float]) -> Array:
    """(N + 1,) probabilities that so many of N independent events happen that have these probabilities (N,)."""
    out = np.ones(1)
    for p in probabilities:
        out = np.convolve(out, [1 - p, p])
    return out


@dataclass(frozen=True)
class Group:
    """Counted events of road users that are missed alike."""

    probabilities: Sequence[float]
    """Of each event that was seen, how probable it is that it happened and is counted once."""
    missed: Beta
    """The share of what happens that nothing sees, as a Beta distribution's two parameters; (0, 1): nothing is."""
    real: Beta | None = None
    """The share of the events that are one, common to all of them, as a Beta distribution whose mean is in the
    probabilities; None: each is one or not by itself."""
    possible: int = 0
    """Number of further ones that there may have been."""
    came: Beta = (1.0, 1.0)
    """The share of these that there were, as a Beta distribution; (1, 1): any number is as probable as any other."""
    learnt: LearntShares | None = None
    """These shares as a hand count tells them, in place of the distributions over all gates; None: there is none."""

    def with_came(self, came: Beta) -> "Group":
        """The group where of those who may have been there as many came as a Beta distribution says."""
        learnt = None if self.learnt is None else self.learnt.with_came(came)
        return replace(self, came=came, learnt=learnt)

    def happened(self) -> tuple[Array, Array]:
        """(K,) numbers of events that were seen or possible and happened, and (K,) their probabilities."""
        seen = poisson_binomial(self.probabilities)
        if self.real is not None:
            chances = chances_at(self.real, np.asarray(self.probabilities), _QUANTILES)
            seen = np.mean([poisson_binomial(row) for row in chances.tolist()], axis=0)
        every = np.convolve(seen, betabinom.pmf(np.arange(self.possible + 1), self.possible, *self.came))
        kept = np.flatnonzero(every > _TAIL * every.max())
        return kept.astype(np.float64), every[kept] / every[kept].sum()

    def drawn(self, rng: np.random.Generator) -> Array:
        """(`DRAWS`,) numbers that there may have been, in no order."""
        if self.learnt is not None:
            repeats = DRAWS // len(self.learnt.missed)
            return self.learnt.drawn(self.real, np.asarray(self.probabilities), self.possible, repeats, rng)
        numbers, weights = self.happened()
        happened = rng.choice(numbers, DRAWS, p=weights)
        if self.missed[0] == 0:
            return np.asarray(happened)
        shares = (rng.permutation(DRAWS) + 0.5) / DRAWS
        return np.asarray(happened + rng.negative_binomial(happened + 1, 1 - share_at(self.missed, shares)))


def count_interval(probabilities: Sequence[float], missed: tuple[float, float]) -> CountInterval:
    """The interval of how many there were of one `Group`."""
    return joint_interval([Group(probabilities, missed)])


def joint_draws(groups: Sequence[Group]) -> Array:
    """(`DRAWS`,) numbers that there may have been of all groups together, always the same of the same groups."""
    rng = np.random.default_rng(0)
    return np.asarray(np.sum([one.drawn(rng) for one in groups], axis=0))


def joint_interval(groups: Sequence[Group]) -> CountInterval:
    """The interval of how many there were of all groups together; of several, from draws that are always the same."""
    told = [one for one in groups if len(one.probabilities) or one.possible]
    told = told or [max(groups, key=lambda one: one.missed[0] / sum(one.missed))]
    tail = (1 - COUNT_INTERVAL_LEVEL) / 2
    if len(told) > 1 or told[0].learnt is not None:
        low, high = np.quantile(joint_draws(told), (tail, 1 - tail), method="inverted_cdf")
        return CountInterval(int(low), int(high))
    (one,) = told
    kept, weights = one.happened()
    if one.missed[0] == 0:
        below = np.cumsum(weights)
        return CountInterval(*(int(kept[np.searchsorted(below, q)]) for q in (tail, 1 - tail)))
    seen = 1 - share_at(one.missed, _QUANTILES)

    def at_most(number: int) -> float:
        besides = number - kept[:, None]
        # Of a negative binomial number of failures before k + 1 successes.
        chance = betainc(kept[:, None] + 1.0, np.maximum(besides, 0) + 1.0, seen)
        return float((weights[:, None] * np.where(besides >= 0, chance, 0.0)).sum() / _NODES)

    return CountInterval(_quantile(at_most, tail, int(kept[-1])), _quantile(at_most, 1 - tail, int(kept[-1])))


def _quantile(at_most: Callable[[int], float], share: float, begin: int) -> int:
    """The least whole number up to which there is at least `share` of the distribution function `at_most`."""
    low, high = -1, begin
    while at_most(high) < share:
        low, high = high, 2 * high + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if at_most(middle) >= share else (middle, high)
    return high
