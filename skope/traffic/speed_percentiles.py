"""v15, v50, v85: percentiles of speeds that were measured with errors, and within what they are right.

Measuring spreads speeds, which takes v85 up and v15 down. Where measured speeds vary by S^2 and their errors by
sigma^2, true ones vary by S^2 - sigma^2: values are drawn towards their median by the square root of the ratio. The
interval is that of order statistics (Conover, Practical Nonparametric Statistics: it holds for any distribution),
widened by how uncertain the ratio is, and by the error that the camera gives all speeds alike, which no number of
vehicles averages away.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import bdtr

from skope.traffic.normal_distribution import COUNT_INTERVAL_LEVEL, INTERVAL_SIGMAS

PERCENTILES: Final[Mapping[str, float]] = {"v15": 0.15, "v50": 0.50, "v85": 0.85}
_LEAST_RATIO: Final = 0.5
"""Errors hide how speeds vary if true ones would vary by less than this share of the measured variance."""


_SHAPE: Final = 0.15
"""Standard deviation of what drawing leaves wrong where speeds are not normally distributed, as a share of the spread
that is taken out; from simulations with skewed speeds."""


@dataclass(frozen=True, kw_only=True)
class Percentile:
    """A percentile of speeds, m/s."""

    value: float | None
    """None: it cannot be told, `refused` says why."""
    low: float | None
    high: float | None
    """Between `low` and `high` is the percentile of all who drive so, with 90%."""
    refused: str = ""


def speed_percentiles(
    speeds: Sequence[float], sigmas: Sequence[float], common_sigma: float | None
) -> dict[str, Percentile]:
    """The percentiles of `PERCENTILES`, by their names.

    Args:
        speeds: As measured, m/s.
        sigmas: Standard deviation of each for a known camera, m/s.
        common_sigma: Relative standard deviation that the camera gives all speeds alike; None: not known, and not in
            the intervals.
    """
    values = np.sort(np.asarray(speeds, dtype=np.float64))
    n = len(values)
    if n == 0:
        return {name: _refused("no vehicle") for name in PERCENTILES}
    shared = 0.0 if common_sigma is None else common_sigma
    noise, spread = float(np.square(np.asarray(sigmas)).mean()), float(values.var(ddof=1)) if n > 1 else 0.0
    ratio = 1.0 if noise == 0 else 1 - noise / spread if spread > 0 else -1.0
    middle = float(np.median(values))
    out = {}
    for name, share in PERCENTILES.items():
        ranks = order_ranks(n, share)
        if ranks is None:
            least = math.ceil(math.log((1 - COUNT_INTERVAL_LEVEL) / 2) / math.log(max(share, 1 - share)))
            out[name] = _refused(f"{n} vehicles: an interval needs {least}")
        elif ratio < _LEAST_RATIO and share != 0.5:
            out[name] = _refused("speeds vary hardly more than they are uncertain")
        else:
            drawn = math.sqrt(max(0.0, ratio)) if share != 0.5 else 1.0
            value, low, high = (
                middle + drawn * (float(x) - middle) for x in (np.quantile(values, share), *values[list(ranks)])
            )
            doubt = _ratio_sigma(ratio, n) * abs(float(np.quantile(values, share)) - middle)
            shape = _SHAPE * min(1.0, 1 - ratio) * math.sqrt(spread)
            widen = INTERVAL_SIGMAS * math.hypot(doubt, shape, shared * value)
            out[name] = Percentile(
                value=value,
                low=max(0.0, value - math.hypot(value - low, widen)),
                high=value + math.hypot(high - value, widen),
            )
    return out


def _refused(why: str) -> Percentile:
    return Percentile(value=None, low=None, high=None, refused=why)


def _ratio_sigma(ratio: float, n: int) -> float:
    """Standard deviation of the square root of the ratio, as far as the spread of n normal values is uncertain."""
    return (1 - ratio) / math.sqrt(2 * n * ratio) if 0 < ratio < 1 else 0.0


def order_ranks(n: int, share: float) -> tuple[int, int] | None:
    """Indices of two of n sorted values between which a quantile lies with `COUNT_INTERVAL_LEVEL`.

    Each end errs with half of the rest at most. None where n is too small for that.
    """
    tail = (1 - COUNT_INTERVAL_LEVEL) / 2
    ranks = np.arange(n)
    below = bdtr(ranks, n, share)  # so many values or fewer lie below the quantile
    # The k-th value (from 0) is above the quantile where k or fewer values lie below it.
    lows = np.flatnonzero(below <= tail)
    highs = np.flatnonzero(below >= 1 - tail)
    highs = highs[highs < n]
    if not len(lows) or not len(highs):
        return None
    return int(lows[-1]), int(highs[0])
