"""Compare evaluations, with confidence intervals of their differences.

Two detectors on the same images face the same difficulties. Their difference therefore varies far less than the metric
of either. The jackknife leaves the same block out of both evaluations.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from skope.errors import UserError, one_of
from skope.eval.report.table import evidence, ratio_text
from skope.files.json_files import read_json
from skope.metrics import pck_precision_recall
from skope.metrics.intervals import Blocks, difference
from skope.metrics.keypoint_outcomes import PROTOCOL_NAMES
from skope.metrics.outcome_counts import FIGURE_NAMES, ImageCounts, Name, quotients, ratio
from skope.metrics.split_scores import from_tallies
from skope.terminal.console import text_table

T = TypeVar("T")

TALLIES_FILE: Final = "tallies.json"
METRICS_FILE: Final = "metrics.json"
# Evaluations that differ in one of these options are not comparable. Score thresholds may differ, because each detector
# has its own scale of scores.
SAME_OPTIONS: Final = ("alpha", "labelled", "boxes", "points")
_CATEGORY_FIGURES: Final = {"precision": "precision", "recall": "recall", "ap": "box AP", "ap50": "box AP50"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """Results of an evaluation, read from its folder."""

    name: str
    metrics: Mapping[str, Any]
    tallies: Mapping[str, Mapping[str, Any]]
    """Split -> its entry in `tallies.json`."""


def read_run(folder: Path) -> Run:
    """Read the output folder of `skope eval`.

    Raises UserError if a file is missing or has a different version.
    """
    documents = {}
    for name in (METRICS_FILE, TALLIES_FILE):
        path = folder / name
        documents[name] = document = read_json(path)
        if (
            not isinstance(document, dict)
            or document.get("version") != pck_precision_recall.METRIC_RULES.version
            or "splits" not in document
        ):
            raise UserError(
                f"{path}: not a file of `skope eval` of version {pck_precision_recall.METRIC_RULES.version}; "
                f"evaluate again"
            )
    return Run(name=str(folder), metrics=documents[METRICS_FILE], tallies=documents[TALLIES_FILE]["splits"])


def compare(folders: Sequence[Path]) -> dict[str, Any]:
    """Return figures of each run and their differences from the first, per common split and threshold.

    Raises:
        UserError: The runs differ in options, images or ground truth.
    """
    if len(folders) < 2:
        raise UserError("compare: expected the folders of two or more evaluations")
    runs = [read_run(folder) for folder in folders]
    first = runs[0]
    for run in runs[1:]:
        for name in SAME_OPTIONS:
            ours, theirs = first.metrics.get(name), run.metrics.get(name)
            if ours != theirs:
                raise UserError(f"{first.name} and {run.name} differ in {name}: {ours} and {theirs}")
    splits = [name for name in first.tallies if all(name in run.tallies for run in runs)]
    if not splits:
        raise UserError(f"{' and '.join(run.name for run in runs)} have no split in common")
    return {
        "version": pck_precision_recall.METRIC_RULES.version,
        "runs": [run.name for run in runs],
        "alpha": first.metrics["alpha"],
        "score_thresholds": [run.metrics["score_threshold"] for run in runs],
        "splits": {name: _split(runs, name) for name in splits},
    }


def _split(runs: Sequence[Run], split: str) -> dict[str, Any]:
    blocks, columns = zip(*(_aligned(runs[0], run, split) for run in runs), strict=True)
    thresholds = [t for t in columns[0] if all(t in of for of in columns)]
    categories = [run.metrics["splits"][split].get("categories", {}) for run in runs]
    return {
        **blocks[0].to_dict(),
        "images": len(blocks[0].number),
        "iou": {t: _differences(blocks[0], [of[t] for of in columns]) for t in thresholds},
        "coco": [run.metrics["splits"][split]["coco"] for run in runs],
        "recall_at_precision": [run.metrics["splits"][split]["recall_at_precision"] for run in runs],
        **({"categories": categories} if any(categories) else {}),
    }


def _aligned(first: Run, run: Run, split: str) -> tuple[Blocks, dict[str, ImageCounts]]:
    """Return blocks and counts of a run, with its images in the order of the first run."""
    path = Path(run.name) / TALLIES_FILE
    reference = _valid(Path(first.name) / TALLIES_FILE, lambda: list(first.tallies[split]["image_ids"]))
    image_ids = _valid(path, lambda: list(run.tallies[split]["image_ids"]))
    if sorted(image_ids) != sorted(reference):
        raise UserError(f"{path}: split {split}: not the images of {first.name}")
    blocks, columns = _valid(path, lambda: from_tallies(run.tallies[split]))
    index_of = {image: i for i, image in enumerate(image_ids)}
    order = np.array([index_of[image] for image in reference], dtype=np.int64)
    aligned = {
        t: ImageCounts(**{name: column[order] for name, column in vars(counts).items()})
        for t, counts in columns.items()
    }
    _, expected = from_tallies(first.tallies[split])
    for t, counts in aligned.items():
        for name in ("ground_truth", "labelled_all"):
            if t in expected and (getattr(counts, name) != getattr(expected[t], name)).any():
                raise UserError(f"{path}: split {split}: not the ground truth of {first.name}")
    return Blocks(unit=blocks.unit, sites=blocks.sites, number=blocks.number[order]), aligned


def _valid(path: Path, make: Callable[[], T]) -> T:
    try:
        return make()
    except (KeyError, TypeError, ValueError, IndexError, AttributeError):
        raise UserError(f"{path}: damaged; evaluate again") from None


def _differences(blocks: Blocks, runs: Sequence[ImageCounts]) -> list[dict[str, Any]]:
    """Return for each figure the values of the runs, and the differences from the first run with intervals."""
    columns = [quotients(counts) for counts in runs]
    return [
        {
            "figure": name[0],
            "protocol": name[1],
            "values": [_value(run_columns, name) for run_columns in columns],
            "differences": [
                {
                    "value": _minus(_value(run_columns, name), _value(columns[0], name)),
                    "interval": difference(columns[0], run_columns, blocks, name),
                }
                for run_columns in columns[1:]
            ],
        }
        for name in FIGURE_NAMES
    ]


def _value(columns: Mapping[Name, tuple[Any, Any]], name: Name) -> float | None:
    top, bottom = columns[name]
    return ratio(top.sum(), bottom.sum())


def _minus(b: float | None, a: float | None) -> float | None:
    return None if a is None or b is None else b - a


# ------------------------------------------------------------------------------------------------------------ printing


def render_comparison(document: Mapping[str, Any], protocol: str) -> str:
    """Return a table per split: rows by threshold and figure, a column per run, and differences from the first."""
    one_of("--protocol", protocol, PROTOCOL_NAMES)
    letters = [chr(ord("A") + i) if i < 26 else str(i) for i in range(len(document["runs"]))]
    scores = document["score_thresholds"]
    lines = [f"{a}  {name}  (score > {s:g})" for a, name, s in zip(letters, document["runs"], scores, strict=True)]
    lines += [f"Protocol: {protocol}. Differences with paired 95% intervals; * if they exclude 0."]
    gaps = [f"{letter} - {letters[0]}" for letter in letters[1:]]
    for name, split in document["splits"].items():
        lines += ["", f"{name}: {split['images']} images, {evidence(split)}"]
        rows = [
            [t, row["figure"].replace("_", " "), *map(ratio_text, row["values"]), *map(_change, row["differences"])]
            for t, figures in split["iou"].items()
            for row in figures
            if row["protocol"] in (None, protocol)
        ]
        for ap in split["coco"][0]:
            values = [ratio_text(of[ap]) for of in split["coco"]]
            rows.append(["", ap.replace("_", " "), *values, *[""] * len(gaps)])
        for precision in split["recall_at_precision"][0]:
            values = [ratio_text(of.get(precision)) for of in split["recall_at_precision"]]
            rows.append(["", f"box recall at precision {precision}", *values, *[""] * len(gaps)])
        rows += [[*row, *[""] * len(gaps)] for row in _category_rows(split.get("categories", []))]
        table = text_table(["IoU", "figure", *letters, *gaps], rows, "ll" + "r" * len(letters) + "l" * len(gaps))
        lines += [f"  {line}" for line in table]
    return "\n".join(lines)


def _category_rows(categories: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return rows for road users other than vehicles, over all sizes; "-" for a run without the category."""
    names = dict.fromkeys(name for of in categories for name in of)
    return [
        ["", f"{name} {words}", *(ratio_text(of[name]["all"][key] if name in of else None) for of in categories)]
        for name in names
        for key, words in _CATEGORY_FIGURES.items()
    ]


def _change(gap: Mapping[str, Any]) -> str:
    if gap["value"] is None:
        return "-"
    if gap["interval"] is None:
        return f"{gap['value']:+.3f}"
    low, high = gap["interval"]
    return f"{gap['value']:+.3f} {low:+.3f}..{high:+.3f}{'*' if low > 0 or high < 0 else ''}"
