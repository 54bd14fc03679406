"""Annotation files to import, and their images.

The module finds the files, derives splits and licences from names, and finds the images with their orientation, camera
and recording.
"""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from skope import schema
from skope.dataset import coco
from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.dataset.picture_headers import PictureHeader, read_header
from skope.errors import UserError
from skope.files.json_files import parse_json, read_json
from skope.gen.formats import file_name_rules
from skope.gen.formats.coco_write import CVAT_START
from skope.gen.formats.dataset_builder import LICENCE_FILE, SPLIT_NAME, Remarks, bare_name
from skope.gen.formats.file_name_rules import Place
from skope.gen.formats.source_files import Files, files_at, first
from skope.gen.output import licences
from skope.schema import Image, Result
from skope.terminal.console import Console, counted

_ANNOTATION_FOLDER: Final = "annotations"
_VISIBLE_FROM: Final = 0.5
"""Minimum probability of a predicted keypoint that counts as visible."""
_LICENCE_FILES: Final = (
    LICENCE_FILE,
    *(f"{name}{end}" for name in ("LICENSE", "LICENCE") for end in (".txt", "", ".md")),
)


@dataclass(frozen=True)
class AnnotationSource:
    """Annotation file of another program with the folders of its images."""

    path: str
    """Path, used only in messages."""
    name: str
    """Name of the file, used if its images do not specify their recording."""
    document: Mapping[str, Any]
    split: str
    image_folders: tuple[str, ...]
    """Candidate folders of its images among the `Files`, most likely first; each ends in a slash or is empty."""
    licence: str

    @property
    def ours(self) -> bool:
        """Whether fields beyond COCO's have skope's meaning."""
        info = self.document.get("info")
        return isinstance(info, dict) and "keypoint_scheme" in info


def open_source(source: Path) -> AbstractContextManager[Files]:
    """Open the files below a folder or in an archive; for an annotation file, those below the folder above it."""
    return files_at(source.absolute().parent if _alone(source) else source)


def annotation_sources(
    source: Path, files: Files, form: str, split: str | None, console: Console
) -> Iterator[AnnotationSource]:
    """Read the annotation files of a source.

    In a folder or archive they are in `annotations/`. Otherwise they are directly in the folder, or in the folders
    directly below it.

    Args:
        source: An annotation file, a folder or an archive.
        files: The result of `open_source` for it.
        form: "coco" or "cvat".
        split: Split of all of them; None: derived from their names (see `file_name_rules.split_of`).
        console: Reports the origin of a split.

    Raises:
        UserError: There is none, or one is malformed.
    """
    if files.find(FRAMES_FILE) is not None and files.find(PREDICTIONS_FILE) is not None and not _alone(source):
        yield _predictions(source, split)
        return
    names = [source.name] if _alone(source) else _annotation_names(source, files, form)
    # No folders above the source: names are published, and must not show the user's folders.
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
            console.say(f"{where}: split {chosen}, from the name of its folder (--split overrides it)")
        elif by == "default":
            console.say(f"{where}: split {chosen}, because no name specifies one (--split overrides it)")
        elif by and chosen != stem:
            console.say(f"{where}: split {chosen}, from the name {stem} (--split overrides it)")
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
    """Return whether a source is one annotation file; its folder may be beside the folder of the images."""
    return source.suffix.lower() == ".json"


def _annotation_names(source: Path, files: Files, form: str) -> list[str]:
    start = CVAT_START if form == "cvat" else ""
    for folders in ([_ANNOTATION_FOLDER], [""], files.folders()):
        found = [name for folder in folders for name in files.names(folder, ".json")]
        names = [name for name in found if PurePosixPath(name).name.startswith(start)]
        if names:
            return names
    raise UserError(
        f"{source}: has no {_ANNOTATION_FOLDER}/{start}*.json, nor such a file directly in it or in a folder below"
    )


def _image_folders(inside: Sequence[str], stem: str, *, alone: bool) -> tuple[str, ...]:
    """Return candidate folders of images.

    A subset's own folder is first, since subsets may have images of equal names.
    """
    subset_folder = "/".join(inside)
    bare = file_name_rules.bare_stem(stem)
    near = [f"images/{stem}/", f"{stem}/", f"images/{bare}/", f"{bare}/", "", "images/"]
    if subset_folder and subset_folder != _ANNOTATION_FOLDER:
        near = [f"{subset_folder}/", f"{subset_folder}/images/", *near]
    return tuple(dict.fromkeys([*near, *(f"../{folder}" for folder in near if alone)]))


