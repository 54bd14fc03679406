"""Which images are learnt from and which validated on: datasets, their recordings, and what they must hold."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from skope.dataset import image_selection, shards
from skope.dataset.folder import MANIFEST, Dataset, open_dataset
from skope.errors import UserError
from skope.files.reading import read_bytes
from skope.keypoints import Scheme
from skope.schema import Annotation, AnnotationFile, Image
from skope.train.targets import Vehicles, vehicles_of

SPLIT: Final = "train"


@dataclass(frozen=True, kw_only=True)
class TrainingSource:
    """A dataset that is trained on, and its parts for learning and validating."""

    dataset: Dataset
    learnt: AnnotationFile
    """The images that are learnt from."""
    validated: AnnotationFile
    """The images that are validated on."""
    fingerprint: str
    """Digest of the annotations and of the images' names and sizes."""
    untyped: int = 0
    """Number of vehicles whose type the dataset does not say, where some types are to be left out."""
    excluded: int = 0
    """Number of vehicles that were left out by their types."""

    def vehicles(self) -> list[Vehicles]:
        """The vehicles of each image that is learnt from, in file order."""
        by_image = self.learnt.by_image()
        return [vehicles_of(image, by_image[image.id]) for image in self.learnt.images]


def read(root: Path, *, exclude_types: Sequence[str], val_fraction: float, max_images: int | None) -> TrainingSource:
    """Split `train` of a dataset folder; a UserError where it holds nothing to learn from.

    `max_images` limits what is learnt from, to images with vehicles, evenly spread.
    """
    opened = open_dataset(root)
    file = opened.read(SPLIT)
    path = root / "annotations" / f"{SPLIT}.json"
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
    """The keypoint scheme of all datasets; different ones are refused, since their points mean different things."""
    first, *others = sources
    for other in others:
        if other.dataset.scheme is not first.dataset.scheme:
            raise UserError(
                f"{other.dataset.root}: has keypoint scheme {other.dataset.scheme.title}, {first.dataset.root} has "
                f"{first.dataset.scheme.title}: datasets of different schemes cannot be learnt together"
            )
    return first.dataset.scheme


def excluding(file: AnnotationFile, types: Sequence[str]) -> AnnotationFile:
    """Vehicles of these types become ignored ones: neither learnt, nor background, nor ground truth."""
    if not types:
        return file
    return replace(
        file, annotations=tuple(replace(a, iscrowd=1) if a.vehicle_type in types else a for a in file.annotations)
    )


def _fingerprint(annotations: Path, root: Path, images: Sequence[Image]) -> str:
    # The labels of shards have their checksums in the manifest.
    digest = hashlib.sha256(read_bytes(annotations if annotations.is_file() else root / MANIFEST))
    for image in images:
        digest.update(f"{image.file_name} {shards.size(root / image.file_name)}\n".encode())
    return digest.hexdigest()


def validation_images(sources: Sequence[TrainingSource], most: int) -> tuple[AnnotationFile, list[Path]]:
    """At most `most` images to validate on, evenly spread over all sources, with new ids; and their image files."""
    found: list[tuple[Path, Image, list[Annotation]]] = []
    for source in sources:
        by_image = source.validated.by_image()
        found += [(source.dataset.root, image, by_image[image.id]) for image in source.validated.images]
    chosen = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, min(most, len(found))).astype(int))]
    images: list[Image] = []
    annotations: list[Annotation] = []
    for number, (_, image, vehicles) in enumerate(chosen, start=1):
        images.append(replace(image, id=number))
        annotations += [replace(a, id=len(annotations) + k, image_id=number) for k, a in enumerate(vehicles, start=1)]
    scheme = common_scheme(sources)
    file = AnnotationFile(images=tuple(images), annotations=tuple(annotations), name="validation", scheme=scheme)
    return file, [root / image.file_name for root, image, _ in chosen]
