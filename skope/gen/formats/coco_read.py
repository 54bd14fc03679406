"""Read datasets from COCO keypoints files of any program, from CVAT's archives, and from predictions.

Keypoints are matched by name, in any order and number. Keypoints that a file does not have are unlabelled (v = 0).
Assumptions and impossible values are reported.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from skope import keypoints, records, schema
from skope.boxes import area, clip, xywh_to_xyxy, xyxy_to_xywh
from skope.dataset import coco
from skope.errors import UserError
from skope.gen.formats.coco_sources import (
    AnnotationSource,
    ImageImporter,
    ImportedImage,
    annotation_sources,
    open_source,
    telling,
)
from skope.gen.formats.coco_write import UNSET_VALUE
from skope.gen.formats.dataset_builder import Remarks, finish_dataset, labelled_frame
from skope.gen.formats.source_files import Files, InFolder
from skope.gen.output.writers import FolderWriter
from skope.keypoints import SKOPE33, K, Scheme
from skope.schema import Annotation, Labelled, RoadUser
from skope.terminal.console import Console
from skope.types import Array


@dataclass(frozen=True)
class Label:
    """Keypoints of one category, and their indices in file and scheme."""

    scheme: Scheme
    count: int
    columns: tuple[int, ...]
    """Indices of the keypoints in the file."""
    places: tuple[int, ...]
    """Indices of the same keypoints in the scheme."""
    vehicle_type: str | None
    """Vehicle type with the category's name; None if there is none."""


def vehicle_categories(file: AnnotationSource, console: Console) -> dict[int, Label]:
    """Return the categories with keypoints of one of skope's schemes, by their ids.

    Unknown names and keypoints are reported.

    Raises:
        UserError: No category has such keypoints, two schemes are mixed, or a file of skope has an unknown scheme or
            edition.
    """
    if file.ours:
        try:
            keypoints.scheme_in(file.document["info"])
        except UserError as error:
            raise UserError(f"{file.path}: info.{error}") from None
    out: dict[int, Label] = {}
    names_seen: list[str] = []
    lost: list[str] = []
    for category in file.document["categories"]:
        stated = category.get("keypoints")
        names = [bare(name) for name in stated] if isinstance(stated, list) else []
        names_seen += names
        for scheme in keypoints.SCHEMES.values():
            known = [i for i, name in enumerate(names) if name in scheme.names]
            if not known:
                continue
            places = [scheme.names.index(names[i]) for i in known]
            if len(set(places)) < len(places):
                raise UserError(f"{file.path}: category {category.get('name')!r} has a duplicate keypoint")
            unknown = [name for name in names if name not in scheme.names]
            if unknown:
                console.say(f"{file.path}: left out keypoints that are not in {scheme.name}: {', '.join(unknown)}")
            if len(known) < K:
                console.say(f"{file.path}: {len(known)} of the {K} keypoints of {scheme.name}; the rest is unlabelled")
            called = bare(category.get("name"))
            vehicle_type = called if called in schema.VEHICLE_TYPES else None
            if vehicle_type is None:
                lost.append(str(category.get("name")))
            out[category["id"]] = Label(
                _scheme_of_marks(scheme, file), len(names), tuple(known), tuple(places), vehicle_type
            )
    if not out:
        found = f"its keypoints are {', '.join(names_seen[:5])} ..." if names_seen else "it has none"
        raise UserError(f"{file.path}: categories: no keypoint has a name of {SKOPE33.name}: {found}")
    if len({label.scheme.name for label in out.values()}) > 1:
        raise UserError(f"{file.path}: categories: keypoints of two schemes")
    if len(out) > 1 and lost:
        console.warn(
            f"{file.path}: classes {', '.join(lost)} become `{schema.category()['name']}`: they are not vehicle "
            f"types of skope ({', '.join(schema.VEHICLE_TYPES)})"
        )
    return out


