"""COCO keypoints files, of any program, and CVAT's archives of them.

COCO: `annotations/<split>.json` beside `images/`, as in a dataset folder, with everything that we know in extra fields.
CVAT ("COCO Keypoints 1.0"): `annotations/person_keypoints_<subset>.json`, `images/<subset>/<file name>`; what its
labels can carry besides points are attributes, of which `track_id` is the one that its own tracks use.

Reading takes the keypoints by name, in any order and number: what a file does not have is unlabelled (v = 0).
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from skope import coco, keypoints, schema
from skope.boxes import xyxy_to_xywh
from skope.console import Console
from skope.dataset import FRAMES, PREDICTIONS, Dataset
from skope.errors import UserError
from skope.files import read_json, write_text
from skope.gen.formats.files import Files, InFolder, files_at
from skope.gen.formats.gather import LICENCE_FILE, SPLIT_NAME, Gathered, plain, put
from skope.keypoints import SKOPE33, K, Scheme
from skope.schema import Annotation, Image

CVAT_START: Final = "person_keypoints_"
_ATTRIBUTES: Final = ("track_id", "model", "vehicle_type", "color", "ignore_reason")
"""Fields that CVAT holds as attributes."""
_UNSAID: Final = "-"
"""An attribute of CVAT's that nobody has set."""
_DEFAULT: Final = "default"
"""CVAT's subset of images that are in none."""
_SITE: Final = re.compile(r"(?:.*/)?([^/]+)/([^/]+)_(\d{1,9})\.\w+")
_SURE: Final = 0.5
"""A predicted keypoint of this probability counts as visible."""


# ------------------------------------------------------------------------------------------------------------- writing


def write(dataset: Dataset, out: Path, console: Console) -> None:
    """A dataset's images, depth and annotation files alone; the files are linked where the file system can."""
    for split in console.bar(dataset.splits, unit="split", label="writing coco"):
        file = dataset.read(split)
        rows = []
        for image in file.images:
            row = coco.image_to_dict(image)
            for key, kind in (("file_name", "images"), ("depth_file_name", "depth")):
                if key in row:
                    name = f"{kind}/{plain(row[key])}"
                    put(dataset.root / row[key], out / name)
                    row[key] = name
            rows.append(row)
        annotations = [coco.annotation_to_dict(a) for a in file.annotations]
        coco.write_rows(out / "annotations" / f"{split}.json", {"split": split}, rows, annotations, file.scheme)


def write_cvat(dataset: Dataset, out: Path, console: Console) -> None:
    """An archive's files. Masks are left out: CVAT would show them as shapes of their own."""
    for split in console.bar(dataset.splits, unit="split", label="writing cvat"):
        file = dataset.read(split)
        rows = []
        for image in file.images:
            name = plain(image.file_name)
            put(dataset.root / image.file_name, out / "images" / split / name)
            row = coco.image_to_dict(image)
            row.pop("depth_file_name", None)
            rows.append({**row, "file_name": name})
        annotations = [_cvat_row(annotation) for annotation in file.annotations]
        path = out / "annotations" / f"{CVAT_START}{split}.json"
        coco.write_rows(path, {"split": split}, rows, annotations, file.scheme)
    write_text(out / "labels.json", json.dumps(cvat_labels(dataset.scheme), indent=1) + "\n")


def _cvat_row(annotation: Annotation) -> dict[str, Any]:
    row = coco.annotation_to_dict(annotation)
    attributes = {name: row.pop(name) for name in _ATTRIBUTES if name in row}
    box = annotation.bbox
    kept = {name: row[name] for name in ("id", "image_id", "category_id", "bbox", "keypoints", "num_keypoints")}
    # Its crowds are masks without points: an ignored vehicle is an ordinary one with a reason.
    return {**kept, "area": float(box[2] * box[3]), "iscrowd": 0, "segmentation": [], "attributes": attributes}


