"""Tables and a curve of the training stages of road33, from scripts/legs.jsonl.

    python scripts/legs_table.py
    python scripts/legs_table.py --curve docs/legs.svg

Figures are those at the end of each stage, against all images visited until then. The row `start` holds the figures
before the first stage.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Final

from tabulate import tabulate

from skope.files.atomic import write_text

LOG: Final = Path(__file__).with_name("legs.jsonl")
CONDITIONS: Final = "conditions_4711"
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 740, 380, 52, 170, 16, 44
COLOURS: Final = ("#0072b2", "#c24e00", "#00795a", "#7a3e9d")
Figures = Mapping[str, Any]


@dataclass(frozen=True)
class Point:
    """Figures of a detector after a number of visited images."""

    name: str
    visits: int
    figures: Mapping[str, Mapping[str, Figures]]
    """By dataset and split."""
    photographs: Figures

    def mean(self, dataset: str, value: Callable[[Figures], float]) -> float | None:
        """Return the mean over the splits of a dataset; None if it was not measured."""
        splits = self.figures.get(dataset, {})
        return fmean(map(value, splits.values())) if splits else None


def read_log() -> list[dict[str, Any]]:
    """Read the stages of road33 in order."""
    rows = [json.loads(line) for line in LOG.read_text().splitlines()]
    return [row for row in rows if row["leg"].isdecimal()]


def points(log: Sequence[Mapping[str, Any]]) -> Iterator[Point]:
    """Yield the start, and the end of each stage."""
    visits = 0
    for row in log:
        if row["leg"] == "1":
            yield Point("start", 0, row["figures"]["start"], row["photographs"]["start"])
        visits += sum(round_["visits"] for round_ in row["rounds"])
        yield Point(row["leg"], visits, row["figures"]["end"], row["photographs"]["end"])


def ap50(figures: Figures) -> float:
    """Return the AP50 of vehicle boxes in percent."""
    return 100 * float(figures["box_ap50"])


def keypoint_ap50(figures: Figures) -> float:
    """Return the AP50 of keypoints in percent."""
    return 100 * float(figures["keypoint_ap50"])


def recall(figures: Figures) -> float:
    """Return the recall of vehicles at precision 0.90 in percent."""
    return 100 * float(figures["recall_at_precision"]["0.9"])


MEANS: Final = {"AP50 of boxes": ap50, "AP50 of keypoints": keypoint_ap50, "recall at precision 0.90": recall}


def legs_table(log: Sequence[Mapping[str, Any]], found: Sequence[Point]) -> str:
    """Tabulate the machine, images and figures of each stage: means over the conditions, and photographs."""
    did = {"start": ("", ""), **{row["leg"]: (row["machine"], _images(row)) for row in log}}
    return markdown_table(
        ["stage", "machine", "images", "visits", *MEANS, "photographs: keypoints", "AP50", "recall at precision 0.95"],
        [
            (
                *(point.name, *did[point.name], f"{point.visits:,}".replace(",", " ")),
                *(_percent(point.mean(CONDITIONS, value)) for value in MEANS.values()),
                _percent(100 * point.photographs["keypoints"]),
                _percent(100 * point.photographs["box_ap50"]),
                _percent(100 * point.photographs["recall_at_precision"]["0.95"]),
            )
            for point in found
        ],
    )


def splits_table(found: Sequence[Point], value: Callable[[Figures], float]) -> str:
    """Tabulate a figure of each split of each dataset, by stage."""
    names = sorted(
        {(dataset, split) for point in found for dataset, splits in point.figures.items() for split in splits}
    )
    return markdown_table(
        ["split", *(point.name for point in found)],
        [
            (
                split,
                *(
                    _percent(value(point.figures[dataset][split]) if dataset in point.figures else None)
                    for point in found
                ),
            )
            for dataset, split in names
        ],
    )


def road_users_table(found: Sequence[Point]) -> str:
    """Tabulate the AP50 of two-wheelers and people, averaged over the conditions that contain them."""
    names = sorted(
        {name for point in found for row in point.figures.get(CONDITIONS, {}).values() for name in row["ap50_of"]}
    )

    def mean(point: Point, name: str) -> float | None:
        values = [row["ap50_of"][name] for row in point.figures.get(CONDITIONS, {}).values() if name in row["ap50_of"]]
        return 100 * fmean(values) if values else None

    return markdown_table(
        ["category", *(point.name for point in found)],
        [(name, *(_percent(mean(point, name)) for point in found)) for name in names],
    )


def curve(found: Sequence[Point]) -> str:
    """Draw the mean figures over the conditions against visited images, as SVG."""
    lines = {name: [(point.visits, point.mean(CONDITIONS, value)) for point in found] for name, value in MEANS.items()}
    known = [y for line in lines.values() for _, y in line if y is not None]
    low, high = 5 * (min(known) // 5), 5 * (max(known) // 5 + 1)
    most = max(point.visits for point in found)

    def to_drawing(visits: float, percent: float) -> tuple[float, float]:
        across, up = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
        return round(LEFT + visits / most * across, 1), round(TOP + (high - percent) / (high - low) * up, 1)

    parts = []
    for percent in range(int(low), int(high) + 1, 5):
        x, y = to_drawing(0, percent)
        parts.append(f'<path d="M{x} {y}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        parts.append(f'<text x="{x - 6}" y="{y + 4}" text-anchor="end">{percent}%</text>')
    for point in found:
        x, y = to_drawing(point.visits, low)
        parts.append(f'<text x="{x}" y="{y + 16}" text-anchor="middle">{point.visits // 1000}k</text>')
    parts.append(f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">images visited</text>')
    for colour, (name, line) in zip(COLOURS, lines.items(), strict=False):
        at = [to_drawing(x, y) for x, y in line if y is not None]
        parts.append(
            f'<path d="M{"L".join(f"{x} {y}" for x, y in at)}" fill="none" stroke="{colour}" stroke-width="2"/>'
        )
        parts += [f'<circle cx="{x}" cy="{y}" r="4" fill="{colour}"/>' for x, y in at]
        parts.append(f'<text x="{at[-1][0] + 10}" y="{at[-1][1] + 4}" fill="{colour}">{name}</text>')
    size = f'viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>'
    return head + f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>' + "".join(parts) + "</svg>\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--curve", type=Path, help="SVG to write")
    options = parser.parse_args()
    log = read_log()
    found = list(points(log))
    print(legs_table(log, found))
    print("\nAP50 of boxes, percent:\n")
    print(splits_table(found, ap50))
    print("\nRecall at precision 0.90, percent:\n")
    print(splits_table(found, recall))
    print("\nAP50, percent, over the conditions:\n")
    print(road_users_table(found))
    if options.curve is not None:
        write_text(options.curve, curve(found))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table as in docs/."""
    return str(tabulate(rows, headers=list(head), tablefmt="github", disable_numparse=True))


def _images(row: Mapping[str, Any]) -> str:
    return str(max(round_["images"] for round_ in row["rounds"]))


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


if __name__ == "__main__":
    main()
