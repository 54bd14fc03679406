"""95% intervals for every figure, from how much it differs between the recordings or sites that it was measured on.

Frames half a second apart show the same vehicles in nearly the same places, and all frames of a recording share its
weather, its light and its camera: none of them is evidence of its own. What counts as one piece of evidence is a site
where a split has three or more, else a recording, else ten seconds of the only recording. A figure's standard error is
that of the jackknife that leaves out one of them at a time, and Student's t with one degree of freedom less than there
are pieces makes up for their small number (MacKinnon, Nielsen and Webb, 2023, on few clusters).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skope.metrics.outcome_counts import Name, Quotients, nested, ratio
from skope.schema import Image
from skope.types import Array, Integers


@dataclass(frozen=True)
class IntervalRules:
    """Blocks and level of the intervals."""

    block_s: float = 10.0
    """Length of a block of the only recording, seconds."""
    enough_sites: int = 3
    """Number of sites from which sites are the blocks."""
    level: float = 0.95
    """Nominal coverage of an interval."""


INTERVAL_RULES: Final = IntervalRules()


Interval = tuple[float, float] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks:
    """Groups of images of a split, each one piece of evidence."""

    unit: str
    """Kind of the blocks: "site", "recording", "10 s" or "image"."""
    number: Integers
    """(N,) block of each image, counted from 0."""
    sites: int | None
    """Sites of the split, None where the file does not name them."""

    @property
    def count(self) -> int:
        """Number of blocks."""
        return int(self.number.max(initial=-1)) + 1

    def to_dict(self) -> dict[str, Any]:
        """Basis of the intervals, as `metrics.json` says it."""
        return {"unit": self.unit, "blocks": self.count, "sites": self.sites, "level": INTERVAL_RULES.level}


def blocks_of(images: Sequence[Image]) -> Blocks:
    """The blocks of a split: its sites where there are three or more, else recordings, else 10 s each of the only
    recording, else single images."""
    site_names = [image.site for image in images if image.site is not None]
    sites = len(set(site_names)) if images and len(site_names) == len(images) else None
    recordings = {(image.site, image.recording) for image in images if image.recording is not None}
    keys: list[Any]
    if sites is not None and sites >= INTERVAL_RULES.enough_sites:
        unit, keys = "site", site_names
    elif len(recordings) > 1:
        unit, keys = "recording", [(image.site, image.recording) for image in images]
    elif images and all(image.time_s is not None for image in images):
        unit = f"{INTERVAL_RULES.block_s:g} s"
        keys = [(image.site, int((image.time_s or 0.0) // INTERVAL_RULES.block_s)) for image in images]
    else:
        unit, keys = "image", list(range(len(images)))
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return Blocks(unit=unit, number=np.array([number[key] for key in keys], dtype=np.int64), sites=sites)


def left_out(values: Quotients, blocks: Blocks) -> dict[Name, Array]:
    """(B,) each figure with one of the B blocks left out; NaN if the block, or the rest, has no denominator."""
    out = {}
    for name, columns in values.items():
        tops, bottoms = (np.bincount(blocks.number, weights=column, minlength=blocks.count) for column in columns)
        rest = np.where(bottoms > 0, bottoms.sum() - bottoms, 0.0)
        out[name] = np.divide(tops.sum() - tops, rest, out=np.full(len(rest), np.nan), where=rest > 1e-9)
    return out


def jackknife_error(without: Array) -> tuple[float, int]:
    """A figure's standard error by the jackknife, and the degrees of freedom.

    `without` (B,) are the figure's values without one block each, NaN where a block says nothing of it. The formula is
    Tukey's: (n - 1) / n times the sum of squared deviations from their mean.
    """
    values = without[~np.isnan(without)]
    count = len(values)
    spread = float(((values - values.mean()) ** 2).sum()) if count else 0.0
    return math.sqrt(max(count - 1, 0) / max(count, 1) * spread), count - 1


def share_interval(value: float | None, without: Array) -> Interval:
    """Interval of a share from (B,) its values with one block left out each, worked out in log odds.

    None where fewer than two blocks say something, and for exactly 0 or 1: where nothing was ever wrong, the data do
    not say how seldom it is.
    """
    error, freedom = jackknife_error(without)
    if value is None or freedom < 1 or not 0 < value < 1:
        return None
    reach = t_quantile(freedom) * error / (value * (1 - value))
    odds = math.log(value / (1 - value)) + np.array([-reach, reach])
    low, high = 1 / (1 + np.exp(-np.clip(odds, -500, 500)))
    return float(low), float(high)


def t_quantile(freedom: int) -> float:
    """Bound of |t| with probability `INTERVAL_RULES.level`, for Student's t with `freedom` degrees of freedom."""
    from scipy.special import stdtrit  # only what says intervals waits for it

    return float(stdtrit(freedom, (1 + INTERVAL_RULES.level) / 2))


def intervals(values: Quotients, blocks: Blocks) -> dict[str, Any]:
    """95% intervals of all figures, from the jackknife over blocks.

    Args:
        values: Figure -> (N,) numerators and (N,) denominators of the images, as `counts.quotients` gives them.
        blocks: Which images are one piece of evidence.

    Returns:
        For each figure [low, high], or None where the data tell no interval, laid out as in `metrics.json`.
    """
    without = left_out(values, blocks)
    found = {name: share_interval(_whole(columns), without[name]) for name, columns in values.items()}
    return nested({name: None if pair is None else list(pair) for name, pair in found.items()})


def difference(a: Quotients, b: Quotients, blocks: Blocks, name: Name) -> Interval:
    """95% interval of the difference b - a of a figure, paired: the same block is left out of both.

    Args:
        a: Numerators and denominators of the first detector's figures.
        b: Those of the second detector's figures, over the same images.
        blocks: Which images are one piece of evidence.
        name: The figure.

    Returns:
        Low and high; None where the data tell no interval.
    """
    ours, theirs = _whole(a[name]), _whole(b[name])
    gaps = left_out({name: b[name]}, blocks)[name] - left_out({name: a[name]}, blocks)[name]
    error, freedom = jackknife_error(gaps)
    if ours is None or theirs is None or freedom < 1:
        return None
    gap, reach = theirs - ours, t_quantile(freedom) * error
    return gap - reach, gap + reach


def _whole(columns: tuple[Array, Array]) -> float | None:
    """A figure over all images, from its numerators and denominators; None where there is nothing to divide by."""
    return ratio(*(float(column.sum()) for column in columns))
