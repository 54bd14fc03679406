"""Check a dataset, and repair it.

The checks cover files and their bytes, schema, ids, motion, and each label (`skope.gen.inspect.label_checks`). A repair
renders broken frames again; intact files keep their bytes.
"""

import hashlib
import itertools
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skope import keypoints
from skope.dataset import shards
from skope.dataset.folder import CARD_FILE, MANIFEST_FILE, Dataset, read_manifest
from skope.errors import UserError
from skope.gen.formats.source_files import added_by_system
from skope.gen.inspect.label_checks import (
    box_3d_findings,
    box_findings,
    depth_findings,
    keypoint_3d_findings,
    keypoint_findings,
    mask_findings,
    projection_findings,
    visibility_findings,
    wrapped,
)
from skope.gen.output.dataset_card import command
from skope.gen.output.frames import SUFFIX_OF_FORMAT
from skope.gen.output.writers import rows_of
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.generate import PoolFactory, finish_rendering
from skope.schema import Annotation, AnnotationFile, Image, RoadUser
from skope.terminal.console import Console
from skope.types import AnyFloats


@dataclass(frozen=True)
class MotionLimits:
    """Limits of motion above which a check reports a vehicle."""

    acceleration_mps2: float = 10.0
    """Maximum acceleration of a vehicle by braking or cornering, m/s^2."""
    turn_lever_m: float = 4.0
    """Maximum distance between an articulated vehicle's front axle and the point at which its velocity is measured,
    metres."""
    speed_mps: float = 0.3
    """Difference between two speeds that the rocking of a body and the rounding of files explain, m/s."""


MOTION_LIMITS: Final = MotionLimits()


@dataclass(frozen=True)
class Finding:
    """One error in a dataset."""

    where: str
    """File, and the ids in it."""
    text: str
    """The field and its error."""
    image: str | None = None
    """File name of the image that a repair must render again; None if that would not help."""
    stray: bool = False
    """Whether `where` is a file that does not belong to the dataset."""

    def __str__(self) -> str:
        return f"{self.where}: {self.text}"


def check(dataset: Dataset) -> Iterator[Finding]:
    """Check files and checksums of a dataset, and the consistency of its labels with depth and physics.

    Yields:
        The errors, split by split; nothing for a sound dataset.
    """
    yield from _check_manifest(dataset)
    if not dataset.splits:
        yield Finding(f"{dataset.root}", "no annotation files")
    counts, category_counts = Counter[str](), Counter[tuple[str, str]]()
    seen = _SplitOverlaps(
        single_site="own" in dataset.card.get("parameters", {}) and bool(dataset.card["parameters"]["own"])
    )
    for split in dataset.splits:
        name = f"{shards.SHARD_FOLDER}/{split}-*.tar" if dataset.sharded else f"annotations/{split}.json"
        try:
            file = dataset.read(split)
        except UserError as error:
            yield Finding(name, str(error).removeprefix(f"{dataset.root / name}: "))
            continue
        yield from seen.twice(name, split, file)
        if file.categories != dataset.categories:
            yield Finding(
                name, f"categories: are {', '.join(file.categories)}, {CARD_FILE} says {', '.join(dataset.categories)}"
            )
        yield from _check_motion(name, file)
        yield from _check_totals(dataset, name, split)
        groups = file.labels_by_image()
        for image in file.images:
            for where, text in _check_image(dataset, image, groups[image.id]):
                yield Finding(f"{name}: {where}", text, image.file_name)
        counts["images"] += len(file.images)
        counts["ground_truth"] += sum(not a.ignored for a in file.annotations)
        category_counts.update(
            (user.category, "ignored" if user.ignored else "ground_truth") for user in file.road_users
        )
    yield from _check_takes(dataset, seen.frames)
    for key, count in counts.items():
        stated = dataset.card.get("counts", {}).get(key)
        if stated is not None and stated != count:
            yield Finding(CARD_FILE, f"counts.{key}: {stated}, expected {count} as in the annotations")
    stated_by_category = dataset.card.get("counts", {}).get("by_category", {})
    for name, kind in itertools.product(dataset.categories[1:], ("ground_truth", "ignored")):
        stated = stated_by_category.get(name, {}).get(kind, 0)
        if stated != category_counts[name, kind]:
            yield Finding(
                CARD_FILE,
                f"counts.by_category.{name}.{kind}: {stated}, expected {category_counts[name, kind]} "
                "as in the annotations",
            )


