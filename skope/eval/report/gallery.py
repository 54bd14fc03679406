"""The best, median and worst images of a split, with ground truth, predictions and failures as layers to switch."""

import base64
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from skope import dataset
from skope.boxes import xywh_to_xyxy
from skope.errors import UserError
from skope.eval.failures import KINDS, false_detections, wrong_points
from skope.eval.match import box_of
from skope.eval.measure import Measured
from skope.eval.report.marks import tag
from skope.eval.tally import Floats, Integers, Judged, Options

EACH: Final = 2
"""Images of each kind."""
LONGEST: Final = 960
QUALITY: Final = 78
WORDS: Final = {"left_right": "left/right swapped", "front_rear": "front/rear swapped", "jitter": "jitter"}
SHORT: Final = {"left_right": "L/R", "front_rear": "F/R", "jitter": "jitter"}
"""What stands in the picture itself, where there is little room."""


@dataclass(frozen=True)
class Choice:
    """An image to show, and why."""

    index: int
    kind: str
    quality: float


def quality(measured: Measured, threshold: float) -> Floats:
    """(N,) share of an image's labelled keypoints that are right, times vehicles / (vehicles + false ones).

    NaN where nothing is labelled: such images are not shown.
    """
    counts = measured.tallies[threshold]
    false = counts.detections - counts.matched - counts.detections_ignored
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(counts.labelled_all > 0, counts.correct / counts.labelled_all, np.nan)
        return np.asarray(found * counts.ground_truth / (counts.ground_truth + false))


def choose(values: Floats, blocks: Integers) -> list[Choice]:
    """The best, those around the median, and the worst; few images are shown once each, as the first that they are.

    Of each kind the images come from different `blocks`, where there are enough: neighbouring frames look alike.
    """
    order = [int(i) for i in np.argsort(values, kind="stable") if not np.isnan(values[i])]
    rank = {i: place for place, i in enumerate(order)}
    inwards = sorted(order, key=lambda i: abs(rank[i] - (len(order) - 1) / 2))
    kinds: dict[int, str] = {}
    for kind, candidates in (("best", order[::-1]), ("worst", order), ("median", inwards)):
        for i in _spread([i for i in candidates if i not in kinds], blocks)[:EACH]:
            kinds[i] = kind
    chosen = [Choice(i, kind, float(values[i])) for i, kind in kinds.items()]
    return sorted(chosen, key=lambda c: ("best", "median", "worst").index(c.kind))


def _spread(candidates: list[int], blocks: Integers) -> list[int]:
    """The same in another order: first the first one of each block."""
    first = {int(blocks[i]): i for i in reversed(candidates)}
    return sorted(candidates, key=lambda i: first[int(blocks[i])] != i)


def gallery(measured: Measured, root: Path, options: Options) -> str:
    """Figures of the chosen images whose files are there, as markup."""
    threshold = options.loosest
    judged = measured.judged[threshold]
    kinds = wrong_points(measured.matches, judged, options)
    figures = []
    for choice in choose(quality(measured, threshold), measured.blocks.number):
        image = measured.file.images[choice.index]
        try:
            picture = _embedded(root / image.file_name, (image.width, image.height))
        except UserError:
            continue
        layers, failures = _layers(measured, choice.index, judged, kinds, options)
        drawing = tag(
            "svg", *layers, viewBox=f"0 0 {image.width} {image.height}", aria_hidden="true", preserveAspectRatio="none"
        )
        words = f"{choice.kind} of {measured.file.name}: {image.file_name}"
        said = "; ".join(failures) or "no failures"
        figures.append(
            tag(
                "figure",
                tag("figcaption", tag("b", escape(words)), f" (quality {choice.quality:.2f})"),
                tag(
                    "div",
                    f'<img src="{picture}" alt="{escape(f"{words}. {said}", quote=True)}">',
                    drawing,
                    class_="stage",
                ),
                tag("p", escape(f"Failures: {said}.")),
                class_="photo",
            )
        )
    return "".join(figures)


def _embedded(path: Path, size: tuple[int, int]) -> str:
    pixels = dataset.read_image(path, size)
    scale = min(1.0, LONGEST / max(size))
    if scale < 1:
        pixels = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


# --------------------------------------------------------------------------------------------------------------- layers


