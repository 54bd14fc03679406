"""Shares that gates miss and count wrongly, learnt from hand counts.

Each share of a gate and direction is a place on the normal scale: the share of all gates that have less is the normal
distribution's there. Places of one site have a part in common, those of one gate another one, those of one direction a
third, and the rest is of one time alone: a tree, in which what is seen at one place is passed on to the others exactly
(Pearl, "Reverend Bayes on inference engines", 1982).

How much is in common follows the 13 generated clips that the distributions were fitted on (docs/traffic.md): what is
missed in the halves of a clip, held against each other, says how much of the likeness counting itself hides.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from typing import Final

import numpy as np
from scipy.special import gammaln, ndtr
from scipy.stats import binom

from skope.traffic.count_uncertainty import Group, poisson_binomial
from skope.traffic.event_probability import SeenAlike
from skope.traffic.gate_shares import LearntShares, chances_at, share_at
from skope.types import Array

SignedGate = tuple[str, int]
"""A gate's name and a direction."""
_SITE: Final = 0.1
"""Correlation of a share's places at two gates of a site. In the clips there was none; this is left for what a camera
has in common."""
_GATE: Final = 0.5
"""Of the two directions of a gate. In a few pairs of the clips 0.3 of vehicles, 0.8 of others."""
_SIDE: Final = 0.95
"""Of two times at one gate and direction. Between day, night and rain in the clips over 0.9 of vehicles, 0.75 of
others."""
_STEP: Final = 1 / 3
_PLACES: Final = np.arange(-4.0, 4.0 + _STEP / 2, _STEP)
"""Grid of the shares, standard deviations."""
_LEVELS: Final = ndtr(_PLACES)
_WHOLE: Final = (len(_PLACES),) * 3
"""A weight for each place of the share that is missed, that came, and that is one."""
_VALUES: Final = 4000
_ENDS: Final = 0.2
_SLIPS: Final = 0.02
"""Variance of a hand count's error at the ends of its time, and its relative error besides: chosen, not measured."""
_FAR: Final = 6.0
"""Standard deviations of it that are looked at."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CountEvidence:
    """A number that was counted by hand at a gate, and what was seen there meanwhile."""

    side: SignedGate
    groups: Mapping[int, Group]
    """Crossings of those who were counted that were seen, by which of the kinds that are seen alike they are."""
    number: int


def hand_sigma(number: float) -> float:
    """Standard deviation of a count by hand of so many."""
    return float(np.hypot(np.sqrt(_ENDS), _SLIPS * number))


def learnt_shares(
    evidence: Sequence[CountEvidence], kinds: Mapping[SignedGate, Sequence[SeenAlike]], doubted: frozenset[int]
) -> dict[SignedGate, tuple[SeenAlike, ...]]:
    """The kinds as they are seen at each gate and direction, with what hand counts tell of them.

    Args:
        evidence: The hand counts.
        kinds: Who is missed alike at each gate and direction that is asked for: as many kinds at all.
        doubted: Which of the hand counts contradict what was seen: where they are, shares are as probably those with
            them as without, and elsewhere they say nothing.
    """
    sound = [k for k in range(len(evidence)) if k not in doubted]
    number = max(map(len, kinds.values()), default=0)
    of_sound = _messages([evidence[k] for k in sound], number)
    of_all = _messages(evidence, number) if doubted else of_sound
    out = {}
    for side, own in kinds.items():
        here = any(evidence[k].side[0] == side[0] for k in doubted)
        out[side] = tuple(
            _with_learnt(
                kind,
                [_belief(said[k], side) for said in ((of_sound, of_all) if here else (of_sound,))],
                looked=any(one.side == side for one in evidence),
            )
            if any(k in one.groups for one in evidence)
            else kind
            for k, kind in enumerate(own)
        )
    return out


def _with_learnt(kind: SeenAlike, beliefs: Sequence[Array], *, looked: bool) -> SeenAlike:
    """A kind with values drawn evenly from several beliefs; where somebody has looked, nothing is refused."""
    rng = np.random.default_rng(0)
    each = _VALUES // len(beliefs)
    cells = [
        np.searchsorted(np.cumsum(one.ravel()) / one.sum(), (np.arange(each) + rng.random()) / each) for one in beliefs
    ]
    nodes = np.stack(np.unravel_index(np.minimum(np.concatenate(cells), _PLACES.size**3 - 1), _WHOLE))
    missed, came, real = ndtr(_PLACES[nodes] + _STEP * (rng.random(nodes.shape) - 0.5))
    return replace(
        kind,
        learnt=LearntShares(share_at(kind.missed, missed), share_at(kind.came, came), real),
        refused=kind.refused and not looked,
        too_small=kind.too_small and not looked,
    )


# --------------------------------------------------------------------------------------------------- along the tree

Message = tuple[SignedGate, Array]
"""Message of one hand count: how probable it is by where the shares are at its gate and direction, whenever."""


@cache
def _kernel(correlation: float) -> Array:
    """(P, P) how probable each place is below a place of the tree."""
    away = (_PLACES[None] - correlation * _PLACES[:, None]) ** 2 / (1 - correlation**2)
    weights = np.exp(-away / 2)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


_TO_GATE: Final = float(np.sqrt(_SITE / _GATE))
_TO_SIDE: Final = float(np.sqrt(_GATE / _SIDE))
_TO_TIME: Final = float(np.sqrt(_SIDE))


def _up(correlation: float, message: Array) -> Array:
    """Take a message of a place up to the place above it."""
    for axis in range(3):
        message = np.moveaxis(np.tensordot(_kernel(correlation), message, (1, axis)), 0, axis)
    return np.asarray(message / message.max())


def _down(correlation: float, belief: Array) -> Array:
    """Take probabilities of the place above down to a place."""
    for axis in range(3):
        belief = np.moveaxis(np.tensordot(_kernel(correlation).T, belief, (1, axis)), 0, axis)
    return np.asarray(belief / belief.sum())


def _product(messages: Iterable[Array]) -> Array:
    out = np.ones(_WHOLE)
    for one in messages:
        out = out * one
    return out


def _at_side(messages: Iterable[Message]) -> Array:
    return _product(one for _, one in messages)


def _at_gate(messages: Iterable[Message]) -> Array:
    sides = groupby(sorted(messages, key=lambda one: one[0]), key=lambda one: one[0])
    return _product(_up(_TO_SIDE, _at_side(own)) for _, own in sides)


def _belief(messages: Sequence[Message], side: SignedGate) -> Array:
    """Probabilities of shares at a gate and direction, at another time than the hand counts'."""
    plain = np.exp(-(_PLACES**2) / 2)
    belief = np.multiply.outer(np.multiply.outer(plain, plain), plain)
    others = sorted((one for one in messages if one[0][0] != side[0]), key=lambda one: one[0])
    for _, own in groupby(others, key=lambda one: one[0][0]):
        belief = belief * _up(_TO_GATE, _at_gate(own))
    here = [one for one in messages if one[0][0] == side[0]]
    belief = _down(_TO_GATE, belief) * _at_gate([one for one in here if one[0] != side])
    belief = _down(_TO_SIDE, belief) * _at_side([one for one in here if one[0] == side])
    return _down(_TO_TIME, belief)


