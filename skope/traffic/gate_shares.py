"""Shares of one gate, and what they make of crossings seen there: how many are one, and how many more there were.

Gates differ in what is missed and counted wrongly there. Each share is known as a distribution over gates; what a hand
count tells of one gate is a number of equally probable values for it (`LearntShares`).
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import betaincinv, expit, logit, stdtrit

from skope.types import Array

Beta = tuple[float, float]
_ODDS: Final = 0.5
"""By how much the log odds of a gate's crossings are off: sites that the fit had not seen were off by 0.50 and 0.37
(`skope.traffic.event_probability`: 0.86 said, 0.91 true; 0.19 said, 0.14 true)."""
_FREEDOM: Final = 3.0
"""Degrees of freedom of Student's distribution, which they are spread by: a gate may be like no other."""
_SURE: Final = 1e-9
"""Probabilities are so far from 0 and 1 at least, where odds are taken of them."""


def share_at(distribution: Beta, levels: Array) -> Array:
    """The values of a share, known as a Beta distribution, that it is under with these probabilities (S,)."""
    return np.asarray(betaincinv(*distribution, levels))


def chances_at(real: Beta | None, probabilities: Array, levels: Array) -> Array:
    """(S, N) how probable events are at gates where (S,) of all gates have fewer events that are one.

    Args:
        real: The share of events that are one, as a Beta distribution over gates; None: only by how much the odds of
            all events are off is known.
        probabilities: (N,) of the events at a gate of the mean.
        levels: (S,) shares of gates, between 0 and 1.
    """
    if real is not None:
        factors = share_at(real, levels) * (sum(real) / real[0])
        return np.minimum(1.0, np.multiply.outer(factors, probabilities))
    shifts = _ODDS * stdtrit(_FREEDOM, levels)
    return np.asarray(expit(np.add.outer(shifts, logit(np.clip(probabilities, _SURE, 1 - _SURE)))))


@dataclass(frozen=True, eq=False)
class LearntShares:
    """A gate's shares after a hand count: values (S,) that are equally probable, in no order."""

    missed: Array
    """The share of who crosses that nothing sees."""
    came: Array
    """The share of the vanished who did cross."""
    levels: Array
    """The share of gates that have fewer events that are one, which `chances_at` takes."""

    def with_came(self, came: Beta) -> "LearntShares":
        """These shares, where of the vanished as many did cross as a Beta distribution says, whatever was learnt."""
        levels = np.random.default_rng(0).permutation(len(self.came)) + 0.5
        return replace(self, came=share_at(came, levels / len(self.came)))

    def drawn(
        self, real: Beta | None, probabilities: Array, possible: int, repeats: int, rng: np.random.Generator
    ) -> Array:
        """(`repeats` * S,) numbers of who may have crossed.

        Args:
            real: As `chances_at` takes it.
            probabilities: (N,) of the events that were seen.
            possible: How many more may have crossed who were seen.
            repeats: So often each value is drawn from.
            rng: Draws.
        """
        order = rng.permutation(len(self.missed))
        happened = rng.binomial(possible, self.came[order])
        for part in np.array_split(probabilities, len(probabilities) // _DRAWN_AT_ONCE + 1):
            chances = chances_at(real, part, self.levels[order])
            happened = happened + (rng.random(chances.shape) < chances).sum(axis=1)
        seen = np.clip(1 - self.missed[order], _SURE, 1.0)
        every, chance = np.tile(happened, repeats), np.tile(seen, repeats)
        return np.asarray(every + rng.negative_binomial(every + 1, chance), dtype=np.float64)


_DRAWN_AT_ONCE: Final = 250
"""Of so many events draws are made at once, which bounds memory."""