def _layers(
    measured: Measured, index: int, judged: Judged, kinds: Integers, options: Options
) -> tuple[list[str], list[str]]:
    """Layers of one image as SVG groups, and its failures in words."""
    matches, image = measured.matches, measured.file.images[index]
    unit = max(1.0, image.width / 640)

    def label(box: Floats, text: str) -> str:
        return _label(box, text, unit, image.width)

    truth, found, wrong, words = [], [], [], []
    ignored = [
        _box(box_of(a, options.boxes)) for a in measured.file.annotations if a.ignored and a.image_id == image.id
    ]
    for g in np.flatnonzero(matches.gt_image == index):
        vehicle = matches.vehicles[g]
        box, points = box_of(vehicle, options.boxes), matches.gt_keypoints[g]
        name = f"vehicle {vehicle.id if vehicle.track_id is None else vehicle.track_id}"
        known = points[:, 2] > 0
        truth.append(_vehicle(box, points, known, points[:, 2] > 1, known, options, unit, name))
        if not judged.found[g]:
            wrong.append(label(box, "missed"))
            words.append(f"{name} missed")
            continue
        counts = {kind: int((kinds[g] == i).sum()) for i, kind in enumerate(KINDS)}
        counts = {kind: count for kind, count in counts.items() if count}
        if counts:
            wrong.append(_strays(points, matches.det_keypoints[judged.detection[g]], kinds[g] >= 0))
            wrong.append(label(box, ", ".join(f"{count} {SHORT[kind]}" for kind, count in counts.items())))
            words.append(f"{name}: {', '.join(f'{count} {WORDS[kind]}' for kind, count in counts.items())}")
    false = false_detections(matches, judged)
    for d in np.flatnonzero(matches.det_image == index):
        box = measured.results[matches.det_result[d]].bbox
        points = matches.det_keypoints[d]
        name = f"detection, score {matches.det_score[d]:.2f}"
        sure = points[:, 2] >= 0.5
        found.append(_vehicle(box, points, np.ones(len(points), bool), sure, sure, options, unit, name))
        if false[d]:
            wrong.append(label(box, "false"))
            words.append(f"false {name}")
    layers = {"ignored": ignored, "truth": truth, "found": found, "wrong": wrong}
    return [tag("g", *parts, class_=name) for name, parts in layers.items()], words


def _path(d: str, class_: str) -> str:
    return f'<path class="{class_}" d="{d}"/>' if d else ""


def _box(box_xywh: Floats, name: str | None = None) -> str:
    x, y, w, h = (round(float(v), 1) for v in box_xywh)
    return tag("rect", x=x, y=y, width=max(w, 0), height=max(h, 0), data_tip=name)


def _vehicle(
    box: Floats, points: Floats, known: Any, sure: Any, joined: Any, options: Options, unit: float, name: str
) -> str:
    """A box, the skeleton between joined points, and the known points: dots where sure, else rings."""
    shown = options.points
    edges = "".join(
        f"M{_at(points[a])}L{_at(points[b])}"
        for a, b in options.scheme.skeleton
        if a in shown and b in shown and joined[a] and joined[b]
    )
    r = 1.6 * unit
    ring = f"m{-r:g} 0a{r:g} {r:g} 0 1 0 {2 * r:g} 0a{r:g} {r:g} 0 1 0 {-2 * r:g} 0"
    dots = "".join(f"M{_at(points[k])}h0" for k in shown if known[k] and sure[k])
    rings = "".join(f"M{_at(points[k])}{ring}" for k in shown if known[k] and not sure[k])
    return _box(box, name) + _path(edges, "edges") + _path(rings, "rings") + _path(dots, "dots")


def _strays(truth: Floats, found: Floats, wrong: Any) -> str:
    """From where each wrong point was put to where it belongs."""
    return _path("".join(f"M{_at(found[k])}L{_at(truth[k])}" for k in np.flatnonzero(wrong)), "stray")


def _at(point: Floats) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _label(box_xywh: Floats, text: str, unit: float, width: int) -> str:
    """Text above a box, kept inside the image; it ends with the box where it begins in the image's last fifth."""
    x0, y0, x1, _ = xywh_to_xyxy(box_xywh)
    size = 11 * unit
    late = x0 > 0.8 * width
    x, anchor = (min(x1, width), "end") if late else (max(x0, 0.0), "start")
    attributes = f'x="{x:.1f}" y="{max(y0 - 3, size):.1f}" text-anchor="{anchor}" font-size="{size:g}"'
    return f"<text {attributes}>{escape(text)}</text>"
