"""Datasets made of COCO keypoints files of any program, of CVAT's archives, and of predictions.

Keypoints are taken by name, in any order and number: what a file does not have is unlabelled (v = 0).
"""

import itertools
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from skope import coco, keypoints, schema
from skope.boxes import area, clip, xywh_to_xyxy, xyxy_to_xywh
from skope.console import Console
from skope.dataset import FRAMES, PREDICTIONS
from skope.errors import UserError
from skope.files import read_json
from skope.gen.formats.coco_write import CVAT_START, UNSAID
from skope.gen.formats.dataset_builder import (
    LICENCE_FILE,
    SPLIT_NAME,
    bare_name,
    finish_dataset,
    labelled_frame,
)
from skope.gen.formats.source_files import Files, InFolder, files_at
from skope.gen.output.writers import FolderWriter
from skope.keypoints import SKOPE33, K, Scheme
from skope.schema import Annotation, Image

_DEFAULT: Final = "default"
"""CVAT's subset of images that are in none."""
_SITE: Final = re.compile(r"(?:.*/)?([^/.][^/]*)/([^/.][^/]*)_(\d{1,9})\.\w+")
_SURE: Final = 0.5
"""A predicted keypoint of this probability counts as visible."""


@dataclass(frozen=True)
class _File:
    """One annotation file, with where its images are looked for."""

    path: str
    document: Mapping[str, Any]
    split: str
    subset: str
    beside: bool
    """Whether its images may lie beside its folder, as they do in a dataset's."""

    @property
    def ours(self) -> bool:
        """Whether fields beyond COCO's mean what ours do."""
        info = self.document.get("info")
        return isinstance(info, dict) and "keypoint_scheme" in info


@dataclass(frozen=True)
class _Label:
    """Keypoints of one category: where each of them goes."""

    scheme: Scheme
    count: int
    columns: tuple[int, ...]
    """In the file ..."""
    places: tuple[int, ...]
    """... and in the scheme."""


def read(
    sources: Sequence[Path],
    root: Path,
    *,
    form: str,
    images: Path | None,
    split: str | None,
    command: str,
    console: Console,
) -> None:
    """Make a dataset from COCO keypoints files, folders with such files, or CVAT archives.

    Args:
        sources: Annotation files, folders with `annotations/`, or archives.
        root: Folder of the new dataset.
        form: "coco" or "cvat".
        images: Folder that image names are relative to. Default: the folders beside the annotation files.
        split: Split that all images go to. Default: the name of the annotation file; "train" for CVAT's default subset.
        command: Command line for the card.
        console: Where progress is shown, and what was left out.

    Raises:
        UserError: A source cannot be read, has no keypoints of a known scheme, or another scheme or licence than the
            others.
    """
    if images is not None and not images.is_dir():
        raise UserError(f"--images: {images}: no such folder")
    work = _Import(root, InFolder(images) if images else None, console)
    licences = set()
    for source in sources:
        with _open_source(source) as files:
            licences.add(_licence(files, beside=_beside(source)))
            for file in _annotation_files(source, files, form, split):
                work.add(file, files)
    for what, count in work.left_out.items():
        console.say(f"left out: {count} annotations {what}")
    if len(licences) > 1:
        raise UserError(f"files under different licences ({'; '.join(sorted(licences))}): read them apart")
    rules = ["Boxes and keypoints are those of the files read; a keypoint that they do not have is unlabelled (v = 0)."]
    assert work.writer is not None  # a source without an annotation file was refused
    finish_dataset(work.writer, command=command, licence=licences.pop(), label_rules=rules)