# --------------------------------------------------------------------------------------------- what one count says


def _messages(evidence: Sequence[CountEvidence], number: int) -> list[list[Message]]:
    """For each of a number of kinds, what the hand counts say of it.

    Of several kinds that were counted together each is told by what is believed of the others, twice over.
    """
    said: list[dict[int, Array]] = [{} for _ in range(number)]
    for sweep in range(2):
        for row, one in enumerate(evidence):
            if sweep and len(one.groups) == 1:
                continue
            for k in one.groups:
                others = np.ones(1)
                for other, group in one.groups.items():
                    if other != k:
                        messages = [(evidence[r].side, told) for r, told in said[other].items() if r != row]
                        belief = _belief(messages, one.side)
                        others = np.convolve(others, _numbers(group, belief, one.number))
                said[k][row] = _up(_TO_TIME, _said(one.groups[k], one.number, others))
    return [[(evidence[row].side, told) for row, told in of_kind.items()] for of_kind in said]


def _said(group: Group, number: int, others: Array) -> Array:
    """Probability of a hand count by a group's shares, where others were counted besides in these numbers (M,)."""
    most = _most(number)
    total = np.arange(most + len(others))
    sigma = np.array([hand_sigma(one) for one in total.tolist()])
    right = ndtr((number - total + 0.5) / sigma) - ndtr((number - total - 0.5) / sigma)
    wanted = np.array([others @ right[n : n + len(others)] for n in range(most + 1)])
    happened = _happened(group)
    out = np.stack([happened @ (every @ wanted) for every in _besides(group, happened.shape[2], most)])
    return np.maximum(out, _LEAST * out.max()) if out.max() > 0 else np.ones(_WHOLE)


_LEAST: Final = 1e-12
"""No place of the shares is less probable than this share of the most probable one: it could not come back."""


def _numbers(group: Group, belief: Array, number: int) -> Array:
    """(N,) how probable numbers of a kind are by what is believed of its shares, as far as they matter for `number`."""
    happened = _happened(group)
    weights = np.einsum("mcr,crk->mk", belief, happened)
    every = _besides(group, happened.shape[2], _most(number))
    return np.asarray(sum(row @ one for row, one in zip(weights, every, strict=True)))


def _most(number: int) -> int:
    """The largest number that a count by hand may stand for."""
    return number + int(np.ceil(_FAR * hand_sigma(number))) + 1


def _happened(group: Group) -> Array:
    """(P, P, K) how probable numbers of those who were seen, and did cross, are by the shares that came and are one."""
    chances = chances_at(group.real, np.asarray(group.probabilities), _LEVELS)
    seen = [poisson_binomial(row) for row in chances.tolist()]
    came = binom.pmf(np.arange(group.possible + 1), group.possible, share_at(group.came, _LEVELS)[:, None])
    return np.stack([[np.convolve(one, row) for row in seen] for one in came])


def _besides(group: Group, seen: int, most: int) -> Iterator[Array]:
    """For each place of the share that is missed, (`seen`, `most` + 1) how probable numbers are of whom so many were
    seen: negative binomial numbers."""
    happened, total = np.arange(seen)[:, None], np.arange(most + 1)
    missed = np.maximum(total - happened, 0)
    ways = gammaln(total + 1) - gammaln(happened + 1) - gammaln(missed + 1)
    for share in np.clip(share_at(group.missed, _LEVELS), _NEVER, 1 - _NEVER):
        chance = np.exp(ways + (happened + 1) * np.log1p(-share) + missed * np.log(share))
        yield np.where(total >= happened, chance, 0.0)


_NEVER: Final = 1e-9
"""Shares are so far from 0 and 1 at least, where logarithms are taken of them."""
