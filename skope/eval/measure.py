"""Everything that is measured of one split: its entry in `metrics.json`, and the counts that a comparison needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skope.eval import confidence, failures, metrics, tally
from skope.eval.breakdown import Fleet, breakdown
from skope.eval.coco_ap import NO_PRECISION, average_precision
from skope.eval.intervals import Blocks, blocks_of, intervals
from skope.eval.match import Matches
from skope.eval.tally import Judged, Options, Tally
from skope.schema import AnnotationFile, Result


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
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
) -> Measured:
    """Match once, then measure. AP is None unless the results have `all_scores`, down to where a detector stops."""
    matches = metrics.match_split(file, results, options)
    judged = {t: tally.judge(matches, t, options) for t in options.iou}
    tallies = {t: tally.tally(matches, t, options) for t in options.iou}
    blocks = blocks_of(file.images)
    entry = {
        **metrics.summary(matches, options),
        "coco": average_precision(file, results, options) if all_scores else dict(NO_PRECISION),
        "by": breakdown(file.images, matches, options, fleet),
        "localisation": {f"{t:g}": metrics.localisation(judged[t]) for t in options.iou},
        "failures": {f"{t:g}": failures.counts(matches, judged[t], options) for t in options.iou},
        "confidence": confidence.confidence(matches, judged[options.loosest], options),
        "intervals": {
            **blocks.to_dict(),
            "iou": {f"{t:g}": intervals(tally.quotients(tallies[t]), blocks) for t in options.iou},
        },
    }
    return Measured(
        file=file, results=results, matches=matches, judged=judged, tallies=tallies, blocks=blocks, entry=entry
    )


def to_tallies(measured: Measured) -> dict[str, Any]:
    """A split's entry in `tallies.json`: counts of each image at each IoU threshold, and the images' blocks."""
    return {
        "image_ids": [image.id for image in measured.file.images],
        "unit": measured.blocks.unit,
        "sites": measured.blocks.sites,
        "blocks": measured.blocks.number.tolist(),
        "iou": {f"{t:g}": counts.to_dict() for t, counts in measured.tallies.items()},
    }


def from_tallies(entry: Mapping[str, Any]) -> tuple[Blocks, dict[str, Tally]]:
    """The blocks and, by threshold, the counts of a split's entry in `tallies.json`."""
    blocks = Blocks(unit=entry["unit"], sites=entry["sites"], number=np.array(entry["blocks"], dtype=np.int64))
    columns = {t: {name: np.array(c, dtype=np.int64) for name, c in of.items()} for t, of in entry["iou"].items()}
    return blocks, {t: Tally(**named) for t, named in columns.items()}
