"""The paper's table on a terminal: splits side by side, a row per IoU threshold."""

from collections.abc import Mapping
from typing import Any, Final

from skope.errors import one_of
from skope.eval.metrics import PROTOCOLS

_MEANING: Final = {
    "pooled": "pooled (over the whole split; the one to decide by)",
    "paper": "paper (mean of each image's own figures, as published; `pooled` is the one to decide by)",
}
_COLUMNS: Final = ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")
_MARGIN: Final = 5
_BLOCK: Final = len(" 100.00  0.000 0.000  0.000 0.000")
_GAP: Final = " | "


def render(metrics: Mapping[str, Any], protocol: str, width: int) -> str:
    """The splits of a `metrics.json` as lines of at most `width` characters (but never less than one split needs)."""
    one_of("--protocol", protocol, PROTOCOLS)
    splits = list(metrics["splits"].items())
    side_by_side = max(1, (width - _MARGIN + len(_GAP)) // (_BLOCK + len(_GAP)))
    lines = [f"Protocol: {_MEANING[protocol]}"]
    for first in range(0, len(splits), side_by_side):
        lines += ["", *_group(dict(splits[first : first + side_by_side]), metrics, protocol)]
    lines += ["", *_counts(dict(splits), metrics["score_threshold"])]
    return "\n".join(lines)


def _group(splits: Mapping[str, Any], metrics: Mapping[str, Any], protocol: str) -> list[str]:
    thresholds = list(next(iter(splits.values()))["iou"])
    alpha = f"@{metrics['alpha']:g}"
    rows = [
        (" " * _MARGIN, [f"{name:^{_BLOCK}}" for name in splits]),
        (" " * _MARGIN, [f"{'PCK':>7}  {'Box':^11}  {'Keypoint':^11}"] * len(splits)),
        ("  IoU", [f"{alpha + ' %':>7}  {'Pr':>5} {'Re':>5}  {'Pr':>5} {'Re':>5}"] * len(splits)),
        *((f"{t:>{_MARGIN}}", [_cells(split["iou"][t], protocol) for split in splits.values()]) for t in thresholds),
    ]
    return [(margin + _GAP.join(cells)).rstrip() for margin, cells in rows]


def _cells(figures: Mapping[str, Any], protocol: str) -> str:
    pck = number(figures["pck"], 7, percent=True)
    box_pr, box_re, point_pr, point_re = (number(figures[name][protocol], 5) for name in _COLUMNS)
    return f"{pck}  {box_pr} {box_re}  {point_pr} {point_re}"


def _counts(splits: Mapping[str, Any], score: float) -> list[str]:
    found = f"detections > {score:g}"
    names = max(map(len, (*splits, "split")))
    averages = ("box AP", "box AP50", "keypoint AP", "keypoint AP50")
    lines = ["  ".join([f"{'split':{names}}", "images", "vehicles", "ignored", found, *averages])]
    for name, split in splits.items():
        counts = (
            *(f"{split['images']:>6}", f"{split['ground_truth']:>8}", f"{split['ignored']:>7}"),
            f"{split['detections']:>{len(found)}}",
        )
        aps = (number(value, len(title)) for value, title in zip(split["coco"].values(), averages, strict=True))
        lines.append("  ".join([f"{name:{names}}", *counts, *aps]))
    return lines


def number(value: float | None, width: int, *, percent: bool = False) -> str:
    """A ratio right-aligned in `width` characters, "-" where there was nothing to divide by."""
    if value is None:
        return f"{'-':>{width}}"
    return f"{100 * value:>{width}.2f}" if percent else f"{value:>{width}.3f}"
