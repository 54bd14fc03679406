"""Compute the confidence interval of a true number from a count, with its false and its missing crossings.

If F counted crossings are false and A are missing, the true number is count - F + A. F is a sum of trials with
individual probabilities (a Poisson binomial number; Hong, "On computing the distribution function for the Poisson
binomial distribution", 2013). A has three parts: crossings that were detected and not counted, tracks that were lost
near the gate, and road users that were never detected. If a share m of all road users is never detected, the
number of undetected road users is negative binomial, given the number counted. m has a Beta distribution.

The confidence interval is from the count less the 95% quantile of F to the count plus the 95% quantile of A. The
probability that the true number lies below it is at most 5%, and so is the probability that it lies above. The
confidence interval always includes the count.
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
"""Parameters a and b of the Beta distribution of a share; (0, 1): the share is 0."""
_SIDE_LEVEL: Final = 1 - (1 - INTERVAL_LEVEL) / 2
"""Level of each of the two quantiles."""


@dataclass(frozen=True)
class DistributionLimits:
    """Truncation of count distributions."""

    mass: float = 0.9999
    """Share of a distribution's probability that is computed. The rest is added to the last number."""
    largest_count: int = 2**20
    """Largest number that is computed."""


DISTRIBUTION_LIMITS: Final = DistributionLimits()


@dataclass(frozen=True)
class CountInterval:
    """Inclusive bounds of a true number at `INTERVAL_LEVEL` (90%)."""

    low: int
    high: int


def in_words(interval: CountInterval | None) -> str:
    """Return the bounds as text."""
    return "not known" if interval is None else f"{interval.low} to {interval.high}"


def in_cells(interval: CountInterval | None) -> tuple[int | None, int | None]:
    """Return the table cells low and high; both None without a confidence interval."""
    return (None, None) if interval is None else (interval.low, interval.high)


def in_json(interval: CountInterval | None) -> dict[str, int]:
    """Return the JSON entries low and high; empty without a confidence interval."""
    return {} if interval is None else {"low": interval.low, "high": interval.high}


@dataclass(frozen=True)
class CountErrors:
    """Possible errors of a count of road users that share one miss rate."""

    false: Sequence[float] = ()
    """Probability for each counted crossing that it is false or of another class or lane."""
    uncounted: Sequence[float] = ()
    """Probability for each detected but uncounted crossing that it is real."""
    possible: int = 0
    """Number of tracks that were lost near the gate and may have crossed it."""
    came: Beta = (1.0, 1.0)
    """Share of the tracks in `possible` that did cross the gate."""
    missed: Beta = (0.0, 1.0)
    """Share of all road users that is never detected."""

    def false_pmf(self) -> Array:
        """Return (F + 1,) probabilities of the number of false crossings."""
        return poisson_binomial(self.false)

    def added_pmf(self) -> Array:
        """Return (A + 1,) probabilities of the number of missing crossings."""
        lost = betabinom.pmf(np.arange(self.possible + 1), self.possible, *self.came) if self.possible else np.ones(1)
        return _sum_pmf([poisson_binomial(self.uncounted), lost, missed_pmf(len(self.false), self.missed)])


def poisson_binomial(probabilities: Sequence[float]) -> Array:
    """Return (N + 1,) probabilities that 0, 1, ... N of N independent events happen, from their probabilities (N,)."""
    out = np.ones(1)
    for p in probabilities:
        out = np.convolve(out, [1 - p, p])
    return out


def missed_pmf(counted: int, missed: Beta) -> Array:
    """Return (M + 1,) probabilities of the number of undetected road users, given the number that was counted.

    The distribution is beta negative binomial: failures before `counted` + 1 successes, with a detection probability
    of Beta(b, a). The 1 represents a flat prior of the true number.
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
    """Count with the distributions of its false and missing crossings."""

    count: int
    errors: Sequence[CountErrors]
    """Possible errors, by groups of road users that share one miss rate."""
    shifts: Sequence[int] = field(default_factory=tuple)
    """Changes of the count under camera parameters sampled from the calibration covariance. Empty if the camera's error
    does not move the gate."""

    def interval(self) -> CountInterval:
        """Return the 90% confidence interval of the true number, which always includes the count."""
        false, added = self._pmfs()
        return CountInterval(max(0, self.count - _quantile(false)), self.count + _quantile(added))

    def number_pmf(self) -> tuple[int, Array]:
        """Return the smallest possible true number, and (N,) probabilities of this number and the following ones."""
        false, added = self._pmfs()
        return self.count - len(false) + 1, np.convolve(false[::-1], added)

    def _pmfs(self) -> tuple[Array, Array]:
        shifts = np.asarray(self.shifts or (0,), dtype=np.int64)
        fewer, more = (np.bincount(np.maximum(0, sign * shifts)) / len(shifts) for sign in (-1, 1))
        false = _sum_pmf([fewer, *(group_errors.false_pmf() for group_errors in self.errors)])
        return false, _sum_pmf([more, *(group_errors.added_pmf() for group_errors in self.errors)])


def count_interval(probabilities: Sequence[float], missed: Beta) -> CountInterval:
    """Return the 90% confidence interval of the true number of events.

    Args:
        probabilities: (N,) probability for each counted event that it is real.
        missed: Share of all events that is never detected.
    """
    return CountDistribution(
        len(probabilities), [CountErrors([1 - p for p in probabilities], missed=missed)]
    ).interval()


def hull(intervals: Iterable[CountInterval]) -> CountInterval:
    """Return the smallest interval that contains all intervals."""
    rows = list(intervals)
    return CountInterval(min(interval.low for interval in rows), max(interval.high for interval in rows))


def _sum_pmf(pmfs: Iterable[Array]) -> Array:
    """Return the probabilities of a sum of independent numbers."""
    return reduce(np.convolve, pmfs, np.ones(1))


def _quantile(pmf: Array) -> int:
    """Return the smallest number with a cumulative probability of at least `_SIDE_LEVEL`."""
    return int(np.searchsorted(np.cumsum(pmf), _SIDE_LEVEL - 1e-12))