@dataclass
class _Import:
    """The dataset under construction, while annotation files are read one after the other."""

    root: Path
    given: Files | None
    """Folder or archive with the images, if they do not lie beside the annotations."""
    console: Console
    writer: FolderWriter | None = None
    left_out: Counter[str] = field(default_factory=Counter)
    """Number of annotations that were left out, by reason."""
    _names: set[str] = field(default_factory=set)

    def add(self, file: _File, files: Files) -> None:
        """Take the images and vehicles of an annotation file, which lies among `files`."""
        labels = _labels(file, self.console)
        scheme = next(iter(labels.values())).scheme
        if self.writer is None:
            self.writer = FolderWriter(self.root, scheme)
        if scheme is not self.writer.scheme:
            raise UserError(
                f"{file.path}: has keypoints of scheme {scheme.name}, the others of {self.writer.scheme.name}"
            )
        own: dict[int, list[tuple[int, Mapping[str, Any]]]] = {row["id"]: [] for row in file.document["images"]}
        for i, row in enumerate(file.document["annotations"]):
            if row["image_id"] not in own:
                raise UserError(f"{file.path}: annotations[{i}]: image_id {row['image_id']} is not among the images")
            own[row["image_id"]].append((i, row))
        called = {category["id"]: str(category.get("name")) for category in file.document["categories"]}
        named: set[str] = set()
        for i, row in enumerate(self.console.bar(file.document["images"], unit="image", label=file.split)):
            image, contents = self._image(f"{file.path}: images[{i}]", row, file, files)
            if row["file_name"] in named:
                raise UserError(f"{file.path}: images[{i}]: file_name: {row['file_name']} stands twice")
            named.add(row["file_name"])
            vehicles = []
            for k, annotation in own[row["id"]]:
                label = labels.get(annotation["category_id"])
                if label is None:
                    name = called.get(annotation["category_id"], "no category")
                    self.left_out[f"of {name}, which has no keypoint of ours"] += 1
                    continue
                vehicle = _annotation(f"{file.path}: annotations[{k}]", annotation, label, image, file.ours)
                if vehicle is None:
                    self.left_out["whose box has no area inside the image"] += 1
                else:
                    vehicles.append(vehicle)
            self.writer.add(file.split, [labelled_frame(file.split, image, vehicles, contents)])

    def _image(
        self, where: str, row: Mapping[str, Any], file: _File, files: Files
    ) -> tuple[Image, dict[str, Path | bytes]]:
        """An image, and its files by their new names."""
        with _told(where):
            if not file.ours:
                row = {name: row[name] for name in ("id", "file_name", "width", "height")}
            image = coco.image_from_dict(row)
            match = _SITE.fullmatch(image.file_name)
            if image.site is None and match:
                place = {"site": match[1], "recording": match[2], "frame_index": int(match[3])}
                image = coco.image_from_dict({**place, **row})
        old = image.file_name
        candidates = (f"images/{bare_name(old)}", f"images/{file.split}/{bare_name(old)}")
        name = next((name for name in candidates if name not in self._names), None)
        if name is None:
            raise UserError(f"{where}: file_name: {old} stands twice")
        self._names.add(name)
        if self.given:
            content, there = self.given.find(old), str(self.given.where)
        else:
            # A subset's own folder first: another subset may have an image of the same name.
            below = [f"images/{file.subset}/{old}", old, f"images/{old}"]
            content, there = _first(files, below, file.beside), f"{files.where}, as itself or below images/"
        if content is None:
            raise UserError(f"{where}: file_name: no {old} in {there}; say with --images where images lie")
        contents = {name: content}
        depth = None
        if image.depth_file_name is not None:
            found = _first(files, [image.depth_file_name], file.beside)
            if found is not None:
                depth = f"depth/{bare_name(image.depth_file_name)}"
                contents[depth] = found
        return replace(image, file_name=name, depth_file_name=depth), contents


# --------------------------------------------------------------------------------------------------- annotation files


def _open_source(source: Path) -> AbstractContextManager[Files]:
    """Files below a folder or in an archive; of an annotation file those below the folder above it."""
    return files_at(source.absolute().parent if _beside(source) else source)


def _beside(source: Path) -> bool:
    """Whether a source is one annotation file, whose folder may lie beside that of the images."""
    return source.suffix == ".json"


