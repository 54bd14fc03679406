"""Select the images for training and validation: datasets, their recordings, and required content."""

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

import numpy as np

from skope import schema
from skope.dataset import image_selection, shards
from skope.dataset.folder import MANIFEST_FILE, Dataset, open_dataset
from skope.errors import UserError
from skope.files.atomic import read_bytes
from skope.keypoints import Scheme
from skope.schema import Annotation, AnnotationFile, Image, RoadUser
from skope.train.targets import Vehicles, vehicles_of

TRAINING_SPLIT: Final = "train"


@dataclass(frozen=True, kw_only=True)
class TrainingSource:
    """Dataset with its parts for training and validation."""

    dataset: Dataset
    learnt: AnnotationFile
    """Training images."""
    validated: AnnotationFile
    """Validation images."""
    fingerprint: str
    """Digest of the annotations and of the images' names and sizes."""
    untyped: int = 0
    """Number of vehicles without a type, if some types are excluded."""
    excluded: int = 0
    """Number of vehicles excluded by their types."""

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the trained categories, in the order of the network's labels."""
        return self.learnt.categories

    def of_categories(self, categories: Sequence[str]) -> Self:
        """Return the source with the road users of some of its categories; all others are background."""
        return replace(
            self,
            learnt=of_categories(self.learnt, categories),
            validated=of_categories(self.validated, categories),
        )

    def vehicles(self) -> list[Vehicles]:
        """Return vehicles and other road users of each training image, in file order."""
        by_image, users = self.learnt.by_image(), self.learnt.road_users_by_image()
        return [
            vehicles_of(image, by_image[image.id], users[image.id], self.categories) for image in self.learnt.images
        ]


def read(root: Path, *, exclude_types: Sequence[str], val_fraction: float, max_images: int | None) -> TrainingSource:
    """Read split `train` of a dataset folder.

    Args:
        root: The dataset's folder.
        exclude_types: Vehicle types to ignore.
        val_fraction: Fraction of the training frames to hold out for validation.
        max_images: Maximum number of images with vehicles, evenly spaced; None: all.

    Raises:
        UserError: The folder contains no training image.
    """
    opened = open_dataset(root)
    file = opened.read(TRAINING_SPLIT)
    path = root / "annotations" / f"{TRAINING_SPLIT}.json"
    if not file.images:
        raise UserError(f"{path}: field images is empty: nothing to train on")
    known = [annotation for annotation in file.annotations if not annotation.ignored]
    file = excluding(file, exclude_types)
    learnt, validated = image_selection.held_back(file, val_fraction)
    validated = image_selection.ignoring(learnt, validated)
    if max_images is not None:
        learnt = image_selection.take(learnt, max_images)
    if all(annotation.ignored for annotation in learnt.annotations):
        raise UserError(f"{path}: field annotations holds no vehicle that is not ignored: nothing to train on")
    return TrainingSource(
        dataset=opened,
        learnt=learnt,
        validated=validated,
        fingerprint=_fingerprint(path, root, file.images),
        untyped=sum(annotation.vehicle_type is None for annotation in known) if exclude_types else 0,
        excluded=sum(annotation.vehicle_type in exclude_types for annotation in known),
    )


def common_scheme(sources: Sequence[TrainingSource]) -> Scheme:
    """Return the keypoint scheme of all datasets. Raises UserError if the schemes differ."""
    first, *rest = sources
    for other_source in rest:
        if other_source.dataset.scheme is not first.dataset.scheme:
            raise UserError(
                f"{other_source.dataset.root}: has keypoint scheme {other_source.dataset.scheme.name}, "
                f"{first.dataset.root} has {first.dataset.scheme.name}: "
                "datasets of different schemes cannot be learnt together"
            )
    return first.dataset.scheme


def common_categories(sources: Sequence[TrainingSource], asked: Sequence[str] | None) -> tuple[str, ...]:
    """Return the categories to train: those of all datasets, or the requested ones.

    Raises UserError if the datasets label different categories and none are requested, or if one does not label a
    requested category: unlabelled road users would be trained as background.
    """
    first, *rest = sources
    if asked is not None:
        categories = schema.checked_categories(asked)
        for source in sources:
            missing = [name for name in categories if name not in source.categories]
            if missing:
                labelled = f"{source.dataset.root} labels {', '.join(source.categories)}"
                raise UserError(
                    f"--categories {','.join(categories)}: {labelled}: unlabelled {', '.join(missing)} would "
                    "be trained as background"
                )
        return categories
    for other_source in rest:
        if other_source.categories != first.categories:
            common = [name for name in first.categories if all(name in source.categories for source in sources)]
            raise UserError(
                f"{other_source.dataset.root}: labels {', '.join(other_source.categories)}, {first.dataset.root} "
                f"{', '.join(first.categories)}: unlabelled road users would be trained as background; "
                f"--categories {','.join(common)} trains the common classes"
            )
    return first.categories


def of_categories(file: AnnotationFile, categories: Sequence[str]) -> AnnotationFile:
    """Return a file without the road users of all other categories, as if they had not been labelled."""
    users = tuple(user for user in file.road_users if user.category in categories)
    return replace(file, road_users=users, categories=tuple(categories))


def excluding(file: AnnotationFile, types: Sequence[str]) -> AnnotationFile:
    """Mark vehicles of these types as ignored: neither training data, nor background, nor ground truth."""
    if not types:
        return file
    return replace(
        file, annotations=tuple(replace(a, iscrowd=1) if a.vehicle_type in types else a for a in file.annotations)
    )


def _fingerprint(annotations: Path, root: Path, images: Sequence[Image]) -> str:
    # For shards, the checksums of the labels are in the manifest.
    digest = hashlib.sha256(read_bytes(annotations if annotations.is_file() else root / MANIFEST_FILE))
    for image in images:
        digest.update(f"{image.file_name} {shards.size(root / image.file_name)}\n".encode())
    return digest.hexdigest()


def validation_images(sources: Sequence[TrainingSource], most: int) -> tuple[AnnotationFile, list[Path]]:
    """Return at most `most` validation images, evenly spread over all sources, with new ids; and their image files."""
    found: list[tuple[Path, Image, list[Annotation], list[RoadUser]]] = []
    for source in sources:
        by_image, users = source.validated.by_image(), source.validated.road_users_by_image()
        root, shown = source.dataset.root, source.validated.images
        found += [(root, image, by_image[image.id], users[image.id]) for image in shown]
    chosen = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, min(most, len(found))).astype(int))]
    images: list[Image] = []
    annotations: list[Annotation] = []
    road_users: list[RoadUser] = []
    ids = itertools.count(1)
    for number, (_, image, vehicles, users) in enumerate(chosen, start=1):
        images.append(replace(image, id=number))
        annotations += [replace(a, id=next(ids), image_id=number) for a in vehicles]
        road_users += [replace(user, id=next(ids), image_id=number) for user in users]
    file = AnnotationFile(
        images=tuple(images),
        annotations=tuple(annotations),
        name="validation",
        scheme=common_scheme(sources),
        road_users=tuple(road_users),
        categories=sources[0].categories,
    )
    return file, [root / image.file_name for root, image, *_ in chosen]
