"""Gallery of the best, median and worst images of a split, with switchable layers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from markupsafe import Markup

from skope.errors import UserError
from skope.metrics.failures import ERROR_KINDS, false_detections, wrong_points
from skope.metrics.keypoint_outcomes import MetricOptions, Outcomes
from skope.metrics.match import box_of
from skope.metrics.outcome_counts import quality
from skope.metrics.split_scores import SplitScores
from skope.page import image_viewer
from skope.page.svg import path_svg, tag
from skope.types import Array, Integers, Mask

IMAGES_OF_A_KIND: Final = 2
"""Number of images of each kind (best, median, worst)."""
FAILURE_WORDS: Final = {"left_right": "left/right swapped", "front_rear": "front/rear swapped", "jitter": "jitter"}
FAILURE_LABELS: Final = {"left_right": "L/R", "front_rear": "F/R", "jitter": "jitter"}
"""Kinds of failures as short labels in the image."""


@dataclass(frozen=True)
class Choice:
    """Image of a split that is shown in the gallery."""

    index: int
    kind: str
    quality: float


def chosen_images(values: Array, blocks: Integers) -> list[Choice]:
    """Return the best images, those around the median, and the worst. Each image appears only once.

    The images of a kind are from different `blocks` if possible, because neighbouring frames are similar.
    """
    order = [int(i) for i in np.argsort(values, kind="stable") if not np.isnan(values[i])]
    rank = {i: position for position, i in enumerate(order)}
    inwards = sorted(order, key=lambda i: abs(rank[i] - (len(order) - 1) / 2))
    kinds: dict[int, str] = {}
    for kind, candidates in (("best", order[::-1]), ("worst", order), ("median", inwards)):
        for i in _spread([i for i in candidates if i not in kinds], blocks)[:IMAGES_OF_A_KIND]:
            kinds[i] = kind
    chosen = [Choice(i, kind, float(values[i])) for i, kind in kinds.items()]
    return sorted(chosen, key=lambda c: ("best", "median", "worst").index(c.kind))


def _spread(candidates: list[int], blocks: Integers) -> list[int]:
    """Reorder the candidates: first the first candidate of each block, then all others."""
    first = {int(blocks[i]): i for i in reversed(candidates)}
    return sorted(candidates, key=lambda i: first[int(blocks[i])] != i)


@dataclass(frozen=True, kw_only=True)
class Photo:
    """Image of the gallery with its drawing."""

    words: str
    quality: float
    picture: str
    """Data URL of the photograph."""
    drawing: Markup
    """Drawing over the photograph."""
    failures: str
    """Failures as text."""


def gallery(measured: SplitScores, root: Path, options: MetricOptions) -> list[Photo]:
    """Draw the best, the median and the worst images of a split, with the failures in each.

    Args:
        measured: Scores of the split.
        root: Folder that paths of images are relative to.
        options: The counting rules. The lowest IoU threshold selects the images.

    Returns:
        The images, without unreadable files.
    """
    threshold = options.loosest
    outcomes = measured.outcomes[threshold]
    kinds = wrong_points(measured.matches, outcomes, options)
    photos = []
    for choice in chosen_images(quality(measured.tallies[threshold]), measured.blocks.number):
        image = measured.file.images[choice.index]
        try:
            picture = image_viewer.embedded(root / image.file_name, (image.width, image.height))
        except UserError:
            continue
        layers, failures = _layers(measured, choice.index, outcomes, kinds, options)
        photos.append(
            Photo(
                words=f"{choice.kind} of {measured.file.name}: {image.file_name}",
                quality=choice.quality,
                picture=picture,
                drawing=image_viewer.drawing(layers, (image.width, image.height)),
                failures="; ".join(failures) or "no failures",
            )
        )
    return photos


# --------------------------------------------------------------------------------------------------------------- layers


def _layers(
    measured: SplitScores, index: int, outcomes: Outcomes, kinds: Integers, options: MetricOptions
) -> tuple[list[str], list[str]]:
    """Return the layers of one image as SVG groups, and its failures as text."""
    matches, image = measured.matches, measured.file.images[index]
    unit = image_viewer.unit(image.width)

    def drawn(points: Array, placed: Mask, sure: Mask, joined: Mask) -> Markup:
        return image_viewer.points(points, placed, sure, joined, unit, options.scheme.skeleton, options.points)

    truth, found, wrong, words = [], [], [], []
    labels: list[tuple[Array, str]] = []
    ignored = [
        image_viewer.box_svg(box_of(a, options.boxes))
        for a in measured.file.annotations
        if a.ignored and a.image_id == image.id
    ]
    for g in np.flatnonzero(matches.gt_image == index):
        vehicle = matches.vehicles[g]
        box, points = box_of(vehicle, options.boxes), matches.gt_keypoints[g]
        name = f"vehicle {vehicle.id if vehicle.track_id is None else vehicle.track_id}"
        placed = points[:, 2] > 0
        truth.append(image_viewer.box_svg(box, name) + drawn(points, placed, points[:, 2] > 1, placed))
        if not outcomes.found[g]:
            labels.append((box, "missed"))
            words.append(f"{name} missed")
            continue
        counts = {kind: int((kinds[g] == i).sum()) for i, kind in enumerate(ERROR_KINDS)}
        counts = {kind: count for kind, count in counts.items() if count}
        if counts:
            wrong.append(_strays(points, matches.det_keypoints[outcomes.detection[g]], kinds[g] >= 0))
            labels.append((box, ", ".join(f"{count} {FAILURE_LABELS[kind]}" for kind, count in counts.items())))
            words.append(f"{name}: {', '.join(f'{count} {FAILURE_WORDS[kind]}' for kind, count in counts.items())}")
    false = false_detections(matches, outcomes)
    for d in np.flatnonzero(matches.det_image == index):
        box = measured.results[matches.det_result[d]].bbox
        points = matches.det_keypoints[d]
        name = f"detection, score {matches.det_score[d]:.2f}"
        placed, sure = np.ones(len(points), dtype=bool), points[:, 2] >= 0.5
        found.append(image_viewer.box_svg(box, name) + drawn(points, placed, sure, sure))
        if false[d]:
            labels.append((box, "false"))
            words.append(f"false {name}")
    if "categories" in measured.entry:
        users = [user for user in measured.file.road_users if user.image_id == image.id]
        for user in users:
            name = f"{user.category} {user.id if user.track_id is None else user.track_id}"
            (ignored if user.ignored else truth).append(image_viewer.box_svg(box_of(user, options.boxes), name))
        sure = [
            result for result in measured.road_users if result.image_id == image.id and result.score > options.score
        ]
        found += [image_viewer.box_svg(result.bbox, f"{result.category}, score {result.score:.2f}") for result in sure]
    wrong.append(image_viewer.labels_svg(labels, (image.width, image.height)))
    layers = {"ignored": ignored, "truth": truth, "found": found, "wrong": wrong}
    return [tag("g", *parts, class_=name) for name, parts in layers.items()], words


def _strays(truth: Array, found: Array, wrong: Mask) -> Markup:
    """Return lines from the predicted to the true position of each wrong keypoint."""
    return path_svg(
        "".join(
            f"M{image_viewer.path_point(found[k])}L{image_viewer.path_point(truth[k])}" for k in np.flatnonzero(wrong)
        ),
        "stray",
    )
