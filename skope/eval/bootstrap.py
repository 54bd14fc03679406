"""Intervals for every figure, by drawing whole blocks of images again.

Frames half a second apart show the same vehicles in nearly the same places: a bootstrap that drew single frames would
give intervals far too narrow. Contiguous blocks of 10 s inside a recording are drawn instead (Künsch 1989), and whole
sites where a split has at least five, which is what it takes to say something about other sites.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.eval.tally import Floats, Integers, Name, Quotients, nested
from skope.schema import Image

BLOCK_S: Final = 10.0
ENOUGH_SITES: Final = 5
RESAMPLES: Final = 1000
LEVEL: Final = 0.95
SEED: Final = 0

Interval = tuple[float, float] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks:
    """How the images of a split are drawn."""

    unit: str
    """What is drawn: "site", "10 s" or "image"."""
    number: Integers
    """(N,) block of each image, counted from 0."""
    sites: int | None
    """Sites of the split, None where the file does not name them."""

    @property
    def count(self) -> int:
        return int(self.number.max(initial=-1)) + 1

    def to_dict(self) -> dict[str, Any]:
        """What is drawn, as `metrics.json` says it."""
        return {"unit": self.unit, "blocks": self.count, "sites": self.sites, "resamples": RESAMPLES, "level": LEVEL}


def blocks_of(images: Sequence[Image]) -> Blocks:
    """Sites where there are five or more, else 10 s blocks of recordings, else (times unknown) single images."""
    known = [image.site for image in images if image.site is not None]
    sites = len(set(known)) if images and len(known) == len(images) else None
    keys: list[Any]
    if sites is not None and sites >= ENOUGH_SITES:
        unit, keys = "site", known
    elif images and all(image.time_s is not None for image in images):
        unit = f"{BLOCK_S:g} s"
        keys = [(str(i.site), str(i.recording), int((i.time_s or 0.0) // BLOCK_S)) for i in images]
    else:
        unit, keys = "image", list(range(len(images)))
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return Blocks(unit=unit, number=np.array([number[key] for key in keys], dtype=np.int64), sites=sites)


def draw(blocks: int) -> Floats:
    """(RESAMPLES, blocks) how often each block is drawn, the same at every call."""
    rng = np.random.default_rng(SEED)
    return rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=RESAMPLES).astype(np.float64)


def resampled(values: Quotients, blocks: Blocks) -> dict[Name, Floats]:
    """(RESAMPLES,) each figure in each resample, NaN where there is nothing to divide by; nothing of a single block."""
    if blocks.count < 2:
        return {}
    times = draw(blocks.count)
    out = {}
    for name, columns in values.items():
        top, bottom = (times @ np.bincount(blocks.number, weights=c, minlength=blocks.count) for c in columns)
        out[name] = np.divide(top, bottom, out=np.full(len(times), np.nan), where=bottom > 0)
    return out


def interval(values: NDArray[np.float64]) -> Interval:
    """The central 95% of resampled figures, or None where none could be divided."""
    known = values[~np.isnan(values)]
    if not known.size:
        return None
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def intervals(values: Quotients, blocks: Blocks) -> dict[str, Any]:
    """Each figure's [low, high], or None, laid out as the figures are in `metrics.json`."""
    drawn = resampled(values, blocks)
    return nested({name: _listed(interval(drawn[name])) if drawn else None for name in values})


def difference(a: Mapping[Name, Floats], b: Mapping[Name, Floats], name: Name) -> Interval:
    """Interval of b - a where both were resampled with the same draws of the same blocks."""
    return interval(b[name] - a[name]) if a and b else None


def _listed(values: Interval) -> list[float] | None:
    return None if values is None else list(values)
