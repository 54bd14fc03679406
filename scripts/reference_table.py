"""The tables of docs/results.md, from the metrics that scripts/reference_run.py brings back.

python scripts/reference_table.py runs/reference/eval
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from skope.files import read_json

PUBLISHED = Path(__file__).parents[1] / "skope" / "eval" / "report" / "published_results.json"
SPLITS = ("easy", "medium", "hard", "extra")
IOU = "0.6"
BY = ("distance", "height", "occlusion", "truncation", "unoccluded_within_40_m", "weather", "vehicle_type", "model")

Metrics = Mapping[str, Any]


def overall(found: Mapping[str, Metrics]) -> str:
    """A line for each split and IoU, the published figures beside."""
    published = read_json(PUBLISHED)["splits"]
    names = ("split", "IoU", "PCK@0.1 %", "box precision", "box recall", "keypoint precision", "keypoint recall")
    lines = ["| " + " | ".join((*names, "published: PCK, box P, box R")) + " |", "|---" * (len(names) + 1) + "|"]
    for split, metrics in found.items():
        for iou, row in metrics["iou"].items():
            limits = metrics["intervals"]["iou"][iou]
            cells = [split, iou, f"{_percent(row['pck'])} ({_interval(limits['pck'], _percent)})"]
            cells += [_share(row["box_precision"]["pooled"])]
            recall = _interval(limits["box_recall"]["pooled"], _share)
            cells += [f"{_share(row['box_recall']['pooled'])} ({recall})"]
            cells += [_share(row[name]["pooled"]) for name in ("keypoint_precision", "keypoint_recall")]
            theirs = published.get(split, {}).get(iou)
            cells += [f"{100 * theirs[0]:.1f}, {theirs[1]:.3f}, {theirs[2]:.3f}" if theirs else "-"]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def divided(found: Mapping[str, Metrics]) -> str:
    """Box recall and PCK (%) by what is known of the vehicles."""
    lines = ["| | | " + " | ".join(found) + " |", "|---" * (len(found) + 2) + "|"]
    for key in BY:
        bins = dict.fromkeys(name for metrics in found.values() for name in metrics["by"].get(key, {}))
        for name in bins:
            cells = [_cell(metrics["by"].get(key, {}).get(name, {}).get(IOU)) for metrics in found.values()]
            lines.append(f"| {key.replace('_', ' ')} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _interval(limits: Sequence[float] | None, text: Callable[[float], str]) -> str:
    """Both limits of an interval; a single block of evidence has none."""
    return "-" if limits is None else "..".join(map(text, limits))


def _cell(row: Mapping[str, Any] | None) -> str:
    if not row or not row["ground_truth"]:
        return "-"
    return _share(row["box_recall"]) + (f", {_percent(row['pck'])}" if row["pck"] is not None else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with a folder for each split")
    options = parser.parse_args()
    found = {
        split: read_json(path)["splits"][split]
        for split in SPLITS
        if (path := options.folder / split / "metrics.json").is_file()
    }
    print(overall(found), divided(found), sep="\n\n")


if __name__ == "__main__":
    main()
