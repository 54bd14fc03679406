"""Datasets made of COCO keypoints files of any program, of CVAT's archives, and of predictions.

Keypoints are taken by name, in any order and number: what a file does not have is unlabelled (v = 0). What was guessed,
and what cannot be right, is said.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from skope import schema
from skope.errors import UserError
from skope.gen.formats.coco_categories import Label, road_user_categories, vehicle_categories
from skope.gen.formats.coco_images import ImageImporter
from skope.gen.formats.coco_road_users import road_user_of
from skope.gen.formats.coco_sources import AnnotationSource, annotation_sources, open_source
from skope.gen.formats.coco_vehicles import vehicle_of_row
from skope.gen.formats.dataset_builder import finish_dataset, labelled_frame
from skope.gen.formats.remarks import Remarks
from skope.gen.formats.source_files import Files, InFolder
from skope.gen.output.writers import FolderWriter
from skope.terminal.console import Console


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
        images: Folder that images are looked for in. Default: the folders beside the annotation files.
        split: Split that all images go to. Default: what the names of annotation files and their folders say.
        stored_pixels: Whether labels are in the pixels that a picture's file holds where EXIF says that it is to be
            turned. Default: in those of the picture as shown.
        command: Command line for the card.
        console: Where progress is shown, what was guessed, and what was left out.

    Raises:
        UserError: A source cannot be read, has no keypoints of a known scheme, or another scheme or licence than the
            others.
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
                labels, others = vehicle_categories(file, console), road_user_categories(file, console)
                scheme = next(iter(labels.values())).scheme
                categories = schema.checked_categories([*schema.VEHICLE_ALONE, *others.values()])
                writer = writer or FolderWriter(root, scheme, categories)
                if categories != writer.categories:
                    raise UserError(
                        f"{file.path}: categories: labels {', '.join(categories)}, the others "
                        f"{', '.join(writer.categories)}: read them apart; whom one does not label would be background"
                    )
                if scheme is not writer.scheme:
                    raise UserError(
                        f"{file.path}: has keypoints of scheme {scheme.name}, the others of {writer.scheme.name} "
                        f"(editions {scheme.edition} and {writer.scheme.edition})"
                    )
                _add(file, files, labels, others, importer, writer, console)
    remarks.say(console)
    if len(stated) > 1:
        raise UserError(f"files under different licences ({'; '.join(sorted(stated))}): read them apart")
    rules = ["Boxes and keypoints are those of the files read; a keypoint that they do not have is unlabelled (v = 0)."]
    assert writer is not None  # a source without an annotation file was refused
    if writer.categories != schema.VEHICLE_ALONE:
        rules.append(f"Without keypoints: {', '.join(writer.categories[1:])}.")
    finish_dataset(writer, command=command, licence=next(iter(stated)), label_rules=rules)


def _add(
    file: AnnotationSource,
    files: Files,
    labels: Mapping[int, Label],
    others: Mapping[int, str],
    importer: ImageImporter,
    writer: FolderWriter,
    console: Console,
) -> None:
    """Write the images, vehicles and other road users of an annotation file, which lies among `files`."""
    own: dict[int, list[tuple[int, Mapping[str, Any]]]] = {row["id"]: [] for row in file.document["images"]}
    for i, row in enumerate(file.document["annotations"]):
        if row["image_id"] not in own:
            raise UserError(f"{file.path}: annotations[{i}]: image_id {row['image_id']} is not among the images")
        own[row["image_id"]].append((i, row))
    called = {category["id"]: str(category.get("name")) for category in file.document["categories"]}
    for id_, image in importer.images(file, files, console):
        vehicles, road_users = [], []
        for i, row in own[id_]:
            where, label = f"{file.path}: annotations[{i}]", labels.get(row["category_id"])
            if category := others.get(row["category_id"]):
                user = road_user_of(where, row, category, image, importer.remarks, ours=file.ours)
                road_users += [user] if user is not None else []
                continue
            if label is None:
                name = called.get(row["category_id"], "no category")
                importer.remarks.add("annotation", f"of {name} left out, without a keypoint of ours", where)
                continue
            vehicle = vehicle_of_row(where, row, label, image, importer.remarks, ours=file.ours)
            if vehicle is not None:
                vehicles.append(vehicle)
        frame = labelled_frame(file.split, image.record, vehicles, image.contents, road_users=road_users)
        writer.add(file.split, [frame])
