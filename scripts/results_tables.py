"""The tables of docs/results.md.

    python scripts/results_tables.py legs                              # from scripts/legs.jsonl
    python scripts/results_tables.py legs --curve docs/legs.svg
    python scripts/results_tables.py reference runs/reference/road33/packed
    python scripts/results_tables.py reference runs/reference/road33/packed --beside runs/reference/varied/packed \\
        --data data

`legs`: the training stages of `road33`, and a curve. Figures are those at the end of each stage, against all images
that were visited until then; those before the first stage are its start's.

`reference`: results that scripts/reference_run.py wrote, a folder of `skope eval` for each dataset. `--beside`
compares two detectors: recall at precision 0.90 and 0.95, and from the score of precision 0.90 on the PCK, and what
is found of small and of large vehicles.
"""

import argparse
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import numpy as np
from tabulate import tabulate

from skope.dataset import coco
from skope.files.atomic import write_text
from skope.files.json_files import read_json
from skope.metrics.keypoint_outcomes import Options, outcomes_at
from skope.metrics.match import Matches, match
from skope.metrics.outcome_counts import ratio
from skope.metrics.pck_precision_recall import AT_PRECISION, ranked, recall_at_precision
from skope.metrics.read_inputs import read_vehicle_results
from skope.schema import AnnotationFile, Result

LOG: Final = Path(__file__).with_name("legs.jsonl")
CONDITIONS: Final = "conditions_4711"
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 740, 380, 52, 170, 16, 44
COLOURS: Final = ("#0072b2", "#c24e00", "#00795a", "#7a3e9d")
Figures = Mapping[str, Any]


@dataclass(frozen=True)
class Point:
    """The figures of a detector after a number of visited images."""

    name: str
    visits: int
    figures: Mapping[str, Mapping[str, Figures]]
    """By dataset and split."""
    photographs: Figures

    def mean(self, dataset: str, value: Callable[[Figures], float]) -> float | None:
        """The mean over a dataset's splits; None where it was not measured."""
        splits = self.figures.get(dataset, {})
        return fmean(map(value, splits.values())) if splits else None


def read_log() -> list[dict[str, Any]]:
    """The legs of road33, in their order."""
    rows = [json.loads(line) for line in LOG.read_text().splitlines()]
    return [row for row in rows if row["leg"].isdecimal()]


def points(log: Sequence[Mapping[str, Any]]) -> Iterator[Point]:
    """The start, and the end of each leg."""
    visits = 0
    for row in log:
        if row["leg"] == "1":
            yield Point("start", 0, row["figures"]["start"], row["photographs"]["start"])
        visits += sum(one["visits"] for one in row["rounds"])
        yield Point(row["leg"], visits, row["figures"]["end"], row["photographs"]["end"])


def ap50(figures: Figures) -> float:
    """AP50 of vehicles' boxes, percent."""
    return 100 * float(figures["box_ap50"])


def keypoint_ap50(figures: Figures) -> float:
    """AP50 of keypoints, percent."""
    return 100 * float(figures["keypoint_ap50"])


def recall(figures: Figures) -> float:
    """Recall of vehicles at precision 0.90, percent."""
    return 100 * float(figures["recall_at_precision"]["0.9"])


MEANS: Final = {"AP50 of boxes": ap50, "AP50 of keypoints": keypoint_ap50, "recall at precision 0.90": recall}


def _leg_percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def legs_table(log: Sequence[Mapping[str, Any]], found: Sequence[Point]) -> str:
    """Machine, images and figures of each stage: mean over the conditions, and photographs."""
    did = {
        "start": ("", ""),
        **{row["leg"]: (row["machine"], str(max(one["images"] for one in row["rounds"]))) for row in log},
    }
    return markdown_table(
        ["leg", "machine", "images", "visits", *MEANS, "photographs: keypoints", "AP50", "recall at precision 0.95"],
        [
            (
                *(one.name, *did[one.name], f"{one.visits:,}".replace(",", " ")),
                *(_leg_percent(one.mean(CONDITIONS, value)) for value in MEANS.values()),
                _leg_percent(100 * one.photographs["keypoints"]),
                _leg_percent(100 * one.photographs["box_ap50"]),
                _leg_percent(100 * one.photographs["recall_at_precision"]["0.95"]),
            )
            for one in found
        ],
    )


def splits_table(found: Sequence[Point], value: Callable[[Figures], float]) -> str:
    """A figure of each split of each dataset, by leg."""
    names = sorted({(dataset, split) for one in found for dataset, splits in one.figures.items() for split in splits})
    return markdown_table(
        ["split", *(one.name for one in found)],
        [
            (
                split,
                *(
                    _leg_percent(value(one.figures[dataset][split]) if dataset in one.figures else None)
                    for one in found
                ),
            )
            for dataset, split in names
        ],
    )


def others_table(found: Sequence[Point]) -> str:
    """AP50 of two-wheelers and people, in the mean over the conditions that have them."""
    names = sorted(
        {name for one in found for row in one.figures.get(CONDITIONS, {}).values() for name in row["ap50_of"]}
    )

    def mean(one: Point, name: str) -> float | None:
        own = [row["ap50_of"][name] for row in one.figures.get(CONDITIONS, {}).values() if name in row["ap50_of"]]
        return 100 * fmean(own) if own else None

    return markdown_table(
        ["category", *(one.name for one in found)],
        [(name, *(_leg_percent(mean(one, name)) for one in found)) for name in names],
    )