def _licence(files: Files, *, beside: bool) -> str:
    found = _first(files, [LICENCE_FILE], beside)
    data = found.read_bytes() if isinstance(found, Path) else found
    return " ".join(data.decode(errors="replace").split()) if data else "not stated"


def _annotation_files(source: Path, files: Files, form: str, split: str | None) -> Iterator[_File]:
    if _beside(source):
        names = [source.name]
    elif files.find(FRAMES) and files.find(PREDICTIONS):
        document = _joined(source)
        yield _File(str(source / PREDICTIONS), document, split or "train", "", beside=False)
        return
    else:
        names = files.names("annotations", ".json")
        if form == "cvat":
            names = [name for name in names if PurePosixPath(name).name.startswith(CVAT_START)]
        if not names:
            start = CVAT_START if form == "cvat" else ""
            raise UserError(f"{source}: has no annotations/{start}*.json")
    for name in names:
        subset = PurePosixPath(name).stem.removeprefix(CVAT_START)
        where = f"{files.where}/{name}"
        chosen = split or ("train" if subset.lower() in (_DEFAULT, "instances_default") else subset)
        if not SPLIT_NAME.fullmatch(chosen):
            raise UserError(f"{where}: {chosen!r} cannot be the name of a split: give one with --split")
        yield _File(where, _parsed(where, files.find(name)), chosen, subset, _beside(source))


def _parsed(where: str, content: Path | bytes | None) -> Mapping[str, Any]:
    if content is None:
        raise UserError(f"{where}: no such file")
    try:
        document = read_json(content) if isinstance(content, Path) else json.loads(content)
    except ValueError as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{where}: not valid JSON: {error}") from None
    if not isinstance(document, dict):
        raise UserError(f"{where}: expected a COCO object with images and annotations")
    for key in ("images", "annotations", "categories"):
        rows = document.get(key)
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise UserError(f"{where}: field {key} is missing or not a list of objects")
        numbers = ("image_id", "category_id") if key == "annotations" else ("id",)
        for (i, row), name in itertools.product(enumerate(rows), numbers):
            if isinstance(row.get(name), bool) or not isinstance(row.get(name), int):
                raise UserError(f"{where}: {key}[{i}]: {name}: expected a whole number, got {row.get(name)!r}")
        if key != "annotations" and len({row["id"] for row in rows}) < len(rows):
            raise UserError(f"{where}: field {key}: two have the same id")
    return document


def _joined(folder: Path) -> dict[str, Any]:
    """Predictions of `skope eval predict` as a COCO document; keypoints are visible from a visibility of 0.5 on."""
    frames = coco.read(folder / FRAMES)
    rows = []
    for number, result in enumerate(coco.read_results(folder / PREDICTIONS), start=1):
        points = result.keypoints.copy()
        points[:, 2] = np.where(points[:, 2] >= _SURE, 2, 1)
        rows.append(
            {
                "id": number,
                "image_id": result.image_id,
                "category_id": schema.CATEGORY_ID,
                "bbox": result.bbox.tolist(),
                "keypoints": points.ravel().tolist(),
            }
        )
    return {
        "info": {"keypoint_scheme": frames.scheme.name},
        "images": [coco.image_to_dict(image) for image in frames.images],
        "annotations": rows,
        "categories": [schema.category(frames.scheme)],
    }


# ------------------------------------------------------------------------------------------------------------ records


