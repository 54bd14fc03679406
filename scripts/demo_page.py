"""The page at the end of `make demo`: what was made, pictures first, and what fine-tuning changed.

    python scripts/demo_page.py runs/demo --data data/demo

It writes RUN/index.html, with the pictures inside and links to the files beside it, and prints the verdict.
"""

import argparse
import base64
import csv
import math
import os
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.dataset.folder import open_dataset, read_image
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.files.json_files import read_json
from skope.page import html_document
from skope.page.html_pieces import percent_text, table, tag
from skope.pictures import draw
from skope.video.footage import open_footage

IOU = "0.6"
SPLIT = "extra"
FIGURES = {"PCK@0.1": "pck", "box precision": "box_precision", "box recall": "box_recall"}


def embedded(pixels: NDArray[np.uint8], alt: str) -> str:
    """(H, W, 3) as a picture inside the page."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 82])
    assert done
    source = f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
    return tag("div", tag("img", src=source, alt=alt, width=pixels.shape[1], height=pixels.shape[0]), class_="stage")


def figure(pixels: NDArray[np.uint8], title: str, note: str) -> str:
    """A picture under its title; `note`, below, is markup."""
    return tag("figure", tag("figcaption", escape(title)), embedded(pixels, title), tag("p", note))


def rates(metrics: Mapping[str, Any]) -> dict[str, tuple[float | None, int]]:
    """Each figure of `FIGURES` of an evaluation, and how many things it is a share of."""
    split = metrics["splits"][SPLIT]
    row = split["iou"][IOU]
    counts = {"pck": row["labelled"], "box_precision": split["detections"], "box_recall": split["ground_truth"]}
    values = {key: row[key]["pooled"] if isinstance(row[key], dict) else row[key] for key in FIGURES.values()}
    return {name: (values[key], counts[key]) for name, key in FIGURES.items()}


def verdict(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """What fine-tuning changed, in words.

    A change counts when it is larger than twice its standard deviation, were all things drawn one by one. Vehicles of
    one recording resemble each other, so that real changes have to be larger still.
    """
    said = []
    later = rates(after)
    for name, (old, count) in rates(before).items():
        new = later[name][0]
        if old is None or new is None or not count:
            continue
        middle = (old + new) / 2
        if abs(new - old) > 2 * math.sqrt(2 * middle * (1 - middle) / count):
            said.append(f"{name} {'rose' if new > old else 'fell'} from {percent_text(old)} to {percent_text(new)}")
    if not said:
        return "Fine-tuning changed nothing that so few images could show."
    return f"Fine-tuning: {', '.join(said)}. The images are few and of one recording: do not build on it."


def tracked(path: Path) -> str:
    """How many vehicles were followed, and how fast the fastest was, in words."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        return "No vehicle was followed."
    fastest = 3.6 * max(float(row["speed"]) for row in rows)
    return f"{len({row['track'] for row in rows})} vehicles were followed; the fastest drove {fastest:.0f} km/h."


def page(run: Path, data: Path) -> tuple[str, str]:
    """The page, and the verdict on fine-tuning."""
    before, after = (read_json(run / name / "metrics.json") for name in ("road33", "tuned_score"))

    def link(path: Path, words: str) -> str:
        return tag("a", escape(words), href=Path(os.path.relpath(path, run)).as_posix())

    video, tracks = run / "seen" / "overlay.mp4", run / "tracks"
    files = ", ".join(link(tracks / name, name) for name in ("tracks.csv", "fcd.xml", "mot.txt"))
    reports = {"road33": run / "road33", "fine-tuned": run / "tuned_score"}
    links = ", ".join(link(folder / "report.html", words) for words, folder in reports.items())
    said = verdict(before, after)
    parts = (
        tag("h1", "What skope made here"),
        figure(
            read_image(tracks / "birdseye.png"),
            "Vehicles followed in metres, from above",
            f"{tracked(tracks / 'tracks.csv')} Files: {files}.",
        ),
        figure(
            middle_frame(video),
            "The same road before the camera, with what road33 found",
            f"A frame of {link(video, 'overlay.mp4')}: the whole footage with boxes and keypoints, for a video player.",
        ),
        tag("h2", "Generated images and their labels"),
        tag("div", *labelled(data), class_="grid"),
        tag("p", f"{link(data / 'README.md', 'The card')} says what is in this dataset."),
        tag("h2", "How good the detector is there, and what fine-tuning changed"),
        scores(before, after),
        tag("p", f"{escape(said)} Reports with pictures: {links}."),
    )
    return html_document("skope: the demonstration", *parts), said


def scores(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """The figures of both detectors beside each other."""
    later = rates(after)
    rows = [
        [name, percent_text(old), percent_text(later[name][0]), str(count)]
        for name, (old, count) in rates(before).items()
    ]
    caption = f"{before['splits'][SPLIT]['images']} images of a road that neither was trained on, at IoU {IOU}"
    return table(("", "road33", "fine-tuned", "of (road33)"), rows, caption=caption)


def middle_frame(video: Path) -> NDArray[np.uint8]:
    """(H, W, 3) the frame in the middle of a video."""
    footage = open_footage(str(video))
    _, pixels = next(footage.frames(len(footage) // 2))
    return pixels


def labelled(data: Path) -> list[str]:
    """A figure of an image of each split with its ground truth."""
    opened = open_dataset(data)
    out = []
    for split in opened.splits:
        images = list(opened.images(split))
        chosen = images[len(images) // 2]
        drawn = draw.annotations(chosen.pixels(), chosen.annotations)
        note = f"Split {escape(split)}: filled keypoints are visible, hollow ones hidden; dashed boxes are ignored."
        out.append(figure(drawn, chosen.record.site or split, note))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder with road33, tuned_score, seen and tracks")
    parser.add_argument("--data", type=Path, required=True, help="the dataset")
    arguments = parser.parse_args()
    try:
        made, said = page(arguments.run, arguments.data)
    except UserError as error:
        parser.exit(2, f"demo_page: {error}\n")
    write_text(arguments.run / "index.html", made)
    print(said)
    print(f"Open {arguments.run / 'index.html'} in a browser: everything that was made, pictures first.")


if __name__ == "__main__":
    main()
