"""Everything that is measured of one split: its entry in `metrics.json`, and the counts that a comparison needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skope.metrics import counts, failures, figures, reliability
from skope.metrics.breakdown import Fleet, breakdown
from skope.metrics.coco_ap import NO_PRECISION, average_precision
from skope.metrics.counts import Judged, Options, Tally
from skope.metrics.intervals import Blocks, blocks_of, intervals
from skope.metrics.match import Matches
from skope.schema import AnnotationFile, Result


@dataclass(frozen=True, kw_only=True, eq=False)
class SplitScores:
    """A split, what a detector found in it, and what that is worth."""

    file: AnnotationFile
    results: Sequence[Result]
    matches: Matches
    judged: Mapping[float, Judged]
    """By IoU threshold."""
    tallies: Mapping[float, Tally]
    """By IoU threshold."""
    blocks: Blocks
    entry: dict[str, Any]
    """Of `metrics.json`."""


def measure(
    file: AnnotationFile, results: Sequence[Result], options: Options, fleet: Fleet, *, all_scores: bool = True
) -> SplitScores:
    """Match once, then measure. AP is None unless the results have `all_scores`, down to where a detector stops."""
    matches = figures.match_split(file, results, options)
    judged = {t: counts.judge(matches, t, options) for t in options.iou}
    tallies = {t: counts.tally(matches, t, options) for t in options.iou}
    blocks = blocks_of(file.images)
    entry = {
        **figures.summary(matches, options),
        "coco": average_precision(file, results, options) if all_scores else dict(NO_PRECISION),
        "by": breakdown(file.images, matches, options, fleet),
        "localisation": {f"{t:g}": figures.localisation(judged[t]) for t in options.iou},
        "failures": {f"{t:g}": failures.counts(matches, judged[t], options) for t in options.iou},
        "confidence": reliability.confidence(matches, judged[options.loosest], options),
        "intervals": {
            **blocks.to_dict(),
            "iou": {f"{t:g}": intervals(counts.quotients(tallies[t]), blocks) for t in options.iou},
        },
    }
    return SplitScores(
        file=file, results=results, matches=matches, judged=judged, tallies=tallies, blocks=blocks, entry=entry
    )


def to_tallies(measured: SplitScores) -> dict[str, Any]:
    """A split's entry in `tallies.json`: counts of each image at each IoU threshold, and the images' blocks."""
    return {
        "image_ids": [image.id for image in measured.file.images],
        "unit": measured.blocks.unit,
        "sites": measured.blocks.sites,
        "blocks": measured.blocks.number.tolist(),
        "iou": {f"{t:g}": rows.to_dict() for t, rows in measured.tallies.items()},
    }


def from_tallies(entry: Mapping[str, Any]) -> tuple[Blocks, dict[str, Tally]]:
    """The blocks and, by threshold, the counts of a split's entry in `tallies.json`."""
    blocks = Blocks(unit=entry["unit"], sites=entry["sites"], number=np.array(entry["blocks"], dtype=np.int64))
    columns = {t: {name: np.array(c, dtype=np.int64) for name, c in of.items()} for t, of in entry["iou"].items()}
    return blocks, {t: Tally(**named) for t, named in columns.items()}
