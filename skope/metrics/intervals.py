"""95% confidence intervals of metrics, from their variation between the recordings or sites of a split.

Frames half a second apart show the same vehicles in nearly the same positions. All frames of a recording share its
weather, light and camera. Frames are therefore not independent evidence; blocks of frames are.

A block is a site if a split has at least three sites, else a recording, else ten seconds of a single recording. The
standard error of a metric is that of the jackknife, which leaves out one block at a time. The confidence interval uses
Student's t with one degree of freedom less than there are blocks (MacKinnon, Nielsen and Webb, 2023, on few clusters).
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
    """Length of a block of a single recording, seconds."""
    enough_sites: int = 3
    """Minimum number of sites for blocks to be sites."""
    level: float = 0.95
    """Nominal coverage of an interval."""


INTERVAL_RULES: Final = IntervalRules()


Interval = tuple[float, float] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks:
    """Groups of images of a split that count as independent."""

    unit: str
    """Kind of the blocks: "site", "recording", "10 s" or "image"."""
    number: Integers
    """(N,) block of each image, from 0."""
    sites: int | None
    """Number of sites of the split; None if the file does not name them."""

    @property
    def count(self) -> int:
        """Number of blocks."""
        return int(self.number.max(initial=-1)) + 1

    def to_dict(self) -> dict[str, Any]:
        """Return the description of the blocks for `metrics.json`."""
        return {"unit": self.unit, "blocks": self.count, "sites": self.sites, "level": INTERVAL_RULES.level}


def blocks_of(images: Sequence[Image]) -> Blocks:
    """Return the blocks of a split.

    Blocks are sites if there are at least three, else recordings if there are several, else 10 s each of a single
    recording, else single images.
    """
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
    """Return (B,) values of each metric with one of the B blocks left out.

    A value is NaN if the denominator of the block, or of the rest, is 0.
    """
    out = {}
    for name, columns in values.items():
        tops, bottoms = (np.bincount(blocks.number, weights=column, minlength=blocks.count) for column in columns)
        rest = np.where(bottoms > 0, bottoms.sum() - bottoms, 0.0)
        out[name] = np.divide(tops.sum() - tops, rest, out=np.full(len(rest), np.nan), where=rest > 1e-9)
    return out


def jackknife_error(without: Array) -> tuple[float, int]:
    """Return the jackknife standard error of a metric, and its degrees of freedom.

    The squared error is Tukey's: (n - 1) / n times the sum of squared deviations from the mean.

    Args:
        without: (B,) values of the metric with one block left out; NaN for a block without data.
    """
    values = without[~np.isnan(without)]
    count = len(values)
    spread = float(((values - values.mean()) ** 2).sum()) if count else 0.0
    return math.sqrt(max(count - 1, 0) / max(count, 1) * spread), count - 1


def share_interval(value: float | None, without: Array) -> Interval:
    """Return the confidence interval of a share, computed in log odds.

    Args:
        value: The share; None if not available.
        without: (B,) values of the share with one block left out.

    Returns:
        Low and high. None with fewer than two blocks with data, and for a share of exactly 0 or 1, for which the data
        give no bound.
    """
    error, freedom = jackknife_error(without)
    if value is None or freedom < 1 or not 0 < value < 1:
        return None
    reach = t_quantile(freedom) * error / (value * (1 - value))
    odds = math.log(value / (1 - value)) + np.array([-reach, reach])
    low, high = 1 / (1 + np.exp(-np.clip(odds, -500, 500)))
    return float(low), float(high)


def t_quantile(freedom: int) -> float:
    """Return the bound of |t| with probability `INTERVAL_RULES.level`, for `freedom` degrees of freedom."""
    from scipy.special import stdtrit  # imported here because only intervals need it

    return float(stdtrit(freedom, (1 + INTERVAL_RULES.level) / 2))


def intervals(values: Quotients, blocks: Blocks) -> dict[str, Any]:
    """Return 95% confidence intervals of metrics, from the jackknife over blocks.

    Args:
        values: Metric -> (N,) numerators and (N,) denominators of the images, as from `outcome_counts.quotients`.
        blocks: The blocks of the images.

    Returns:
        [low, high] of each metric, or None without a confidence interval, in the layout of `metrics.json`.
    """
    without = left_out(values, blocks)
    found = {name: share_interval(_whole(columns), without[name]) for name, columns in values.items()}
    return nested({name: None if pair is None else list(pair) for name, pair in found.items()})


def difference(a: Quotients, b: Quotients, blocks: Blocks, name: Name) -> Interval:
    """Return the 95% confidence interval of the difference b - a of a metric, with the same block left out of both.

    Args:
        a: Numerators and denominators of the first detector's metrics.
        b: Numerators and denominators of the second detector's metrics, over the same images.
        blocks: The blocks of the images.
        name: The metric.

    Returns:
        Low and high; None if a value or a second block is missing.
    """
    ours, theirs = _whole(a[name]), _whole(b[name])
    gaps = left_out({name: b[name]}, blocks)[name] - left_out({name: a[name]}, blocks)[name]
    error, freedom = jackknife_error(gaps)
    if ours is None or theirs is None or freedom < 1:
        return None
    gap, reach = theirs - ours, t_quantile(freedom) * error
    return gap - reach, gap + reach


def _whole(columns: tuple[Array, Array]) -> float | None:
    """Return a metric over all images, from its numerators and denominators; None if the denominator is 0."""
    return ratio(*(float(column.sum()) for column in columns))