class _SplitOverlaps:
    """Finds duplicates across splits."""

    def __init__(self, *, single_site: bool) -> None:
        self._single_site = single_site  # the recordings of its one site are in several splits
        self._sites: dict[str | None, list[str]] = {}
        self._images: set[int] = set()
        self._annotations: set[int] = set()
        self._files: set[str] = set()
        self.frames: set[tuple[str | None, str | None, int | None]] = set()

    def twice(self, name: str, split: str, file: AnnotationFile) -> Iterator[Finding]:
        for image in file.images:
            where = f"{name}: image {image.id}"
            if image.id in self._images:
                yield Finding(where, "id: is also in another split", image.file_name)
            if image.file_name in self._files:
                yield Finding(where, f"file_name: {image.file_name} is a duplicate", image.file_name)
            self.frames.add((image.site, image.recording, image.frame_index))
            site_splits = self._sites.setdefault(image.site, [])
            if split not in site_splits:
                site_splits.append(split)
            # Test splits may share sites (those by condition do); a training split shares none with other splits.
            if not self._single_site and image.site and len(site_splits) > 1 and "train" in site_splits:
                other_split = next(name for name in site_splits if name != split)
                yield Finding(where, f"site: {image.site} is also in split {other_split}", image.file_name)
            self._files.add(image.file_name)
        self._images.update(image.id for image in file.images)
        names = {image.id: image.file_name for image in file.images}
        tracks: set[tuple[int, int]] = set()
        for annotation in (*file.annotations, *file.road_users):
            where, image_name = f"{name}: annotation {annotation.id}", names[annotation.image_id]
            if annotation.id in self._annotations:
                yield Finding(where, "id: is also in another split", image_name)
            if annotation.track_id is not None:
                track = annotation.image_id, annotation.track_id
                if track in tracks:
                    yield Finding(where, f"track_id: {track[1]} is a duplicate in image {track[0]}", image_name)
                tracks.add(track)
        self._annotations.update(annotation.id for annotation in (*file.annotations, *file.road_users))


def _check_manifest(dataset: Dataset) -> Iterator[Finding]:
    """Check the checksums of all files, and find stray files; yield nothing for datasets without a manifest."""
    if "takes" not in dataset.card and not (dataset.root / MANIFEST_FILE).exists():
        return
    try:
        sums = read_manifest(dataset.root)["sha256"]
    except UserError as error:
        yield Finding(MANIFEST_FILE, f"cannot be read: {error}")
        return
    for name, wanted in sums.items():
        path = dataset.root / name
        image = name if name.startswith("images/") else None
        image = _image_of_depth(name, sums) if name.startswith("depth/") else image
        try:
            if hashlib.sha256(shards.read(path)).hexdigest() != wanted:
                yield Finding(name, "sha256: the file has changed since it was written", image)
        except UserError as error:
            yield Finding(name, str(error).removeprefix(f"{path}: "), image)
    folders = ("images", "depth", "recordings", "annotations", shards.SHARD_FOLDER)
    found = (path for folder in folders for path in (dataset.root / folder).rglob("*") if path.is_file())
    for name in sorted(path.relative_to(dataset.root).as_posix() for path in found):
        if name not in sums and not added_by_system(name):
            yield Finding(name, f"is not in {MANIFEST_FILE}", stray=True)


def _check_takes(dataset: Dataset, made: Container[tuple[str | None, str | None, int | None]]) -> Iterator[Finding]:
    for site, recording, _, frames in dataset.card.get("takes", ()):
        lost = [frame for frame in range(frames) if (site, recording, frame) not in made]
        if lost:
            yield Finding(
                CARD_FILE,
                f"takes: {site}, recording {recording}: {len(lost)} frames without an image, the first is {lost[0]}",
            )


def _image_of_depth(name: str, sums: Mapping[str, str]) -> str | None:
    stem = name.removeprefix("depth/").removesuffix(".png")
    return next((image for suffix in SUFFIX_OF_FORMAT.values() if (image := f"images/{stem}{suffix}") in sums), None)


def _check_totals(dataset: Dataset, name: str, split: str) -> Iterator[Finding]:
    """Check values that the reader of annotation files computes itself, and other programs read from the file."""
    for image, annotations in rows_of(dataset, split):
        for row in annotations:
            labelled = sum(v > 0 for v in row.get("keypoints", ())[2::3])
            if row.get("num_keypoints", labelled) != labelled:
                where = f"{name}: image {image['id']}, annotation {row['id']}"
                yield Finding(
                    where, f"num_keypoints: is {row['num_keypoints']}, {labelled} are labelled", image["file_name"]
                )


