"""Annotation files to import: which there are, what they are of, and what their names say of splits and licences."""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from skope import schema
from skope.dataset import coco
from skope.dataset.folder import FRAMES, PREDICTIONS
from skope.errors import UserError
from skope.files.json_files import parse_json, read_json
from skope.gen.formats import file_name_rules
from skope.gen.formats.coco_write import CVAT_START
from skope.gen.formats.dataset_builder import LICENCE_FILE, SPLIT_NAME
from skope.gen.formats.source_files import Files, files_at, first
from skope.gen.output import licences
from skope.schema import Result
from skope.terminal.console import Console

_FOLDER: Final = "annotations"
_VISIBLE_FROM: Final = 0.5
"""A predicted keypoint of this probability counts as visible."""
_LICENCE_FILES: Final = (
    LICENCE_FILE,
    *(f"{name}{end}" for name in ("LICENSE", "LICENCE") for end in (".txt", "", ".md")),
)


@dataclass(frozen=True)
class AnnotationSource:
    """One annotation file of somebody's, read, with where its images are looked for."""

    path: str
    """For messages."""
    name: str
    """Its name where its images do not say which recording they are of."""
    document: Mapping[str, Any]
    split: str
    image_folders: tuple[str, ...]
    """Places among the `Files` where its images may lie, the likeliest first; each ends in a slash or is empty."""
    licence: str

    @property
    def ours(self) -> bool:
        """Whether fields beyond COCO's mean what ours do."""
        info = self.document.get("info")
        return isinstance(info, dict) and "keypoint_scheme" in info


def open_source(source: Path) -> AbstractContextManager[Files]:
    """Files below a folder or in an archive; of an annotation file those below the folder above it."""
    return files_at(source.absolute().parent if _alone(source) else source)


def annotation_sources(
    source: Path, files: Files, form: str, split: str | None, console: Console
) -> Iterator[AnnotationSource]:
    """Read the annotation files of a source.

    In a folder or archive they lie in `annotations/`; without one, right in it; without one there either, in the
    folders right below.

    Args:
        source: An annotation file, a folder or an archive.
        files: What `open_source` gave for it.
        form: "coco" or "cvat".
        split: Split that all of them are of; None: what their names say (see `file_name_rules.split_of`).
        console: Where it is said what a split was taken from.

    Raises:
        UserError: There is none, or one is malformed.
    """
    if files.find(FRAMES) is not None and files.find(PREDICTIONS) is not None and not _alone(source):
        yield _predictions(source, split)
        return
    names = [source.name] if _alone(source) else _names(source, files, form)
    # No folders above the source: what it is called is published, and must not show how the user's disk is laid out.
    called = [] if _alone(source) else [source.resolve().with_suffix("" if source.is_file() else source.suffix).name]
    for name in names:
        where = f"{files.where}/{name}"
        stem = PurePosixPath(name).stem.removeprefix(CVAT_START)
        inside = PurePosixPath(name).parts[:-1]
        folders = [source.resolve().parent.name] if _alone(source) else [*reversed(inside)]
        chosen, by = (split, "") if split else file_name_rules.split_of(stem, folders)
        if not SPLIT_NAME.fullmatch(chosen):
            raise UserError(
                f"{where}: {chosen!r} cannot be the name of a split: rename the file, or read it alone with --split"
            )
        if by == "folder":
            console.say(f"{where}: split {chosen}, as its folder is called (--split gives another)")
        elif by == "default":
            console.say(f"{where}: split {chosen}, since no name says any (--split gives another)")
        elif by and chosen != stem:
            console.say(f"{where}: split {chosen}, as we call {stem} (--split gives another)")
        document = _parsed(where, files.find(name))
        yield AnnotationSource(
            path=where,
            name=file_name_rules.source_name([*called, *inside, stem]),
            document=document,
            split=chosen,
            image_folders=_image_folders(inside, stem, alone=_alone(source)),
            licence=_licence(files, document, alone=_alone(source)),
        )


def _alone(source: Path) -> bool:
    """Whether a source is one annotation file, whose folder may lie beside that of the images."""
    return source.suffix.lower() == ".json"


