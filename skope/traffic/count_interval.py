"""How many there really were: the interval of a count whose events are each more or less sure, and some were missed.

How many of the events happened is a Poisson binomial number: a sum of trials that each have a probability of their own
(Hong, "On computing the distribution function for the Poisson binomial distribution", 2013). How many happened besides
that nothing saw is, where each is seen with probability d and nothing else is known of their number, negative binomial;
d itself is known as a Beta distribution.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import betainc, betaincinv

from skope.traffic.event_probability import MISSED
from skope.traffic.normal_distribution import LEVEL
from skope.types import Array

_NODES: Final = 24
"""So many values stand for the distribution of the share that is missed."""
_TAIL: Final = 1e-6
"""Probabilities of a Poisson binomial number that are left out at either end."""


@dataclass(frozen=True)
class CountInterval:
    """The numbers between which the truth lies with `LEVEL`, both included."""

    low: int
    high: int


def poisson_binomial(probabilities: Sequence[float]) -> Array:
    """(N + 1,) probabilities that so many of N independent events happen that have these probabilities (N,)."""
    out = np.ones(1)
    for p in probabilities:
        out = np.convolve(out, [1 - p, p])
    return out


def count_interval(
    probabilities: Sequence[float], missed: tuple[float, float] = MISSED, *, possible: int = 0
) -> CountInterval:
    """The interval of how many there were.

    Args:
        probabilities: Of each event that was seen, how probable it is that it happened and is counted once.
        missed: The share of what happens that nothing sees, as a Beta distribution's two parameters; (0, 1): nothing
            is missed.
    """
    happened = poisson_binomial(probabilities)
    kept = np.flatnonzero(happened > _TAIL * happened.max())
    weights = happened[kept] / happened[kept].sum()
    tail = (1 - LEVEL) / 2
    if missed[0] == 0:
        below = np.cumsum(weights)
        return CountInterval(*(int(kept[np.searchsorted(below, q)]) for q in (tail, 1 - tail)))
    seen = 1 - betaincinv(*missed, (np.arange(_NODES) + 0.5) / _NODES)

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
