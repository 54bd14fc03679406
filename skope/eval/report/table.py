"""The paper's table on a terminal: splits side by side, a row per IoU threshold, and what belongs beside it."""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, Final

from skope.errors import one_of
from skope.metrics.counts import PROTOCOLS
from skope.metrics.intervals import ENOUGH_SITES

_MEANING: Final = {
    "pooled": "pooled (over the whole split; the one to decide by)",
    "paper": "paper (mean of each image's own figures, as published; `pooled` is the one to decide by)",
}
COLUMNS: Final = ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")
_SHORT: Final = ("box Pr", "box Re", "keypoint Pr", "keypoint Re")
_MARGIN: Final = 5
_BLOCK: Final = len(" 100.00  0.000 0.000  0.000 0.000")
_GAP: Final = " | "

# Parts that the paper does not tell apart and a reader should.
_APART: Final = {
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
    """The table of the paper: splits -> name -> IoU threshold -> figures in the order of `columns`."""
    text = resources.files("skope.eval.report").joinpath("published_results.json").read_text(encoding="utf-8")
    table: dict[str, Any] = json.loads(text)
    return table


def render(metrics: Mapping[str, Any], protocol: str, width: int, *, beside: Mapping[str, Any] | None = None) -> str:
    """The splits of a `metrics.json` as lines of at most `width` characters (but never less than one split needs).

    `beside` is a published table (see `published`), whose rows stand below ours.
    """
    one_of("--protocol", protocol, PROTOCOLS)
    splits = list(metrics["splits"].items())
    side_by_side = max(1, (width - _MARGIN + len(_GAP)) // (_BLOCK + len(_GAP)))
    lines = [f"Protocol: {_MEANING[protocol]}"]
    for first in range(0, len(splits), side_by_side):
        lines += ["", *_group(dict(splits[first : first + side_by_side]), metrics, protocol, beside)]
    if beside:
        lines += ["", f"Rows `paper`: {beside['source']}"]
    lines += ["", *_counts(dict(splits), metrics["score_threshold"])]
    lines += _localisation(dict(splits)) + _apart(dict(splits)) + _intervals(dict(splits), protocol)
    return "\n".join(lines)


def _group(
    splits: Mapping[str, Any], metrics: Mapping[str, Any], protocol: str, beside: Mapping[str, Any] | None
) -> list[str]:
    thresholds = list(next(iter(splits.values()))["iou"])
    alpha = f"@{metrics['alpha']:g}"
    rows = [
        (" " * _MARGIN, [f"{name:^{_BLOCK}}" for name in splits]),
        (" " * _MARGIN, [f"{'PCK':>7}  {'Box':^11}  {'Keypoint':^11}"] * len(splits)),
        ("  IoU", [f"{alpha + ' %':>7}  {'Pr':>5} {'Re':>5}  {'Pr':>5} {'Re':>5}"] * len(splits)),
    ]
    for t in thresholds:
        ours = [_cells(row_of(split["iou"][t], protocol)) for split in splits.values()]
        rows.append((f"{t:>{_MARGIN}}", ours))
        if beside:
            theirs = [_cells(published_row(beside, name, t)) for name in splits]
            rows.append((f"{'paper':>{_MARGIN}}", theirs))
    return [(margin + _GAP.join(cells)).rstrip() for margin, cells in rows]


def row_of(figures: Mapping[str, Any], protocol: str) -> list[Any]:
    """PCK and the four figures of `COLUMNS` at one threshold, or their intervals."""
    return [figures["pck"], *(figures[name][protocol] for name in COLUMNS)]


def published_row(table: Mapping[str, Any], split: str, threshold: str) -> list[float | None]:
    """A published table's figures in the order of `row_of`; None where it has no such split or threshold."""
    row = table["splits"].get(split, {}).get(threshold)
    return list(row) if row else [None] * (1 + len(COLUMNS))


def _cells(values: Sequence[float | None]) -> str:
    pck, *others = values
    box_pr, box_re, point_pr, point_re = (number(value, 5) for value in others)
    return f"{number(pck, 7, percent=True)}  {box_pr} {box_re}  {point_pr} {point_re}"


def _names(splits: Mapping[str, Any]) -> int:
    return max(map(len, (*splits, "split")))


def _counts(splits: Mapping[str, Any], score: float) -> list[str]:
    found = f"detections > {score:g}"
    names = _names(splits)
    averages = ("box AP", "box AP50", "keypoint AP", "keypoint AP50")
    lines = ["  ".join([f"{'split':{names}}", "images", "vehicles", "ignored", found, *averages])]
    for name, split in splits.items():
        counts = (
            f"{split['images']:>6}",
            f"{split['ground_truth']:>8}",
            f"{split['ignored']:>7}",
            f"{split['detections']:>{len(found)}}",
        )
        aps = (number(value, len(title)) for value, title in zip(split["coco"].values(), averages, strict=True))
        lines.append("  ".join([f"{name:{names}}", *counts, *aps]))
    return lines


def _localisation(splits: Mapping[str, Any]) -> list[str]:
    """How exact the keypoints of the vehicles found are, at the lowest threshold; nothing where nothing is labelled."""
    found = {name: split["localisation"] for name, split in splits.items() if split.get("localisation")}
    rows = {name: list(by.items())[-1] for name, by in found.items()}
    if not any(figures["labelled"] for _, figures in rows.values()):
        return []
    names = _names(splits)
    titles = ("keypoints", "PCK@0.05 %", "area under PCK", "median error / L")
    lines = ["", "  ".join([f"{'split':{names}}", "IoU", *titles])]
    for name, (t, figures) in rows.items():
        cells = (
            f"{figures['labelled']:>{len(titles[0])}}",
            number(figures["pck_0.05"], len(titles[1]), percent=True),
            number(figures["pck_area"], len(titles[2])),
            number(figures["median_error"], len(titles[3])),
        )
        lines.append("  ".join([f"{name:{names}}", f"{t:>3}", *cells]))
    return lines


def _apart(splits: Mapping[str, Any]) -> list[str]:
    """The parts that are told apart, where both they and their counterpart occur."""
    rows = []
    for name, split in splits.items():
        for (quantity, part), words in _APART.items():
            parts = split["by"].get(quantity, {})
            if part in parts and len(parts) > 1:
                rows.append((name, words, list(parts[part].items())[-1]))
    if not rows:
        return []
    names, wide = _names(splits), max(len(words) for _, words, _ in rows)
    lines = ["", f"{'split':{names}}  {'of these':{wide}}  IoU  vehicles  recall  keypoints  PCK %"]
    for name, words, (t, figures) in rows:
        vehicles = figures.get("ground_truth", "")
        recall = number(figures["box_recall"], 6) if "box_recall" in figures else " " * 6
        lines.append(
            f"{name:{names}}  {words:{wide}}  {t:>3}  {vehicles:>8}  {recall}  {figures['labelled']:>9}  "
            f"{number(figures['pck'], 5, percent=True)}"
        )
    return lines


def _intervals(splits: Mapping[str, Any], protocol: str) -> list[str]:
    """95% intervals at the lowest threshold, and what they speak for."""
    lines = []
    for name, split in splits.items():
        intervals = split.get("intervals")
        if not intervals:
            continue
        t, figures = list(intervals["iou"].items())[-1]
        lines.append(f"  {name}: {evidence(intervals)}")
        if figures["pck"] is not None or figures["box_recall"][protocol] is not None:
            pck, *others = row_of(figures, protocol)
            shown = [f"PCK {span(pck, percent=True)}"]
            shown += [f"{title} {span(value)}" for title, value in zip(_SHORT, others, strict=True)]
            lines.append(f"    IoU {t}: {', '.join(shown)}")
    return ["", "95% intervals (all thresholds are in metrics.json)", *lines] if lines else []


def evidence(intervals: Mapping[str, Any]) -> str:
    """What a split's intervals come from, and what they say nothing about, in words."""
    blocks, sites, unit = intervals["blocks"], intervals["sites"], intervals["unit"]
    words = f"blocks of {unit}" if unit.endswith(" s") else f"{unit}s"
    words = f"{blocks} {words}" if blocks > 1 else f"none, fewer than two {words}"
    if unit == "image":
        return words + "; neighbouring frames, if there are any, make these too narrow"
    if unit.endswith(" s"):
        return words + " of one recording: this infers to no other weather, light or site"
    if sites == 1:
        return words + " of one site: this infers to no other site"
    if sites is not None and sites < ENOUGH_SITES:
        return words + f" of {sites} sites: too few to infer to others"
    return words


def span(interval: Sequence[float] | None, *, percent: bool = False) -> str:
    """An interval as low-high, "-" where there is none."""
    if interval is None:
        return "-"
    low, high = (number(value, 0, percent=percent) for value in interval)
    return f"{low}-{high}"


def number(value: float | None, width: int, *, percent: bool = False) -> str:
    """A ratio right-aligned in `width` characters, "-" where there was nothing to divide by."""
    if value is None:
        return f"{'-':>{width}}"
    return f"{100 * value:>{width}.2f}" if percent else f"{value:>{width}.3f}"