def cvat_labels(scheme: Scheme) -> list[dict[str, Any]]:
    """What CVAT's "raw" editor of labels takes for a task: the skeleton, drawn in a square of 100, and attributes."""
    side = 6
    places = [(10 + 16 * (i % side), 10 + 16 * (i // side)) for i in range(K)]
    lines = [
        f'<line x1="{places[a][0]}" y1="{places[a][1]}" x2="{places[b][0]}" y2="{places[b][1]}" data-type="edge" '
        f'data-node-from="{a + 1}" data-node-to="{b + 1}"></line>'
        for a, b in scheme.skeleton
    ]
    nodes = [
        f'<circle r="1.5" cx="{x}" cy="{y}" data-type="element node" data-element-id="{i}" data-node-id="{i}" '
        f'data-label-name="{name}"></circle>'
        for i, (name, (x, y)) in enumerate(zip(scheme.names, places, strict=True), start=1)
    ]

    def attribute(name: str, kind: str, values: Sequence[str]) -> dict[str, Any]:
        return {"name": name, "mutable": False, "input_type": kind, "default_value": values[0], "values": list(values)}

    return [
        {
            "name": schema.category()["name"],
            "type": "skeleton",
            "attributes": [
                attribute("model", "text", [_UNSAID]),
                attribute("vehicle_type", "select", [_UNSAID, *schema.VEHICLE_TYPES]),
                attribute("color", "select", [_UNSAID, *schema.COLORS]),
                attribute("ignore_reason", "select", [_UNSAID, *schema.IGNORE_REASONS]),
            ],
            "svg": "".join([*lines, *nodes]),
            "sublabels": [{"name": name, "type": "points", "attributes": []} for name in scheme.names],
        }
    ]


# ------------------------------------------------------------------------------------------------------------- reading


@dataclass(frozen=True)
class _File:
    """One annotation file, with where its images are looked for."""

    path: str
    document: Mapping[str, Any]
    split: str
    subset: str


@dataclass(frozen=True)
class _Label:
    """One category: where each of its keypoints goes."""

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
    """Make a dataset at `root` of COCO files, of dataset-like folders or CVAT's archives (`form` is cvat).

    A split is called like the annotation file, CVAT's subset of no name train; `split` takes all. `images` is a folder
    that file names are relative to, in place of the usual ones.
    """
    gathered: Gathered | None = None
    left_out: Counter[str] = Counter()
    seen: set[str] = set()
    licences = set()
    for source in sources:
        with _opened(source) as files:
            licences.add(_licence(files))
            for file in _annotation_files(source, files, form, split):
                labels = _labels(file, console)
                scheme = next(iter(labels.values())).scheme
                if gathered is None:
                    gathered = Gathered(root, scheme)
                if scheme is not gathered.scheme:
                    raise UserError(
                        f"{file.path}: has keypoints of scheme {scheme.name}, the others of {gathered.scheme.name}"
                    )
                left_out += _gather(file, labels, files, InFolder(images) if images else None, gathered, seen, console)
    if gathered is None:
        raise UserError(f"{', '.join(map(str, sources))}: no annotation file there")
    for name, count in left_out.items():
        console.say(f"left out: {count} annotations of {name}, which has no keypoint of ours")
    if len(licences) > 1:
        raise UserError(f"files under different licences ({'; '.join(sorted(licences))}): read them apart")
    rules = ["Boxes and keypoints are those of the files read; a keypoint that they do not have is unlabelled (v = 0)."]
    gathered.finish(command=command, licence=licences.pop(), label_rules=rules)


def _opened(source: Path) -> AbstractContextManager[Files]:
    """Files below a folder or in an archive; of an annotation file those below the folder above it."""
    return files_at(source.absolute().parent if source.suffix == ".json" else source)


def _licence(files: Files) -> str:
    found = files.find(LICENCE_FILE) or files.find(f"../{LICENCE_FILE}")
    data = found.read_bytes() if isinstance(found, Path) else found
    return " ".join(data.decode(errors="replace").split()) if data else "not stated"


def _annotation_files(source: Path, files: Files, form: str, split: str | None) -> Iterator[_File]:
    if source.suffix == ".json":
        names = [source.name]
    elif files.find(FRAMES) and files.find(PREDICTIONS):
        document = _joined(source)
        yield _File(str(source / PREDICTIONS), document, split or "train", "")
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
        yield _File(where, _parsed(where, files.find(name)), chosen, subset)


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
    return document


def _joined(folder: Path) -> dict[str, Any]:
    """What `skope eval predict` wrote, as annotations: points are visible from an even chance on."""
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


def _labels(file: _File, console: Console) -> dict[Any, _Label]:
    """By category id, those categories that have keypoints of one of our schemes."""
    out: dict[Any, _Label] = {}
    names_seen: list[str] = []
    for category in file.document["categories"]:
        names = [_name(name) for name in category.get("keypoints") or []]
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
            out[category.get("id")] = _Label(scheme, len(names), tuple(known), tuple(places))
    if not out:
        found = f"its keypoints are {', '.join(names_seen[:5])} ..." if names_seen else "it has none"
        raise UserError(f"{file.path}: categories: no keypoint has a name of {SKOPE33.name}: {found}")
    if len({label.scheme.name for label in out.values()}) > 1:
        raise UserError(f"{file.path}: categories: keypoints of two schemes")
    return out


def _name(name: object) -> str:
    return re.sub(r"[\s-]+", "_", str(name).strip().lower())


def _gather(
    file: _File,
    labels: Mapping[Any, _Label],
    files: Files,
    images: Files | None,
    gathered: Gathered,
    seen: set[str],
    console: Console,
) -> Counter[str]:
    """Add a file's images and vehicles; how many annotations of other categories there were, by name."""
    document = file.document
    ours = "keypoint_scheme" in (document.get("info") or {})
    own: dict[Any, list[tuple[int, Mapping[str, Any]]]] = {row.get("id"): [] for row in document["images"]}
    for i, row in enumerate(document["annotations"]):
        if row.get("image_id") not in own:
            raise UserError(f"{file.path}: annotations[{i}]: image_id {row.get('image_id')!r} is not among the images")
        own[row["image_id"]].append((i, row))
    called = {category.get("id"): str(category.get("name")) for category in document["categories"]}
    left_out: Counter[str] = Counter()
    for i, row in enumerate(console.bar(document["images"], unit="image", label=file.split)):
        image, contents = _image(f"{file.path}: images[{i}]", row, file, files, images, ours, seen)
        vehicles = []
        for k, annotation in own[row["id"]]:
            if annotation.get("category_id") in labels:
                label = labels[annotation["category_id"]]
                vehicles.append(_annotation(f"{file.path}: annotations[{k}]", annotation, label, image, ours))
            else:
                left_out[called.get(annotation.get("category_id"), "no category")] += 1
        gathered.add(file.split, image, vehicles, contents)
    return left_out


def _image(
    where: str, row: Mapping[str, Any], file: _File, files: Files, given: Files | None, ours: bool, seen: set[str]
) -> tuple[Image, dict[str, Path | bytes]]:
    """An image with its files by their new names."""
    with _told(where):
        if not ours:
            row = {name: row[name] for name in ("id", "file_name", "width", "height")}
        image = coco.image_from_dict(row)
        match = _SITE.fullmatch(image.file_name)
        if image.site is None and match:
            place = {"site": match[1], "recording": match[2], "frame_index": int(match[3])}
            image = coco.image_from_dict({**place, **row})
    contents: dict[str, Path | bytes] = {}
    name = f"images/{plain(image.file_name)}"
    if name in seen:
        name = f"images/{file.split}/{plain(image.file_name)}"
    if name in seen:
        raise UserError(f"{where}: file_name: {image.file_name} stands twice")
    seen.add(name)
    looked = [image.file_name, f"images/{image.file_name}", f"images/{file.subset}/{image.file_name}"]
    looked += [f"../{looked[0]}", f"../{looked[1]}"] if isinstance(files, InFolder) else []
    content = _first(given, [image.file_name]) if given else _first(files, looked)
    if content is None:
        there = given.where if given else f"{files.where}, as itself or below images/"
        raise UserError(f"{where}: file_name: no {image.file_name} in {there}; say with --images where images lie")
    contents[name] = content
    depth = None
    if image.depth_file_name is not None:
        found = _first(files, [image.depth_file_name, f"../{image.depth_file_name}"])
        if found is not None:
            depth = f"depth/{plain(image.depth_file_name)}"
            contents[depth] = found
    return replace(image, file_name=name, depth_file_name=depth), contents


def _first(files: Files, names: Sequence[str]) -> Path | bytes | None:
    return next((found for name in names if (found := files.find(name)) is not None), None)


def _annotation(where: str, row: Mapping[str, Any], label: _Label, image: Image, ours: bool) -> Annotation:
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
        return coco.annotation_from_dict(fields)


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
    if given.get("model", "") not in ("", _UNSAID):
        out["model"] = str(given["model"])
    if re.fullmatch(r"\d{1,18}", str(given.get("track_id", ""))):
        out["track_id"] = int(given["track_id"])
    return out