def road_user_categories(file: AnnotationSource, console: Console) -> dict[int, str]:
    """Return the categories without keypoints that have names of skope's categories, by their ids in the file.

    For files of other programs this is reported, because their bicycles may exclude the rider.
    """
    out = {
        row["id"]: name
        for row in file.document["categories"]
        if (name := bare(row.get("name"))) in schema.CATEGORY_NAMES[1:] and not row.get("keypoints")
    }
    if out and not file.ours:
        console.say(f"{file.path}: read as categories of skope, without keypoints: {', '.join(out.values())}")
    return out


def _scheme_of_marks(scheme: Scheme, file: AnnotationSource) -> Scheme:
    """Return the scheme in the edition that a file of skope states, else in the current edition.

    The current edition fits other files, because people mark visible points.
    """
    if not file.ours or file.document["info"]["keypoint_scheme"] != scheme.name:
        return scheme
    try:
        return keypoints.scheme_in(file.document["info"])
    except UserError as error:
        raise UserError(f"{file.path}: info.{error}") from None


def bare(name: object) -> str:
    return re.sub(r"[\s-]+", "_", str(name).strip().lower())


_LEAST_BOX_PX: Final = 0.005
"""Minimum width and height of a box, pixels. A smaller box has no area in a file, which rounds pixels to 0.01."""


PLAIN_FIELDS: Final = ("image_id", "iscrowd", "area")
"""Fields with the same meaning in files of other programs."""
L = TypeVar("L", bound=Labelled)


def vehicle_of_row(
    where: str, row: Mapping[str, Any], label: Label, image: ImportedImage, remarks: Remarks, *, ours: bool
) -> Annotation | None:
    """Return a vehicle of an image, with its box cut to the image.

    Args:
        where: File and record, for messages.
        row: The record.
        label: Keypoints of its category.
        image: The image that contains it.
        remarks: Collects impossible values.
        ours: Whether fields beyond COCO's have skope's meaning.

    Returns:
        The vehicle; None if the box has no area inside the image, where it is useless for training and evaluation.
    """
    size = image.record.width, image.record.height
    with telling(where):
        theirs = records.check_array("keypoints", row.get("keypoints") or [0] * (3 * label.count), label.count, 3)
        points = np.zeros((K, 3))
        points[list(label.places)] = theirs[list(label.columns)]
        if image.turned is not None:
            points[:, :2] = image.turned.shown_points(points[:, :2])
        inside = ((points[:, :2] >= 0) & (points[:, :2] < size)).all(axis=1)
        points[~inside | (points[:, 2] <= 0)] = 0
        box = box_of_row(row.get("bbox"), points, image)
        fields = {name: row[name] for name in PLAIN_FIELDS if row.get(name) is not None}
        attributes = attributes_of(row)
        if attributes.get("ignore_reason"):
            attributes["iscrowd"] = 1
        if label.vehicle_type is not None:
            attributes.setdefault("vehicle_type", label.vehicle_type)
        fields = {**(row if ours else fields), **attributes, "bbox": box, "keypoints": points}
        fields |= {"category_id": schema.CATEGORY_ID, "id": 0}  # ids are given anew
        vehicle = cut_to(image, coco.annotation_from_dict(fields))
    if vehicle is None:
        remarks.add("vehicle", "left out, without area inside the image", where)
        return None
    return _without_impossible(where, vehicle, remarks)


def cut_to(image: ImportedImage, label: L) -> L | None:
    """Return a label with its box cut to the image; None if nothing is left of it."""
    corners = xywh_to_xyxy(label.bbox)
    cut = clip(corners, image.record.width, image.record.height)
    if min(cut[2] - cut[0], cut[3] - cut[1]) < _LEAST_BOX_PX:
        return None
    if (cut != corners).any():
        return replace(label, bbox=xyxy_to_xywh(cut), area=min(label.area, float(area(cut))))
    return label