def curve(found: Sequence[Point]) -> str:
    """An SVG of the mean figures over the conditions against visits."""
    lines = {name: [(one.visits, one.mean(CONDITIONS, value)) for one in found] for name, value in MEANS.items()}
    known = [y for line in lines.values() for _, y in line if y is not None]
    low, high = 5 * (min(known) // 5), 5 * (max(known) // 5 + 1)
    most = max(one.visits for one in found)

    def place(visits: float, percent: float) -> tuple[float, float]:
        across, up = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
        return round(LEFT + visits / most * across, 1), round(TOP + (high - percent) / (high - low) * up, 1)

    parts = []
    for percent in range(int(low), int(high) + 1, 5):
        x, y = place(0, percent)
        parts.append(f'<path d="M{x} {y}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        parts.append(f'<text x="{x - 6}" y="{y + 4}" text-anchor="end">{percent}%</text>')
    for one in found:
        x, y = place(one.visits, low)
        parts.append(f'<text x="{x}" y="{y + 16}" text-anchor="middle">{one.visits // 1000}k</text>')
    parts.append(f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">images visited</text>')
    for colour, (name, line) in zip(COLOURS, lines.items(), strict=False):
        at = [place(x, y) for x, y in line if y is not None]
        parts.append(
            f'<path d="M{"L".join(f"{x} {y}" for x, y in at)}" fill="none" stroke="{colour}" stroke-width="2"/>'
        )
        parts += [f'<circle cx="{x}" cy="{y}" r="4" fill="{colour}"/>' for x, y in at]
        parts.append(f'<text x="{at[-1][0] + 10}" y="{at[-1][1] + 4}" fill="{colour}">{name}</text>')
    size = f'viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>'
    return head + f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>' + "".join(parts) + "</svg>\n"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as the pages of docs/ have them."""
    return str(tabulate(rows, headers=list(head), tablefmt="github", disable_numparse=True))


PUBLISHED = Path(__file__).parents[1] / "skope" / "eval" / "report" / "published_results.json"
IOU = 0.6
OPTIONS = Options(iou=(IOU,))
BANDS_PX = {"12 to 30 px high": (12, 30), "200 px and more": (200, math.inf)}
"""Heights of ground-truth boxes, from and below."""
BY = ("distance", "height", "occlusion", "truncation", "unoccluded_within_40_m", "weather", "vehicle_type", "model")


def overall(found: Mapping[str, Figures]) -> str:
    """A line for each split and IoU, with the published figures."""
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


def divided(found: Mapping[str, Figures]) -> str:
    """Box recall and PCK (%) by properties of the vehicles."""
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


def evaluated(folder: Path) -> Iterator[tuple[str, str, Figures]]:
    """Dataset, split and metrics of everything that was measured."""
    for path in sorted(folder.glob("*/metrics.json")):
        for split, metrics in read_json(path)["splits"].items():
            yield path.parent.name, split, metrics


def label(dataset: str, split: str) -> str:
    """Name of a split in the tables: its own for the preset `paper`, else with the preset's."""
    preset = dataset.split("_")[0]
    return split if preset in ("paper", split) else f"{preset} {split}"


def beside(folders: Sequence[Path], data: Path) -> str:
    """A line for each dataset, split and detector."""
    names = ["PCK@0.1 %", *(f"recall at precision {p:.2f}" for p in AT_PRECISION), *BANDS_PX]
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
    recalls = [recall_at_precision(scores, hits, truth, p) for p in AT_PRECISION]
    found = [_share(one["recall"]) for one in recalls]
    if (least := recalls[0]["score"]) is None:
        return ["-", *found, *("-" for _ in BANDS_PX)]
    shown = match(file, results, score=np.nextafter(least, 0.0), thresholds=(IOU,))
    return [_found(shown)[1], *found, *(", ".join(_found(shown, band)) for band in BANDS_PX.values())]


def _found(matches: Matches, band: tuple[float, float] = (0, math.inf)) -> tuple[str, str]:
    """Box recall, and PCK in per cent, of vehicles whose box height is in a band, pixels."""
    outcomes = outcomes_at(matches, IOU, OPTIONS)
    height = matches.gt_boxes_xyxy[:, 3] - matches.gt_boxes_xyxy[:, 1]
    part = (band[0] <= height) & (height < band[1])
    found = part & outcomes.found
    return _share(ratio(found.sum(), part.sum())), _percent(
        ratio(outcomes.correct(OPTIONS.alpha)[found].sum(), outcomes.labelled[found].sum())
    )


def print_legs(options: argparse.Namespace) -> None:
    """Print the tables of the training stages, and write their curve."""
    log = read_log()
    found = list(points(log))
    print(legs_table(log, found))
    print("\nAP50 of boxes, percent:\n")
    print(splits_table(found, ap50))
    print("\nRecall at precision 0.90, percent:\n")
    print(splits_table(found, recall))
    print("\nAP50, percent, over the conditions:\n")
    print(others_table(found))
    if options.curve is not None:
        write_text(options.curve, curve(found))


def print_reference(options: argparse.Namespace) -> None:
    """Print the tables of a detector, or of two."""
    if options.beside:
        print(beside([options.beside, options.folder], options.data))
        return
    found = {label(dataset, split): metrics for dataset, split, metrics in evaluated(options.folder)}
    print(overall(found), divided(found), sep="\n\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    legs = commands.add_parser("legs", help="the training stages of road33")
    legs.add_argument("--curve", type=Path, help="SVG to write")
    legs.set_defaults(run=print_legs)
    reference = commands.add_parser("reference", help="results of one detector, or of two")
    reference.add_argument("folder", type=Path, help="with a folder for each dataset")
    reference.add_argument("--beside", type=Path, help="the same of another detector")
    reference.add_argument("--data", type=Path, default=Path("data"), help="folder of the datasets")
    reference.set_defaults(run=print_reference)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