def _licence(files: Files, document: Mapping[str, Any], *, alone: bool) -> str:
    """Return all licences that a file and the text beside it state."""
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
            raise UserError(f"{where}: field {key}: duplicate id")
    for i, row in enumerate(document["images"]):
        if not isinstance(row.get("file_name"), str):
            raise UserError(f"{where}: images[{i}]: file_name: expected text, got {row.get('file_name')!r:.60}")
    return document


def _predictions(folder: Path, split: str | None) -> AnnotationSource:
    """Return results of `skope eval predict` as a COCO document.

    Keypoints with a probability of at least 0.5 are visible.
    """
    frames = coco.read(folder / FRAMES_FILE)
    rows, categories = [], dict.fromkeys(frames.categories)
    for number, result in enumerate(coco.iter_all_results(folder / PREDICTIONS_FILE), start=1):
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
        path=str(folder / PREDICTIONS_FILE),
        name=file_name_rules.source_name([folder.resolve().name]),
        document=document,
        split=split or "train",
        image_folders=("", "images/"),
        licence=licences.NOT_STATED,
    )


@dataclass(frozen=True)
class ImageSource:
    """Image of an annotation file that was found."""

    row: Mapping[str, Any]
    where: str
    """File and record, used only in messages."""
    name: str
    """Name with forward slashes, relative to some folder."""
    path: str
    """Path among the `Files`."""


@dataclass(frozen=True)
class ImportedImage:
    """Record of an image in the new dataset, with its sources."""

    record: Image
    contents: Mapping[str, Path | bytes]
    """Contents of its files by their new names."""
    turned: PictureHeader | None
    """Header of the image if labels are in stored pixels that EXIF rotates; else None."""