def _check_motion(name: str, file: AnnotationFile) -> Iterator[Finding]:
    """Compare velocities with the distance that a track's vehicle has moved from image to image."""
    images = {image.id: image for image in file.images}
    tracks: dict[tuple[Any, ...], list[tuple[float, Image, Annotation | RoadUser]]] = {}
    every: list[Annotation | RoadUser] = [*file.annotations, *file.road_users]
    for label in every:
        image = images[label.image_id]
        if label.velocity is not None and label.box_3d is not None and label.track_id and image.time_s is not None:
            key = (image.site, image.recording, label.track_id)
            tracks.setdefault(key, []).append((image.time_s, image, label))
    for rows in tracks.values():
        rows.sort(key=lambda row: row[0])
        for (start, _, a), (end, image, b) in itertools.pairwise(rows):
            if end <= start or a.velocity is None or b.velocity is None or a.box_3d is None or b.box_3d is None:
                continue
            (start_point, lever), (end_point, _) = _measured_point(a), _measured_point(b)
            mean_velocity = (end_point - start_point) / (end - start)
            wrong = float(np.linalg.norm(mean_velocity - (a.velocity + b.velocity) / 2))
            turn = abs(float(wrapped(b.box_3d.yaw - a.box_3d.yaw))) / (end - start)
            # Maximum difference between the mean of two velocities and the mean velocity between them.
            if wrong > MOTION_LIMITS.acceleration_mps2 * (end - start) / 4 + MOTION_LIMITS.speed_mps + turn * lever:
                yield Finding(
                    f"{name}: annotation {b.id}",
                    f"velocity: the mean with annotation {a.id} is {wrong:.2f} m/s from the motion between them",
                    image.file_name,
                )


def _measured_point(annotation: Annotation | RoadUser) -> tuple[AnyFloats, float]:
    """Return a point (3,) of a road user that moves with its velocity, and the maximum distance to its measured point.

    The box around both parts of an articulated vehicle changes while it bends, therefore its front axle is used.
    """
    assert annotation.box_3d is not None
    if isinstance(annotation, RoadUser) or annotation.articulation is None or annotation.keypoints_3d is None:
        return annotation.box_3d.center, 0.0
    return annotation.keypoints_3d[list(keypoints.WHEELS[:2])].mean(axis=0), MOTION_LIMITS.turn_lever_m


def _check_image(dataset: Dataset, image: Image, labels: Sequence[Annotation | RoadUser]) -> Iterator[tuple[str, str]]:
    try:
        dataset.image(image)
        depth = dataset.depth(image)
    except UserError as error:
        yield f"image {image.id}", str(error)
        return
    if depth is not None and depth.shape != (image.height, image.width):
        found, size = f"{depth.shape[1]}x{depth.shape[0]}", f"{image.width}x{image.height}"
        yield f"image {image.id}", f"depth_file_name: size {found}, expected {size}"
        depth = None
    for annotation in labels:
        where = f"image {image.id}, annotation {annotation.id}"
        yield from ((where, text) for text in box_findings(image, annotation))
        if "takes" in dataset.card and annotation.ignored and annotation.ignore_reason is None:
            kind = "vehicle" if isinstance(annotation, Annotation) else annotation.category
            yield where, f"ignore_reason: missing on an ignored {kind}"
        yield from ((where, text) for text in mask_findings(image, annotation))
        yield from ((where, text) for text in box_3d_findings(image.camera, annotation))
        if isinstance(annotation, RoadUser):
            if depth is not None and image.camera is not None:
                yield from ((where, text) for text in depth_findings(depth, image.camera, annotation))
            continue
        yield from ((where, text) for text in keypoint_findings(image, annotation))
        yield from ((where, text) for text in keypoint_3d_findings(annotation))
        if image.camera is not None and annotation.keypoints_3d is not None:
            yield from ((where, text) for text in projection_findings(image.camera, annotation))
            if depth is not None:
                yield from ((where, text) for text in visibility_findings(depth, image.camera, annotation))


def _lost_splits(dataset: Dataset, findings: Sequence[Finding]) -> set[str]:
    """Return splits with a broken annotation file, or all if the manifest is broken; their labels cannot be trusted."""
    files = {finding.where for finding in findings if finding.image is None}
    if MANIFEST_FILE in files:
        return set(dataset.splits)
    return {split for split in dataset.splits if f"annotations/{split}.json" in files}


def repair(dataset: Dataset, findings: Sequence[Finding], start_pool: PoolFactory, console: Console) -> None:
    """Render broken frames of a dataset again, and write all labels again.

    Args:
        dataset: A dataset that `skope gen` made.
        findings: The errors from `check`.
        start_pool: Starts the workers.
        console: Shows progress.

    Raises:
        UserError: The dataset has another origin, or recordings are broken. Broken recordings are removed, and the
            message contains the command that simulates them again.
    """
    if "takes" not in dataset.card:
        raise UserError(f"{dataset.root}: was not made by `skope gen` and cannot be repaired")
    store = Store(dataset.root)
    with store.locked():
        plan = store.plan
        for finding in findings:
            if finding.stray:
                (dataset.root / finding.where).unlink(missing_ok=True)
        store.reopen({finding.image for finding in findings if finding.image}, _lost_splits(dataset, findings))
        lost = [store.recording_path(recording) for recording in plan.recordings if not store.recorded(recording)]
        lost += [dataset.root / f.where for f in findings if f.where.startswith("recordings/") and not f.stray]
        if lost:
            for path in lost:
                path.unlink(missing_ok=True)
            raise UserError(
                f"{lost[0]}: has to be simulated again; resume with: {command(plan.parameters)} --out {store.root}"
            )
        finish_rendering(store, plan.parameters.renderer, start_pool, console)
