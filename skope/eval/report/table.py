"""Tables of figures for the terminal: as in the paper, splits side by side, a row per IoU threshold; and others."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, Final

from skope.errors import one_of
from skope.metrics.intervals import INTERVAL_RULES
from skope.metrics.keypoint_outcomes import PROTOCOL_NAMES
from skope.metrics.pck_precision_recall import METRIC_RULES
from skope.metrics.road_users import AP50_IOU
from skope.terminal.console import text_table

PROTOCOL_MEANINGS: Final = {
    "pooled": "pooled (over the whole split; recommended for decisions)",
    "paper": "paper (mean of per-image figures, as published; `pooled` is recommended for decisions)",
}
FIGURE_COLUMNS: Final = ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")
SHORT_TITLES: Final = ("box Pr", "box Re", "keypoint Pr", "keypoint Re")
_MARGIN_CHARS: Final = 5
_BLOCK_CHARS: Final = len(" 100.00  0.000 0.000  0.000 0.000")
_BLOCK_GAP: Final = " | "

# Groups that the paper does not separate.
_ROW_NAMES: Final = {
    ("unoccluded_within_40_m", "yes"): "unoccluded within 40 m",
    ("parked", "parked"): "parked vehicles",
    ("parked", "driving"): "driving vehicles",
    ("model", "unseen"): "models unseen in training",
    ("model", "seen"): "models seen in training",
    ("keypoint_kind", "substituted"): "substituted keypoints",
    ("keypoint_kind", "own"): "keypoints of the body's own",
}


@cache
def published() -> dict[str, Any]:
    """Return the table of the paper: splits -> name -> IoU threshold -> figures in the order of `columns`."""
    text = resources.files("skope.eval.report").joinpath("published_results.json").read_text(encoding="utf-8")
    table: dict[str, Any] = json.loads(text)
    return table


def render_table(
    metrics: Mapping[str, Any], protocol: str, width: int, *, beside: Mapping[str, Any] | None = None
) -> str:
    """Return the splits of a `metrics.json` as text.

    Args:
        metrics: The content of `metrics.json`.
        protocol: Protocol of the figures, one of `PROTOCOL_NAMES`.
        width: Maximum line length of the table, characters. A single split may need more.
        beside: A published table (see `published`), to print below ours; None: none.

    Returns:
        The lines of the table, and the tables below it.

    Raises:
        UserError: The protocol is unknown.
    """
    one_of("--protocol", protocol, PROTOCOL_NAMES)
    splits = list(metrics["splits"].items())
    side_by_side = max(1, (width - _MARGIN_CHARS + len(_BLOCK_GAP)) // (_BLOCK_CHARS + len(_BLOCK_GAP)))
    lines = [f"Protocol: {PROTOCOL_MEANINGS[protocol]}"]
    for first in range(0, len(splits), side_by_side):
        lines += ["", *_group(dict(splits[first : first + side_by_side]), metrics, protocol, beside)]
    if beside:
        lines += ["", f"Rows `paper`: {beside['source']}"]
    lines += ["", *_counts(dict(splits), metrics["score_threshold"])]
    lines += _categories(dict(splits), metrics["score_threshold"])
    lines += _localisation(dict(splits)) + _apart(dict(splits)) + _intervals(dict(splits), protocol)
    return "\n".join(lines)


def _group(
    splits: Mapping[str, Any], metrics: Mapping[str, Any], protocol: str, beside: Mapping[str, Any] | None
) -> list[str]:
    thresholds = list(next(iter(splits.values()))["iou"])
    alpha = f"@{metrics['alpha']:g}"
    rows = [
        (" " * _MARGIN_CHARS, [f"{name:^{_BLOCK_CHARS}}" for name in splits]),
        (" " * _MARGIN_CHARS, [f"{'PCK':>7}  {'Box':^11}  {'Keypoint':^11}"] * len(splits)),
        ("  IoU", [f"{alpha + ' %':>7}  {'Pr':>5} {'Re':>5}  {'Pr':>5} {'Re':>5}"] * len(splits)),
    ]
    for t in thresholds:
        ours = [_cells(row_of(split["iou"][t], protocol)) for split in splits.values()]
        rows.append((f"{t:>{_MARGIN_CHARS}}", ours))
        if beside:
            theirs = [_cells(published_row(beside, name, t)) for name in splits]
            rows.append((f"{'paper':>{_MARGIN_CHARS}}", theirs))
    return [(margin + _BLOCK_GAP.join(cells)).rstrip() for margin, cells in rows]


def row_of(figures: Mapping[str, Any], protocol: str) -> list[Any]:
    """Return PCK and the four figures of `FIGURE_COLUMNS` at one threshold, or their intervals."""
    return [figures["pck"], *(figures[name][protocol] for name in FIGURE_COLUMNS)]


def published_row(table: Mapping[str, Any], split: str, threshold: str) -> list[float | None]:
    """Return the figures of a published table.

    Args:
        table: A published table (see `published`).
        split: Name of the split.
        threshold: IoU threshold, as written in the table.

    Returns:
        Figures in the order of `row_of`; all None if the table has no such split or threshold.
    """
    row = table["splits"].get(split, {}).get(threshold)
    return list(row) if row else [None] * (1 + len(FIGURE_COLUMNS))


def _cells(values: Sequence[float | None]) -> str:
    pck, *precisions_recalls = values
    box_pr, box_re, point_pr, point_re = (f"{ratio_text(value):>5}" for value in precisions_recalls)
    return f"{ratio_text(pck, percent=True):>7}  {box_pr} {box_re}  {point_pr} {point_re}"


def _counts(splits: Mapping[str, Any], score: float) -> list[str]:
    head = ["split", "images", "vehicles", "ignored", f"detections > {score:g}"]
    rows = [
        [name, *(split[key] for key in ("images", "ground_truth", "ignored", "detections"))]
        + [ratio_text(value) for value in (*split["coco"].values(), *split["recall_at_precision"].values())]
        for name, split in splits.items()
    ]
    recalls = [f"recall at precision {p:g}" for p in METRIC_RULES.at_precision]
    return text_table([*head, "box AP", "box AP50", "keypoint AP", "keypoint AP50", *recalls], rows)


AREA_WORDS: Final = {"all": "all", "small": "under 32x32 px", "medium": "to 96x96 px", "large": "larger"}
"""COCO's ranges of areas in words."""