def box_of_row(stated: Any, points: Array, image: ImportedImage) -> Any:
    """Return the box that a record states, in the image as shown; without one, the extent of its labelled keypoints."""
    if not stated or not any(stated):
        known = points[points[:, 2] > 0, :2]
        if not len(known):
            raise UserError("bbox: missing, and no keypoint is labelled")
        return xyxy_to_xywh(np.concatenate([known.min(axis=0), known.max(axis=0)]))
    if image.turned is None:
        return stated
    corners = image.turned.shown_points(xywh_to_xyxy(records.check_array("bbox", stated, 4)).reshape(2, 2))
    return xyxy_to_xywh(np.concatenate([corners.min(axis=0), corners.max(axis=0)]))


def _without_impossible(where: str, vehicle: Annotation, remarks: Remarks) -> Annotation:
    """Return the vehicle without points at 0, 0, which programs write for missing points; doubtful points are noted.

    A point that is marked visible far outside its vehicle's box is kept for review.
    """
    points, outside = vehicle.keypoints, schema.far_outside(vehicle)
    if not outside.any():
        return vehicle
    unset = outside & (points[:, :2] == 0).all(axis=1)
    if unset.any():
        remarks.add("vehicle", "with keypoints at 0, 0, far from the box: read as unlabelled", where)
        points = np.where(unset[:, None], 0.0, points)
        vehicle = replace(vehicle, keypoints=points)
    if (outside & ~unset & (points[:, 2] == 2)).any():
        remarks.add("vehicle", "with keypoints marked visible far outside the box: check them", where)
    return vehicle