def _names(source: Path, files: Files, form: str) -> list[str]:
    start = CVAT_START if form == "cvat" else ""
    for folders in ([_FOLDER], [""], files.folders()):
        found = [name for folder in folders for name in files.names(folder, ".json")]
        names = [name for name in found if PurePosixPath(name).name.startswith(start)]
        if names:
            return names
    raise UserError(f"{source}: has no {_FOLDER}/{start}*.json, nor such a file right in it or a folder below")


def _image_folders(inside: Sequence[str], stem: str, *, alone: bool) -> tuple[str, ...]:
    """Places where images may lie: of a subset first its own folder, since others may have images of the same names."""
    own = "/".join(inside)
    bare = file_name_rules.bare_stem(stem)
    near = [f"images/{stem}/", f"{stem}/", f"images/{bare}/", f"{bare}/", "", "images/"]
    if own and own != _FOLDER:
        near = [f"{own}/", f"{own}/images/", *near]
    return tuple(dict.fromkeys([*near, *(f"../{folder}" for folder in near if alone)]))


def _licence(files: Files, document: Mapping[str, Any], *, alone: bool) -> str:
    """All licences that a file and the text beside it state."""
    names = [f"{up}{name}" for up in ("", *(("../",) if alone else ())) for name in _LICENCE_FILES]
    found = first(files, names)
    data = found.read_bytes() if isinstance(found, Path) else found
    beside = licences.in_text(data.decode(errors="replace")) if data else licences.NOT_STATED
    return licences.joint_licence([beside, *licences.in_coco(document)])


def _parsed(where: str, content: Path | bytes | None) -> Mapping[str, Any]:
    if content is None:
        raise UserError(f"{where}: no such file")
    try:
        document = read_json(content) if isinstance(content, Path) else parse_json(content)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{where}: not valid JSON: {error}") from None
    if not isinstance(document, dict):
        raise UserError(f"{where}: expected a COCO object with images and annotations")
    for key in ("images", "annotations", "categories"):
        rows = document.get(key)
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise UserError(f"{where}: field {key} is missing or not a list of objects")
        numbers = ("image_id", "category_id") if key == "annotations" else ("id",)
        for (i, row), name in itertools.product(enumerate(rows), numbers):
            if type(row.get(name)) is not int:
                raise UserError(f"{where}: {key}[{i}]: {name}: expected a whole number, got {row.get(name)!r}")
        if key != "annotations" and len({row["id"] for row in rows}) < len(rows):
            raise UserError(f"{where}: field {key}: two have the same id")
    for i, row in enumerate(document["images"]):
        if not isinstance(row.get("file_name"), str):
            raise UserError(f"{where}: images[{i}]: file_name: expected text, got {row.get('file_name')!r:.60}")
    return document


def _predictions(folder: Path, split: str | None) -> AnnotationSource:
    """Results of `skope eval predict` as a COCO document; keypoints are visible from a probability of 0.5 on."""
    frames = coco.read(folder / FRAMES)
    rows, categories = [], dict.fromkeys(frames.categories)
    for number, result in enumerate(coco.iter_all_results(folder / PREDICTIONS), start=1):
        row = {"id": number, "image_id": result.image_id, "bbox": result.bbox.tolist()}
        if isinstance(result, Result):
            points = result.keypoints.copy()
            points[:, 2] = np.where(points[:, 2] >= _VISIBLE_FROM, 2, 1)
            row |= {"category_id": schema.CATEGORY_ID, "keypoints": points.ravel().tolist()}
        else:
            row["category_id"] = result.category_id
            categories[result.category] = None
        rows.append(row)
    document = {
        "info": frames.scheme.fields(),
        "images": [coco.image_to_dict(image) for image in frames.images],
        "annotations": rows,
        "categories": schema.category_rows(schema.checked_categories(categories), frames.scheme),
    }
    return AnnotationSource(
        path=str(folder / PREDICTIONS),
        name=file_name_rules.source_name([folder.resolve().name]),
        document=document,
        split=split or "train",
        image_folders=("", "images/"),
        licence=licences.NOT_STATED,
    )
