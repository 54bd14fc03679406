"""The tables of docs/results.md, from what scripts/reference_run.py brings back.

    python scripts/reference_table.py runs/reference/road33/packed
    python scripts/reference_table.py runs/reference/road33/packed --beside runs/reference/varied/packed --data data

A folder holds one of `skope eval` for each dataset. The second command sets two detectors beside each other: the most
boxes that each finds where nine (or nineteen of twenty) of its detections are right, and from the score on that gives
nine of ten the PCK, and what it finds of small and of large vehicles.
"""

import argparse
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skope.dataset import coco
from skope.files.json_files import read_json
from skope.metrics.keypoint_outcomes import Options, outcomes_at
from skope.metrics.match import Matches, match
from skope.metrics.outcome_counts import ratio
from skope.metrics.pck_precision_recall import METRIC_RULES, ranked, recall_at_precision
from skope.metrics.read_inputs import read_vehicle_results
from skope.schema import AnnotationFile, Result

PUBLISHED = Path(__file__).parents[1] / "skope" / "eval" / "report" / "published_results.json"
IOU = 0.6
OPTIONS = Options(iou=(IOU,))
BANDS_PX = {"12 to 30 px high": (12, 30), "200 px and more": (200, math.inf)}
"""Heights of ground-truth boxes, from and below."""
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
            cells = [_cell(metrics["by"].get(key, {}).get(name, {}).get(str(IOU))) for metrics in found.values()]
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


def evaluated(folder: Path) -> Iterator[tuple[str, str, Metrics]]:
    """Dataset, split and metrics of everything that was measured."""
    for path in sorted(folder.glob("*/metrics.json")):
        for split, metrics in read_json(path)["splits"].items():
            yield path.parent.name, split, metrics


def label(dataset: str, split: str) -> str:
    """What the tables call a split: those of the preset `paper` by their own names, others by the preset's too."""
    preset = dataset.split("_")[0]
    return split if preset in ("paper", split) else f"{preset} {split}"


def beside(folders: Sequence[Path], data: Path) -> str:
    """A line for each dataset, split and detector."""
    names = ["PCK@0.1 %", *(f"recall at precision {p:.2f}" for p in METRIC_RULES.at_precision), *BANDS_PX]
    lines = ["| | | " + " | ".join(names) + " |", "|---" * (len(names) + 2) + "|"]
    for dataset, split, _ in evaluated(folders[0]):
        file = coco.read(data / dataset / "annotations" / f"{split}.json")
        for folder in folders:
            results = read_vehicle_results(folder / dataset / f"predictions_{split}.json", file)
            lines.append(f"| {label(dataset, split)} | {folder} | " + " | ".join(detector_cells(file, results)) + " |")
    return "\n".join(lines)


def detector_cells(file: AnnotationFile, results: Sequence[Result]) -> list[str]:
    """PCK at the first fixed precision, box recalls at all, and recall and PCK of the bands of heights at the first."""
    everything = match(file, results, score=0.0, thresholds=(IOU,))
    scores, hits = ranked(everything, IOU)
    truth = len(everything.vehicles)
    recalls = [recall_at_precision(scores, hits, truth, p) for p in METRIC_RULES.at_precision]
    found = [_share(one["recall"]) for one in recalls]
    if (least := recalls[0]["score"]) is None:
        return ["-", *found, *("-" for _ in BANDS_PX)]
    shown = match(file, results, score=np.nextafter(least, 0.0), thresholds=(IOU,))
    return [_found(shown)[1], *found, *(", ".join(_found(shown, band)) for band in BANDS_PX.values())]


def _found(matches: Matches, band: tuple[float, float] = (0, math.inf)) -> tuple[str, str]:
    """Box recall, and PCK in per cent, of vehicles whose box is from and below so many pixels high."""
    outcomes = outcomes_at(matches, IOU, OPTIONS)
    height = matches.gt_boxes_xyxy[:, 3] - matches.gt_boxes_xyxy[:, 1]
    part = (band[0] <= height) & (height < band[1])
    found = part & outcomes.found
    return _share(ratio(found.sum(), part.sum())), _percent(
        ratio(outcomes.correct(OPTIONS.alpha)[found].sum(), outcomes.labelled[found].sum())
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with a folder for each dataset")
    parser.add_argument("--beside", type=Path, help="the same of another detector")
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the datasets")
    options = parser.parse_args()
    if options.beside:
        print(beside([options.beside, options.folder], options.data))
        return
    found = {label(dataset, split): metrics for dataset, split, metrics in evaluated(options.folder)}
    print(overall(found), divided(found), sep="\n\n")


if __name__ == "__main__":
    main()