def road_user_rows(entry: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield category, size and figures of a split's other road users, without empty sizes."""
    for name, by_size in entry.get("categories", {}).items():
        for size, figures in by_size.items():
            if size == "all" or figures["ground_truth"] or figures["detections"]:
                yield name, size, figures


def _categories(splits: Mapping[str, Any], score: float) -> list[str]:
    """Return lines on other road users by category and size; empty if the ground truth labels none."""
    rows = [
        [split, name, AREA_WORDS[size], figures["ground_truth"], figures["ignored"], figures["detections"]]
        + [ratio_text(figures[key]) for key in ("precision", "recall", "ap", "ap50")]
        for split, entry in splits.items()
        for name, size, figures in road_user_rows(entry)
    ]
    if not rows:
        return []
    head = ["split", "category", "size", "labelled", "ignored", f"detections > {score:g}"]
    return ["", *text_table([*head, f"precision at IoU {AP50_IOU:g}", "recall", "box AP", "box AP50"], rows, "lll")]


def _localisation(splits: Mapping[str, Any]) -> list[str]:
    """Return lines on the accuracy of keypoints of matched vehicles at the lowest threshold; empty without labels."""
    found = {name: split["localisation"] for name, split in splits.items() if split.get("localisation")}
    rows = [
        [
            *(name, t, figures["labelled"], ratio_text(figures["pck_0.05"], percent=True)),
            *(ratio_text(figures["pck_area"]), ratio_text(figures["median_error"])),
        ]
        for name, by in found.items()
        for t, figures in list(by.items())[-1:]
    ]
    if not any(row[2] for row in rows):
        return []
    return ["", *text_table(["split", "IoU", "keypoints", "PCK@0.05 %", "area under PCK", "median error / L"], rows)]


def _apart(splits: Mapping[str, Any]) -> list[str]:
    """Return lines on the groups of `_ROW_NAMES`, if both a group and its counterpart occur."""
    rows = []
    for name, split in splits.items():
        for (quantity, part), words in _ROW_NAMES.items():
            parts = split["by"].get(quantity, {})
            if part in parts and len(parts) > 1:
                t, figures = list(parts[part].items())[-1]
                recall = ratio_text(figures["box_recall"]) if "box_recall" in figures else ""
                pck = ratio_text(figures["pck"], percent=True)
                rows.append([name, words, t, figures.get("ground_truth", ""), recall, figures["labelled"], pck])
    if not rows:
        return []
    return ["", *text_table(["split", "of these", "IoU", "vehicles", "recall", "keypoints", "PCK %"], rows, "ll")]


def _intervals(splits: Mapping[str, Any], protocol: str) -> list[str]:
    """Return lines with 95% intervals at the lowest threshold, and with their basis."""
    lines = []
    for name, split in splits.items():
        intervals = split.get("intervals")
        if not intervals:
            continue
        t, figures = list(intervals["iou"].items())[-1]
        lines.append(f"  {name}: {evidence(intervals)}")
        if figures["pck"] is not None or figures["box_recall"][protocol] is not None:
            pck, *precisions_recalls = row_of(figures, protocol)
            shown = [f"PCK {span(pck, percent=True)}"]
            shown += [f"{title} {span(value)}" for title, value in zip(SHORT_TITLES, precisions_recalls, strict=True)]
            lines.append(f"    IoU {t}: {', '.join(shown)}")
    return ["", "95% intervals (all thresholds are in metrics.json)", *lines] if lines else []


def evidence(intervals: Mapping[str, Any]) -> str:
    """Return text on the blocks of a split's confidence intervals, and on what the intervals do not cover."""
    blocks, sites, unit = intervals["blocks"], intervals["sites"], intervals["unit"]
    words = f"blocks of {unit}" if unit.endswith(" s") else f"{unit}s"
    words = f"{blocks} {words}" if blocks > 1 else f"none, as there are fewer than two {words}"
    if unit == "image":
        return words + "; the intervals are too narrow if the images include neighbouring frames"
    if unit.endswith(" s"):
        return words + " of one recording: not valid for other weather, light or sites"
    if sites == 1:
        return words + " of one site: not valid for other sites"
    if sites is not None and sites < INTERVAL_RULES.enough_sites:
        return words + f" of {sites} sites: too few to be valid for other sites"
    return words


def span(interval: Sequence[float] | None, *, percent: bool = False) -> str:
    """Return a confidence interval as low-high; "-" for None."""
    if interval is None:
        return "-"
    low, high = (ratio_text(value, percent=percent) for value in interval)
    return f"{low}-{high}"


def ratio_text(value: float | None, *, percent: bool = False) -> str:
    """Return a ratio as digits, or "-" if it is None."""
    if value is None:
        return "-"
    return f"{100 * value:.2f}" if percent else f"{value:.3f}"
