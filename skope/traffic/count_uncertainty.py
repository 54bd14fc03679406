"""Interval of a true number around a count, from the two ways in which a count is wrong.

A count may hold false ones (F), and may lack others (A): the true number is count - F + A. F is a sum of trials, each
with its own probability (a Poisson binomial number; Hong, "On computing the distribution function for the Poisson
binomial distribution", 2013). A has three parts: crossings that are seen and not counted, tracks that were lost near
the gate, and road users that nothing saw. Of the last, if a share m of all is missed, a negative binomial number is
missing beside those that were counted; m itself is known as a Beta distribution.

The interval lies between the count less the 95% quantile of F and the count plus the 95% quantile of A. The true number
lies below it, or above it, with a probability of at most 5% each, and the count itself is always inside.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Final, TypeAlias

import numpy as np
from scipy.special import betaln, gammaln
from scipy.stats import betabinom

from skope.confidence_level import INTERVAL_LEVEL
from skope.types import Array

Beta: TypeAlias = tuple[float, float]
"""Parameters a and b of a Beta distribution of a share; (0, 1): the share is 0."""
_SIDE_LEVEL: Final = 1 - (1 - INTERVAL_LEVEL) / 2
"""Level of each of the two quantiles."""


@dataclass(frozen=True)
class DistributionLimits:
    """How far distributions of counts are computed."""

    mass: float = 0.9999
    """Share of a distribution's probability that is computed. The rest is put at its last number."""
    largest_count: int = 2**20
    """Largest number that is computed."""


DISTRIBUTION_LIMITS: Final = DistributionLimits()


@dataclass(frozen=True)
class CountInterval:
    """Inclusive bounds of a true number at `INTERVAL_LEVEL` (90%)."""

    low: int
    high: int


def in_words(expected: CountInterval | None) -> str:
    """The bounds, as people read them."""
    return "not known" if expected is None else f"{expected.low} to {expected.high}"


def in_cells(expected: CountInterval | None) -> tuple[int | None, int | None]:
    """Cells of a table: low and high, empty where nothing is known."""
    return (None, None) if expected is None else (expected.low, expected.high)


def in_json(expected: CountInterval | None) -> dict[str, int]:
    """Entries of an object; none where nothing is known."""
    return {} if expected is None else {"low": expected.low, "high": expected.high}


@dataclass(frozen=True)
class CountErrors:
    """What may be wrong with a count of road users that share one miss rate."""

    false: Sequence[float] = ()
    """Probability of each that was counted to be none, or none of those asked for."""
    uncounted: Sequence[float] = ()
    """Probability of each that was seen and not counted to be one."""
    possible: int = 0
    """Number of tracks that were lost near the gate and may have crossed it."""
    came: Beta = (1.0, 1.0)
    """Share of `possible` that did cross."""
    missed: Beta = (0.0, 1.0)
    """Share of all that nothing sees."""

    def false_pmf(self) -> Array:
        """(F + 1,) probabilities of how many of the counted ones are false."""
        return poisson_binomial(self.false)

    def added_pmf(self) -> Array:
        """(A + 1,) probabilities of how many there were beside the counted ones."""
        lost = betabinom.pmf(np.arange(self.possible + 1), self.possible, *self.came) if self.possible else np.ones(1)
        return _sum_pmf([poisson_binomial(self.uncounted), lost, missed_pmf(len(self.false), self.missed)])


def poisson_binomial(probabilities: Sequence[float]) -> Array:
    """(N + 1,) probabilities that 0 to N of N independent events happen, which have probabilities (N,)."""
    out = np.ones(1)
    for p in probabilities:
        out = np.convolve(out, [1 - p, p])
    return out


def missed_pmf(counted: int, missed: Beta) -> Array:
    """(M + 1,) probabilities of the number that nothing saw, beside a number that was counted.

    A beta negative binomial distribution: failures before `counted` + 1 successes, each event being seen with a
    probability of Beta(b, a). The 1 stands for a true number of which nothing else is known.
    """
    if missed[0] == 0:
        return np.ones(1)
    seen, unseen, successes = missed[1], missed[0], counted + 1.0
    size = 64
    while True:
        k = np.arange(size, dtype=np.float64)
        log = gammaln(successes + k) - gammaln(k + 1) - gammaln(successes)
        pmf = np.exp(log + betaln(seen + successes, unseen + k) - betaln(seen, unseen))
        if pmf.sum() >= DISTRIBUTION_LIMITS.mass or size >= DISTRIBUTION_LIMITS.largest_count:
            pmf[-1] += max(0.0, 1 - pmf.sum())
            return np.asarray(pmf)
        size *= 2


@dataclass(frozen=True)
class CountDistribution:
    """A count, and how many of it may be false and missing."""

    count: int
    errors: Sequence[CountErrors]
    """What may be wrong, by groups of road users that share one miss rate."""
    shifts: Sequence[int] = field(default_factory=tuple)
    """Differences of the count under equally probable other cameras, where the camera's error moves the gate."""

    def interval(self) -> CountInterval:
        """The 90% interval of the true number; it holds the count."""
        false, added = self._pmfs()
        return CountInterval(max(0, self.count - _quantile(false)), self.count + _quantile(added))

    def number_pmf(self) -> tuple[int, Array]:
        """The least true number with a probability, and (N,) the probabilities from there on."""
        false, added = self._pmfs()
        return self.count - len(false) + 1, np.convolve(false[::-1], added)

    def _pmfs(self) -> tuple[Array, Array]:
        shifts = np.asarray(self.shifts or (0,), dtype=np.int64)
        fewer, more = (np.bincount(np.maximum(0, sign * shifts)) / len(shifts) for sign in (-1, 1))
        false = _sum_pmf([fewer, *(one.false_pmf() for one in self.errors)])
        return false, _sum_pmf([more, *(one.added_pmf() for one in self.errors)])


def count_interval(probabilities: Sequence[float], missed: Beta) -> CountInterval:
    """The interval around a count of events that are real with these probabilities.

    Args:
        probabilities: (N,) of the N that were counted.
        missed: Share of all that nothing sees.
    """
    return CountDistribution(
        len(probabilities), [CountErrors([1 - p for p in probabilities], missed=missed)]
    ).interval()


def hull(intervals: Iterable[CountInterval]) -> CountInterval:
    """The smallest interval around several."""
    rows = list(intervals)
    return CountInterval(min(one.low for one in rows), max(one.high for one in rows))


def _sum_pmf(pmfs: Iterable[Array]) -> Array:
    """Probabilities of a sum of independent numbers."""
    return reduce(np.convolve, pmfs, np.ones(1))


def _quantile(pmf: Array) -> int:
    """The least number up to which there is at least `_SIDE_LEVEL` of the probability."""
    return int(np.searchsorted(np.cumsum(pmf), _SIDE_LEVEL - 1e-12))
