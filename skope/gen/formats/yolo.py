"""Ultralytics' pose datasets: `data.yaml`, `images/<part>/...` and `labels/<part>/...`, one text file per image.

A row is `0 x y w h` and x, y, v of each keypoint, with lengths as shares of the image's width and height. An image
without a vehicle has an empty file. If a dataset labels people on foot and on two wheels, these are classes 1 to 3,
with v = 0 in all keypoints, since all rows of this format have the same length. The format has no ignored objects: they
are background to its trainers.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np

from skope.dataset.folder import Dataset
from skope.dataset.image_selection import held_back
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.gen.formats.dataset_builder import bare_name
from skope.gen.output.writers import place_file
from skope.keypoints import K, Scheme
from skope.schema import Annotation, AnnotationFile, Image, RoadUser
from skope.terminal.console import Console, counted

VALIDATION_SHARE: Final = 0.1
"""Share of each training recording, at its end, that becomes part `val` of a dataset without that split."""
YOLO_SUFFIXES: Final = frozenset((".bmp", ".dng", ".heic", ".jpeg", ".jpg", ".mpo", ".png", ".tif", ".tiff", ".webp"))
"""Suffixes of the images that Ultralytics reads."""
YOLO_SPLITS, VAL = "train", "val"


def write(dataset: Dataset, out: Path, names: Sequence[str], console: Console) -> None:
    """Write a dataset for Ultralytics to `out`; `names` are the keypoints to write, in their order (empty: all)."""
    chosen = _indices(dataset.scheme, names)
    parts = _parts(dataset, console)
    kept, ignored = 0, Counter[str]()
    for name, file in parts.items():
        labels_by_image = file.labels_by_image()
        for image in console.bar(file.images, unit="image", label=f"writing {name}"):
            path = PurePosixPath(name) / _findable(bare_name(image.file_name))
            if path.suffix.lower() not in YOLO_SUFFIXES:
                raise UserError(
                    f"{dataset.root}: {image.file_name}: Ultralytics does not read "
                    f"{path.suffix or 'files without a suffix'} ({', '.join(sorted(YOLO_SUFFIXES))})"
                )
            place_file(dataset.root / image.file_name, out / "images" / path)
            labels = out / "labels" / path.with_suffix(".txt")
            if labels.exists():
                raise UserError(f"{dataset.root}: {image.file_name}: another image has this name with another suffix")
            rows = [
                _row(label, image, chosen, file.categories) for label in labels_by_image[image.id] if not label.ignored
            ]
            kept += len(rows)
            ignored.update(label.ignore_reason or "others" for label in labels_by_image[image.id] if label.ignored)
            write_text(labels, "".join(rows))
    flip = _flip(dataset.scheme, chosen)
    if flip is None:
        console.say("no flip_idx: a chosen keypoint's mirror partner is unknown or not chosen; fliplr stays off")
    several = any(len(file.categories) > 1 for file in parts.values())
    if ignored:
        ignored_noun = "ignored road user" if several else "ignored vehicle"
        reasons = ", ".join(f"{number} {reason}" for reason, number in ignored.most_common())
        console.say(
            f"{counted(ignored.total(), ignored_noun)} in addition to {kept} others: background here ({reasons}), "
            "as this format cannot store them"
        )
    write_text(out / "data.yaml", _yaml(dataset, parts, chosen, flip))


def _findable(name: str) -> PurePosixPath:
    """Return a file's path below images/<part>/ that Ultralytics finds, with its labels.

    It searches labels where the last `/images/` of an image's path is `/labels/`, and skips hidden folders.
    """
    return PurePosixPath(*(f"{part}_" if part == "images" else part.lstrip(".") or "_" for part in name.split("/")))


def _indices(scheme: Scheme, names: Sequence[str]) -> list[int]:
    for name in names:
        if name not in scheme.names:
            raise UserError(
                f"--keypoints: {name!r} is not a keypoint of {scheme.name}; they are {', '.join(scheme.names)}"
            )
        if names.count(name) > 1:
            raise UserError(f"--keypoints: {name} is listed twice")
    return [scheme.names.index(name) for name in names] or list(range(K))


def _parts(dataset: Dataset, console: Console) -> dict[str, AnnotationFile]:
    """Return the splits; without a validation split, some of the training recordings, or their ends, become it."""
    parts = {split: dataset.read(split) for split in dataset.splits}
    if YOLO_SPLITS not in parts:
        raise UserError(f"{dataset.root}: has no split {YOLO_SPLITS}, which this format requires")
    for split, file in parts.items():
        if file.categories != parts[YOLO_SPLITS].categories:
            raise UserError(
                f"{dataset.root}: {split}: labels {', '.join(file.categories)}, split {YOLO_SPLITS} labels "
                f"{', '.join(parts[YOLO_SPLITS].categories)}: this format has one list of classes"
            )
    if VAL not in parts:
        whole = parts[YOLO_SPLITS]
        parts[YOLO_SPLITS], parts[VAL] = held_back(whole, VALIDATION_SHARE)
        between = len(whole.images) - len(parts[YOLO_SPLITS].images) - len(parts[VAL].images)
        if not parts[VAL].images:
            raise UserError(
                f"{dataset.root}: its recordings are too short to keep the last {VALIDATION_SHARE:.0%} for val: "
                "generate more frames"
            )
        count = counted(len(parts[VAL].images), "image")
        gap = f"; left out, too similar to both: {between}" if between else ""
        console.say(f"{VAL}, the end of {YOLO_SPLITS}'s recordings: {count}{gap}")
    return parts


def _row(label: Annotation | RoadUser, image: Image, chosen: Sequence[int], categories: Sequence[str]) -> str:
    size = np.array([image.width, image.height], dtype=np.float64)
    box = label.bbox
    numbers = [*((box[:2] + box[2:] / 2) / size), *(box[2:] / size)]
    cells = [f"{number:.6f}" for number in numbers]
    points = label.keypoints if isinstance(label, Annotation) else np.zeros((K, 3))
    for x, y, v in points[list(chosen)]:
        cells += [f"{x / size[0]:.6f}", f"{y / size[1]:.6f}", f"{v:.0f}"]
    number = 0 if isinstance(label, Annotation) else categories.index(label.category)
    return f"{number} {' '.join(cells)}\n"


def _flip(scheme: Scheme, chosen: Sequence[int]) -> list[int] | None:
    """Return the index, among the `chosen` keypoints, of each keypoint's mirror partner.

    None if a partner is missing.
    """
    if scheme.flip is None:
        return None
    partners = [scheme.flip[i] for i in chosen]
    return [chosen.index(i) for i in partners] if set(partners) == set(chosen) else None


def _yaml(
    dataset: Dataset, parts: Mapping[str, AnnotationFile], chosen: Sequence[int], flip: Sequence[int] | None
) -> str:
    test_parts = [name for name in parts if name not in (YOLO_SPLITS, VAL)]
    categories = parts[YOLO_SPLITS].categories
    lines = [
        f"# Paths are relative to this file. Licence: {dataset.licence}",
        f"train: images/{YOLO_SPLITS}",
        f"val: images/{VAL}",
        *([f"test: [{', '.join(f'images/{name}' for name in test_parts)}]"] if test_parts else []),
        f"kpt_shape: [{len(chosen)}, 3]",
        *([f"flip_idx: {list(flip)}"] if flip is not None else []),
        f"kpt_oks_sigmas: {[dataset.scheme.sigmas[i] for i in chosen]}",
        "names:",
        *(f"  {number}: {name}" for number, name in enumerate(categories)),
        "kpt_names:",
        "  0:",
        *(f"    - {dataset.scheme.names[i]}" for i in chosen),
    ]
    return "\n".join(lines) + "\n"