def _labels(file: _File, console: Console) -> dict[int, _Label]:
    """Categories that have keypoints of one of skope's schemes, by their ids."""
    out: dict[int, _Label] = {}
    names_seen: list[str] = []
    for category in file.document["categories"]:
        stated = category.get("keypoints")
        names = [_name(name) for name in stated] if isinstance(stated, list) else []
        names_seen += names
        for scheme in keypoints.SCHEMES.values():
            known = [i for i, name in enumerate(names) if name in scheme.names]
            if not known:
                continue
            places = [scheme.names.index(names[i]) for i in known]
            if len(set(places)) < len(places):
                raise UserError(f"{file.path}: category {category.get('name')!r} has a keypoint twice")
            unknown = [name for name in names if name not in scheme.names]
            if unknown:
                console.say(f"{file.path}: left out keypoints that are not of {scheme.name}: {', '.join(unknown)}")
            if len(known) < K:
                console.say(f"{file.path}: {len(known)} of the {K} keypoints of {scheme.name}; the rest is unlabelled")
            out[category["id"]] = _Label(scheme, len(names), tuple(known), tuple(places))
    if not out:
        found = f"its keypoints are {', '.join(names_seen[:5])} ..." if names_seen else "it has none"
        raise UserError(f"{file.path}: categories: no keypoint has a name of {SKOPE33.name}: {found}")
    if len({label.scheme.name for label in out.values()}) > 1:
        raise UserError(f"{file.path}: categories: keypoints of two schemes")
    return out


def _name(name: object) -> str:
    return re.sub(r"[\s-]+", "_", str(name).strip().lower())


def _first(files: Files, names: Sequence[str], beside: bool) -> Path | bytes | None:
    """The first file there is among the folder's, and then, where that is wanted, among those of the folder above."""
    looked = [*names, *(f"../{name}" for name in names if beside)]
    return next((found for name in looked if (found := files.find(name)) is not None), None)


def _annotation(where: str, row: Mapping[str, Any], label: _Label, image: Image, ours: bool) -> Annotation | None:
    """None for a vehicle whose box, which is cut to the image, has no area: nothing can be learnt or found there."""
    with _told(where):
        theirs = schema.array("keypoints", row.get("keypoints") or [0] * (3 * label.count), label.count, 3)
        points = np.zeros((K, 3))
        points[list(label.places)] = theirs[list(label.columns)]
        inside = ((points[:, :2] >= 0) & (points[:, :2] < [image.width, image.height])).all(axis=1)
        points[~inside | (points[:, 2] <= 0)] = 0
        fields = {name: row[name] for name in ("id", "image_id", "iscrowd", "area") if row.get(name) is not None}
        box = row.get("bbox")
        if not box or not any(box):
            if not points[:, 2].any():
                raise UserError("bbox: missing, and no keypoint is labelled")
            known = points[points[:, 2] > 0, :2]
            box = xyxy_to_xywh(np.concatenate([known.min(axis=0), known.max(axis=0)]))
        told = _attributes(row.get("attributes"))
        if told.get("ignore_reason"):
            told["iscrowd"] = 1
        fields = {**(row if ours else fields), **told, "bbox": box, "keypoints": points}
        fields["category_id"] = schema.CATEGORY_ID
        vehicle = coco.annotation_from_dict(fields)
        corners = xywh_to_xyxy(vehicle.bbox)
        cut = clip(corners, image.width, image.height)
        size = float(area(cut))
        if size <= 0:
            return None
        if (cut != corners).any():
            vehicle = replace(vehicle, bbox=xyxy_to_xywh(cut), area=min(vehicle.area, size))
        return vehicle


@contextmanager
def _told(where: str) -> Iterator[None]:
    """Name the file and the record in what is wrong with it."""
    try:
        yield
    except KeyError as error:
        raise UserError(f"{where}: field {error.args[0]} is missing") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{where}: {error}") from None


def _attributes(values: object) -> dict[str, Any]:
    """What CVAT's attributes say; what is empty, or not in our lists, is not taken."""
    given = values if isinstance(values, dict) else {}
    out: dict[str, Any] = {}
    lists = {"vehicle_type": schema.VEHICLE_TYPES, "color": schema.COLORS, "ignore_reason": schema.IGNORE_REASONS}
    for name, choices in lists.items():
        if given.get(name) in choices:
            out[name] = given[name]
    if given.get("model", "") not in ("", UNSAID):
        out["model"] = str(given["model"])
    if re.fullmatch(r"\d{1,18}", str(given.get("track_id", ""))):
        out["track_id"] = int(given["track_id"])
    return out
