"""All figures of one split: its entry in `metrics.json`, and the counts for comparisons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skope.metrics import failures, outcome_counts, pck_precision_recall, score_reliability
from skope.metrics.breakdown import FleetInfo, breakdown
from skope.metrics.coco_ap import NO_PRECISION, average_precision
from skope.metrics.intervals import Blocks, blocks_of, intervals
from skope.metrics.keypoint_outcomes import MetricOptions, Outcomes, outcomes_at
from skope.metrics.match import Matches
from skope.metrics.outcome_counts import ImageCounts
from skope.metrics.road_users import category_figures
from skope.schema import VEHICLE_ALONE, AnnotationFile, Result, RoadUserResult


@dataclass(frozen=True, kw_only=True, eq=False)
class SplitScores:
    """Split with the results of a detector and their scores."""

    file: AnnotationFile
    results: Sequence[Result]
    road_users: Sequence[RoadUserResult]
    """Results of the detector for other road users."""
    matches: Matches
    outcomes: Mapping[float, Outcomes]
    """IoU threshold -> outcome of each vehicle."""
    tallies: Mapping[float, ImageCounts]
    """IoU threshold -> counts of each image."""
    blocks: Blocks
    entry: dict[str, Any]
    """The split's entry in `metrics.json`."""


def split_metrics(
    file: AnnotationFile,
    results: Sequence[Result],
    options: MetricOptions,
    fleet: FleetInfo,
    *,
    all_scores: bool = True,
    road_users: Sequence[RoadUserResult] = (),
    known: Sequence[str] = VEHICLE_ALONE,
) -> SplitScores:
    """Match a split once, then compute its whole entry in `metrics.json`.

    Args:
        file: The ground truth of the split.
        results: Results of a detector, each in an image of `file`.
        options: The counting rules and IoU thresholds.
        fleet: Vehicle models from the dataset's card.
        all_scores: Whether `results` include the lowest scores of the detector. Otherwise AP is None.
        road_users: Results of the detector for other road users.
        known: Categories that the detector has learnt. Those that the ground truth labels too have figures.
    """
    matches = pck_precision_recall.match_split(file, results, options)
    outcomes = {t: outcomes_at(matches, t, options) for t in options.iou}
    tallies = {t: outcome_counts.tally(matches, t, options) for t in options.iou}
    blocks = blocks_of(file.images)
    entry = {
        **pck_precision_recall.score_summary(matches, options),
        "coco": average_precision(file, results, options) if all_scores else dict(NO_PRECISION),
        "recall_at_precision": (
            pck_precision_recall.recalls(file, results, options)
            if all_scores
            else dict.fromkeys(f"{p:g}" for p in pck_precision_recall.METRIC_RULES.at_precision)
        ),
        "by": breakdown(file.images, matches, options, fleet),
        "localisation": {f"{t:g}": pck_precision_recall.localisation(outcomes[t]) for t in options.iou},
        "failures": {f"{t:g}": failures.failure_counts(matches, outcomes[t], options) for t in options.iou},
        "confidence": score_reliability.confidence(matches, outcomes[options.loosest], options),
        "intervals": {
            **blocks.to_dict(),
            "iou": {f"{t:g}": intervals(outcome_counts.quotients(tallies[t]), blocks) for t in options.iou},
        },
    }
    categories = category_figures(
        file, road_users, score=options.score, boxes=options.boxes, all_scores=all_scores, known=known
    )
    if categories:
        entry["categories"] = categories
    return SplitScores(
        file=file,
        results=results,
        road_users=road_users,
        matches=matches,
        outcomes=outcomes,
        tallies=tallies,
        blocks=blocks,
        entry=entry,
    )


def to_tallies(measured: SplitScores) -> dict[str, Any]:
    """Return a split's entry in `tallies.json`: counts per image and IoU threshold, and the blocks of the images."""
    return {
        "image_ids": [image.id for image in measured.file.images],
        "unit": measured.blocks.unit,
        "sites": measured.blocks.sites,
        "blocks": measured.blocks.number.tolist(),
        "iou": {f"{t:g}": rows.to_dict() for t, rows in measured.tallies.items()},
    }


def from_tallies(entry: Mapping[str, Any]) -> tuple[Blocks, dict[str, ImageCounts]]:
    """Return the blocks and, by threshold, the counts of a split's entry in `tallies.json`."""
    blocks = Blocks(unit=entry["unit"], sites=entry["sites"], number=np.array(entry["blocks"], dtype=np.int64))
    columns = {t: {name: np.array(c, dtype=np.int64) for name, c in table.items()} for t, table in entry["iou"].items()}
    return blocks, {t: ImageCounts(**named) for t, named in columns.items()}
