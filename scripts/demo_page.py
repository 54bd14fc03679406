"""The page at the end of `make demo`: the results, pictures first, and the effect of fine-tuning.

    python scripts/demo_page.py runs/demo --data data/demo

Writes RUN/index.html, with embedded pictures and links to the files beside it, and prints the verdict.
"""

import argparse
import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skope.dataset.folder import open_dataset, read_image
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.files.json_files import read_json
from skope.page.image_viewer import jpeg
from skope.page.templates import Table, percent_text, render
from skope.pictures import draw
from skope.video.footage import open_footage

IOU = "0.6"
SPLIT = "extra"
FIGURES = {"PCK@0.1": "pck", "box precision": "box_precision", "box recall": "box_recall"}


def photo(pixels: NDArray[np.uint8], title: str) -> dict[str, Any]:
    """Embed an image (H, W, 3) in the page, with a title."""
    height, width = pixels.shape[:2]
    return {"title": title, "source": jpeg(pixels, longest=max(width, height), quality=82), "size": (width, height)}


def rates(metrics: Mapping[str, Any]) -> dict[str, tuple[float | None, int]]:
    """Return each of `FIGURES` in an evaluation, and the number of objects that it is a share of."""
    split = metrics["splits"][SPLIT]
    row = split["iou"][IOU]
    counts = {"pck": row["labelled"], "box_precision": split["detections"], "box_recall": split["ground_truth"]}
    values = {key: row[key]["pooled"] if isinstance(row[key], dict) else row[key] for key in FIGURES.values()}
    return {name: (values[key], counts[key]) for name, key in FIGURES.items()}


def verdict(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Describe the effect of fine-tuning.

    A change counts if it exceeds twice its standard deviation, assuming independent samples. Vehicles of one recording
    resemble each other, so a real change has to be even larger.
    """
    changes = []
    later = rates(after)
    for name, (old, count) in rates(before).items():
        new = later[name][0]
        if old is None or new is None or not count:
            continue
        middle = (old + new) / 2
        if abs(new - old) > 2 * math.sqrt(2 * middle * (1 - middle) / count):
            changes.append(f"{name} {'rose' if new > old else 'fell'} from {percent_text(old)} to {percent_text(new)}")
    if not changes:
        return "Fine-tuning changed nothing that these few images could show."
    return f"Fine-tuning: {', '.join(changes)}. There are few images, all of one recording: do not rely on it."


def tracked(path: Path) -> str:
    """Describe the number of tracked vehicles and the highest speed."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["category"] == "vehicle"]
    if not rows:
        return "No vehicle was tracked."
    fastest = 3.6 * max(float(row["speed"]) for row in rows)
    return f"{len({row['track'] for row in rows})} vehicles were tracked; the fastest drove {fastest:.0f} km/h."


def page(run: Path, data: Path) -> tuple[str, str]:
    """Return the page, and the verdict on fine-tuning."""
    before, after = (read_json(run / name / "metrics.json") for name in ("road33", "tuned_score"))

    seen, tracks = run / "seen", run / "tracks"
    files = {name: tracks / name for name in ("tracks.csv", "fcd.xml", "mot.txt")}
    files |= {"overlay.mp4": seen / "overlay.mp4", "The card": data / "README.md"}
    files |= {"road33": run / "road33" / "report.html", "fine-tuned": run / "tuned_score" / "report.html"}
    verdict_text = verdict(before, after)
    made = render(
        Path(__file__).with_suffix(".html"),
        title="skope: the demonstration",
        links={name: Path(os.path.relpath(path, run)).as_posix() for name, path in files.items()},
        tracked=tracked(tracks / "tracks.csv"),
        above=photo(read_image(tracks / "birdseye.png"), "Tracks of the vehicles, seen from above"),
        before=photo(
            middle_frame(seen / "overlay.mp4"), "The same road in the camera image, with detections of road33"
        ),
        labelled=labelled(data),
        scores=scores(before, after),
        verdict=verdict_text,
    )
    return made, verdict_text


def scores(before: Mapping[str, Any], after: Mapping[str, Any]) -> Table:
    """Tabulate the figures of both detectors."""
    later = rates(after)
    rows = [
        [name, percent_text(old), percent_text(later[name][0]), count] for name, (old, count) in rates(before).items()
    ]
    caption = f"{before['splits'][SPLIT]['images']} images of a road that neither was trained on, at IoU {IOU}"
    return Table(caption=caption, head=("", "road33", "fine-tuned", "of (road33)"), rows=rows)


def middle_frame(video: Path) -> NDArray[np.uint8]:
    """Return the middle frame (H, W, 3) of a video."""
    footage = open_footage(str(video))
    _, pixels = next(footage.frames(len(footage) // 2))
    return pixels


def labelled(data: Path) -> dict[str, dict[str, Any]]:
    """Draw one image of each split with its ground truth."""
    opened = open_dataset(data)
    out = {}
    for split in opened.splits:
        images = list(opened.images(split))
        chosen = images[len(images) // 2]
        drawn = draw.annotations(chosen.pixels(), chosen.annotations)
        out[split] = photo(drawn, chosen.record.site or split)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder with road33, tuned_score, seen and tracks")
    parser.add_argument("--data", type=Path, required=True, help="the dataset")
    arguments = parser.parse_args()
    try:
        made, verdict_text = page(arguments.run, arguments.data)
    except UserError as error:
        parser.exit(2, f"demo_page: {error}\n")
    write_text(arguments.run / "index.html", made)
    print(verdict_text)
    print(f"Open {arguments.run / 'index.html'} in a browser: it shows all results, pictures first.")


if __name__ == "__main__":
    main()