def attributes_of(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields of a record from CVAT's attributes, without empty and unknown values."""
    out: dict[str, Any] = {}
    values = row.get("attributes")
    if not isinstance(values, dict):
        return out
    given: dict[str, Any] = values
    lists = {
        "vehicle_type": schema.VEHICLE_TYPES,
        "color": schema.VEHICLE_COLORS,
        "ignore_reason": schema.IGNORE_REASONS,
    }
    for name, choices in lists.items():
        if given.get(name) in choices:
            out[name] = given[name]
    if given.get("model", "") not in ("", UNSET_VALUE):
        out["model"] = str(given["model"])
    if re.fullmatch(r"\d{1,18}", str(given.get("track_id", ""))):
        out["track_id"] = int(given["track_id"])
    return out


def road_user_of(
    where: str, row: Mapping[str, Any], category: str, image: ImportedImage, remarks: Remarks, *, ours: bool
) -> RoadUser | None:
    """Return a road user of an image, with its box cut to the image.

    Args:
        where: File and record, for messages.
        row: The record.
        category: Its category.
        image: The image that contains it.
        remarks: Collects impossible values.
        ours: Whether fields beyond COCO's have skope's meaning.

    Returns:
        The road user; None if the box has no area inside the image.
    """
    with telling(where):
        fields = {name: row[name] for name in PLAIN_FIELDS if row.get(name) is not None}
        attributes = {
            name: value for name, value in attributes_of(row).items() if name in ("track_id", "ignore_reason")
        }
        if attributes.get("ignore_reason"):
            attributes["iscrowd"] = 1
        fields = {
            **(row if ours else fields),
            **attributes,
            "bbox": box_of_row(row.get("bbox"), np.zeros((K, 3)), image),
        }
        fields |= {"category_id": schema.CATEGORY_NAMES.index(category) + 1, "id": 0}  # ids are given anew
        user = cut_to(image, coco.road_user_from_dict(fields))
    if user is None:
        remarks.add(category, "left out, without area inside the image", where)
    return user


def read(
    sources: Sequence[Path],
    root: Path,
    *,
    form: str,
    images: Path | None,
    split: str | None,
    stored_pixels: bool = False,
    command: str,
    console: Console,
) -> None:
    """Make a dataset from COCO keypoints files, folders with such files, or CVAT archives.

    Args:
        sources: Annotation files, folders or archives.
        root: Folder of the new dataset.
        form: "coco" or "cvat".
        images: Folder in which images are searched. Default: the folders beside the annotation files.
        split: Split of all images. Default: derived from the names of annotation files and their folders.
        stored_pixels: Whether labels are in the stored pixels of images that EXIF rotates. Default: in the pixels of
            the image as shown.
        command: Command line for the card.
        console: Shows progress, assumptions, and omitted records.

    Raises:
        UserError: A source cannot be read or has no keypoints of a known scheme, or its scheme, categories or licence
            differ from those of the other sources.
    """
    if images is not None and not images.is_dir():
        raise UserError(f"--images: {images}: no such folder")
    remarks = Remarks()
    importer = ImageImporter(InFolder(images) if images else None, stored_pixels, remarks)
    writer: FolderWriter | None = None
    stated = dict[str, None]()
    for source in sources:
        with open_source(source) as files:
            for file in annotation_sources(source, files, form, split, console):
                stated[file.licence] = None
                labels, user_categories = vehicle_categories(file, console), road_user_categories(file, console)
                scheme = next(iter(labels.values())).scheme
                categories = schema.checked_categories([*schema.VEHICLE_ALONE, *user_categories.values()])
                writer = writer or FolderWriter(root, scheme, categories)
                if categories != writer.categories:
                    raise UserError(
                        f"{file.path}: categories: labels {', '.join(categories)}, the others "
                        f"{', '.join(writer.categories)}: import them separately; "
                        "objects that one does not label would be background"
                    )
                if scheme is not writer.scheme:
                    raise UserError(
                        f"{file.path}: has keypoints of scheme {scheme.name}, the others of {writer.scheme.name}"
                    )
                _add(file, files, labels, user_categories, importer, writer, console)
    remarks.say(console)
    if len(stated) > 1:
        raise UserError(f"files under different licences ({'; '.join(sorted(stated))}): import them separately")
    rules = ["Boxes and keypoints are those of the files read; a keypoint that they do not have is unlabelled (v = 0)."]
    assert writer is not None  # a source without an annotation file was rejected
    if writer.categories != schema.VEHICLE_ALONE:
        rules.append(f"Without keypoints: {', '.join(writer.categories[1:])}.")
    finish_dataset(writer, command=command, licence=next(iter(stated)), label_rules=rules)


def _add(
    file: AnnotationSource,
    files: Files,
    labels: Mapping[int, Label],
    user_categories: Mapping[int, str],
    importer: ImageImporter,
    writer: FolderWriter,
    console: Console,
) -> None:
    """Write the images, vehicles and other road users of an annotation file in `files`."""
    rows_by_image: dict[int, list[tuple[int, Mapping[str, Any]]]] = {row["id"]: [] for row in file.document["images"]}
    for i, row in enumerate(file.document["annotations"]):
        if row["image_id"] not in rows_by_image:
            raise UserError(f"{file.path}: annotations[{i}]: image_id {row['image_id']} is not among the images")
        rows_by_image[row["image_id"]].append((i, row))
    called = {category["id"]: str(category.get("name")) for category in file.document["categories"]}
    for id_, image in importer.images(file, files, console):
        vehicles, road_users = [], []
        for i, row in rows_by_image[id_]:
            where, label = f"{file.path}: annotations[{i}]", labels.get(row["category_id"])
            if category := user_categories.get(row["category_id"]):
                user = road_user_of(where, row, category, image, importer.remarks, ours=file.ours)
                road_users += [user] if user is not None else []
                continue
            if label is None:
                name = called.get(row["category_id"], "no category")
                importer.remarks.add("annotation", f"of {name} left out, without a keypoint of skope", where)
                continue
            vehicle = vehicle_of_row(where, row, label, image, importer.remarks, ours=file.ours)
            if vehicle is not None:
                vehicles.append(vehicle)
        frame = labelled_frame(file.split, image.record, vehicles, image.contents, road_users=road_users)
        writer.add(file.split, [frame])