@dataclass
class ImageImporter:
    """Finds the images of annotation files, and assigns names, sites and recordings in the new dataset."""

    given: Files | None
    """Folder with the images, if they are not beside the annotations."""
    stored_pixels: bool
    """Whether labels are in the stored pixels of the files, before EXIF rotates the image."""
    remarks: Remarks
    _names: set[str] = field(default_factory=set)
    _recordings: dict[tuple[str | None, str], tuple[Any, ...]] = field(default_factory=dict)
    """Site and name of each recording, with the file and the film of the recording."""
    _splits: dict[str, str] = field(default_factory=dict)
    """Split of each image."""

    def images(self, file: AnnotationSource, files: Files, console: Console) -> Iterator[tuple[int, ImportedImage]]:
        """Yield the images of an annotation file in `files`, each with its id there.

        Raises:
            UserError: An image is missing or listed twice, or its size differs from that of its file.
        """
        found = self._locate(file, files)
        places = file_name_rules.places([source.name for source in found])
        _tell_places(file, found, places, console)
        for source, place in zip(console.bar(found, unit="image", label=file.split), places, strict=True):
            yield source.row["id"], self._image(source, place, file, files)

    def _locate(self, file: AnnotationSource, files: Files) -> list[ImageSource]:
        among = self.given or files
        out: list[ImageSource] = []
        taken: dict[str, str] = {}
        for i, row in enumerate(file.document["images"]):
            where, stated = f"{file.path}: images[{i}]", row["file_name"]
            name = file_name_rules.slashed(stated)
            ending, path = self._looked_up(among, file, name)
            if not path:
                raise UserError(f"{where}: file_name: {self._not_found(stated, name, among)}")
            if path in taken:
                detail = "" if taken[path] == stated else f" ({path} is {taken[path]} too)"
                raise UserError(f"{where}: file_name: {stated} is a duplicate{detail}")
            taken[path] = stated
            if ending != name:
                self.remarks.add("image", "found by the end of the name", f"{stated} as {ending}")
            elif name != stated:
                self.remarks.add("file name", "read as a path with forward slashes", f"{stated} as {name}")
            out.append(ImageSource(row, where, ending, path))
        return out

    def _looked_up(self, among: Files, file: AnnotationSource, name: str) -> tuple[str, str]:
        """Find the file for a name: return the longest matching end of the name, and the file's path.

        Without --images the whole name.
        """
        folders = ("",) if self.given else file.image_folders
        endings = file_name_rules.endings(name)
        for ending in endings if self.given else [e for e in endings if e == name]:
            for folder in folders:
                if among.has(f"{folder}{ending}"):
                    return ending, f"{folder}{ending}"
        return "", ""

    def _not_found(self, stated: str, name: str, among: Files) -> str:
        if self.given:
            return f"no {stated} in {among.where}"
        if name not in file_name_rules.endings(name):
            return (
                f"{stated!r:.80} is not a path inside a folder; give the folder of the images with --images, where "
                "images are found by the ends of their names"
            )
        return f"no {stated} in {among.where}, nor below its images/; give the folder of the images with --images"

    def _image(self, source: ImageSource, place: Place, file: AnnotationSource, files: Files) -> ImportedImage:
        row = (
            {**source.row}
            if file.ours
            else {name: source.row[name] for name in ("id", "width", "height") if name in source.row}
        )
        if not (file.ours and row.get("site") is not None):
            row |= {"site": place.site, "recording": self._recording(place, file), "frame_index": place.frame}
        with telling(source.where):
            image = coco.image_from_dict({**row, "file_name": source.name})
        content = (self.given or files).find(source.path)
        if content is None:
            raise UserError(f"{source.where}: file_name: no {source.path}")
        header = read_header(content)
        turned = None
        if header is not None:
            image = self._checked(source.where, image, header, ours=file.ours)
            turned = header if header.turned and self.stored_pixels else None
        if isinstance(content, Path):
            first_split = self._splits.setdefault(str(content), file.split)
            if first_split != file.split:
                self.remarks.add("image", f"in split {file.split} and in {first_split}", source.where)
        name = self._free_name(bare_name(source.name), file)
        contents: dict[str, Path | bytes] = {name: content}
        depth = None
        if image.depth_file_name is not None:
            found = first(files, [f"{folder}{image.depth_file_name}" for folder in ("", "../")])
            if found is not None:
                depth = f"depth/{bare_name(image.depth_file_name)}"
                contents[depth] = found
        return ImportedImage(replace(image, file_name=name, depth_file_name=depth), contents, turned)

    def _checked(self, where: str, image: Image, header: PictureHeader, *, ours: bool) -> Image:
        """Return the image with the size of its file as shown; a record with a different size is kept and reported."""
        stated = image.width, image.height
        if self.stored_pixels and header.turned and ours:
            raise UserError(
                f"{where}: --stored-pixels: labels of skope's own files are in the pixels of the image as shown"
            )
        expected, alternative = header.shown, header.stored
        if self.stored_pixels:
            expected, alternative = alternative, expected
        if stated not in (expected, alternative):
            self.remarks.add("picture", "of another size than the file states (`skope gen check` lists them)", where)
            return image
        if stated != expected:
            kind, flag = ("shown", "without") if self.stored_pixels else ("stored, before the EXIF rotation", "with")
            raise UserError(
                f"{where}: width, height: {stated[0]}x{stated[1]} is the size of the image as {kind}; "
                f"import the file {flag} --stored-pixels"
            )
        if header.turned:
            reading = "stored, and rotated with it" if self.stored_pixels else "shown (--stored-pixels: as stored)"
            self.remarks.add(
                "picture", f"rotated by EXIF: labels are read in the pixels of the picture as {reading}", where
            )
        return replace(image, width=header.shown[0], height=header.shown[1])

    def _recording(self, place: Place, file: AnnotationSource) -> str:
        """Return the name of an image's recording, unique to its file: each file numbers its tracks separately."""
        owner = file.path, place.film
        wanted = place.recording or file.name
        number, name = 1, wanted
        while self._recordings.setdefault((place.site, name), owner) != owner:
            number += 1
            name = f"{wanted}_{number}"
        return name

    def _free_name(self, bare: str, file: AnnotationSource) -> str:
        """Return an unused name for an image in the dataset."""
        number, name = 1, f"images/{bare}"
        while name in self._names:
            folder = file.split if number == 1 else f"{file.split}_{number}"
            number, name = number + 1, f"images/{folder}/{bare}"
        self._names.add(name)
        return name


def _tell_places(
    file: AnnotationSource, found: Sequence[ImageSource], places: Sequence[Place], console: Console
) -> None:
    """Report the cameras and recordings that were derived from file names, if the file does not give them."""
    guessed = [place for source, place in zip(found, places, strict=True) if not (file.ours and source.row.get("site"))]
    sites = [*dict.fromkeys(place.site for place in guessed if place.site is not None)]
    if sites:
        shown = ", ".join(sites[:3]) + (f" and {len(sites) - 3} more" if len(sites) > 3 else "")
        console.say(f"{file.path}: folders are read as cameras (sites): {shown}")
    films = {place.film for place in guessed if place.film is not None}
    if films:
        frames = sum(place.film is not None for place in guessed)
        console.say(
            f"{file.path}: {counted(frames, 'numbered image')} read as the frames of "
            f"{counted(len(films), 'recording')}, in the order of their numbers"
        )


@contextmanager
def telling(where: str) -> Iterator[None]:
    """Add the file and the record to error messages."""
    try:
        yield
    except KeyError as error:
        raise UserError(f"{where}: field {error.args[0]} is missing") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{where}: {error}") from None
