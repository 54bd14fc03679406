"""Does a dataset hold what it says?

Files and their bytes, schema, ids, masks, re-projection, visibility, depth and motion.
"""

import hashlib
import itertools
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skope import keypoints
from skope.camera.model import Camera
from skope.dataset import shards
from skope.dataset.folder import CARD, MANIFEST, Dataset, read_manifest
from skope.errors import UserError
from skope.gen.formats.archive import added_by_system
from skope.gen.inspect.check_boxes import (
    DEPTH_LIMIT,
    box_3d_findings,
    box_findings,
    depth_findings,
    mask_findings,
    wrapped,
)
from skope.gen.labels.visibility import POINT_TOLERANCE, SLOPE_CAP
from skope.gen.output.frames import SUFFIX_OF_FORMAT
from skope.gen.output.writers import rows_of
from skope.schema import Annotation, AnnotationFile, Image, RoadUser, far_outside
from skope.types import AnyFloats

REPROJECTION_PX = 0.1
OUTSIDE_M = 0.35
"""Mirrors stand out of the box, metres."""
ACCELERATION = 10.0
"""More than any vehicle brakes or corners with, m/s^2."""
TURN_LEVER_M = 4.0
"""Farthest from an articulated vehicle's front axle that its velocity is measured, metres."""
BEND_RAD = 0.01
"""Difference between an articulated vehicle's angle and what its rear wheels say that rounding explains, radians."""
SPEED_DOUBT = 0.3
"""Difference between two speeds that a body's rocking and the rounding of files explain, m/s."""
SHARP_PX = 40.0
"""Vehicles whose box is smaller than this may have points hidden by what is smaller than a pixel."""
DOUBT = 0.015
"""Metres by which the depth file must contradict a flag before it counts: 1 cm, and what rounding takes."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a dataset."""

    where: str
    """File, and the ids in it."""
    text: str
    """The field, and what is wrong with it."""
    image: str | None = None
    """File name of the image that has to be rendered again to repair this; None when that would not help."""
    stray: bool = False
    """Whether `where` is a file that does not belong here."""

    def __str__(self) -> str:
        return f"{self.where}: {self.text}"


def check(dataset: Dataset) -> Iterator[Finding]:
    """Check a dataset: files, checksums, and whether labels agree with each other, with depth and with physics.

    Yields what is wrong, split by split; nothing for a sound dataset.
    """
    yield from _check_manifest(dataset)
    if not dataset.splits:
        yield Finding(f"{dataset.root}", "no annotation files")
    counts, others = Counter[str](), Counter[tuple[str, str]]()
    seen = _Seen(own="own" in dataset.card.get("parameters", {}) and bool(dataset.card["parameters"]["own"]))
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
                name, f"categories: are {', '.join(file.categories)}, {CARD} says {', '.join(dataset.categories)}"
            )
        yield from _check_motion(name, file)
        yield from _check_totals(dataset, name, split)
        groups = file.labels_by_image()
        for image in file.images:
            for where, text in _check_image(dataset, image, groups[image.id]):
                yield Finding(f"{name}: {where}", text, image.file_name)
        counts["images"] += len(file.images)
        counts["ground_truth"] += sum(not a.ignored for a in file.annotations)
        others.update((user.category, "ignored" if user.ignored else "ground_truth") for user in file.road_users)
    yield from _check_takes(dataset, seen.frames)
    for key, count in counts.items():
        said = dataset.card.get("counts", {}).get(key)
        if said is not None and said != count:
            yield Finding(CARD, f"counts.{key}: is {said}, the annotations hold {count}")
    told = dataset.card.get("counts", {}).get("by_category", {})
    for name, kind in itertools.product(dataset.categories[1:], ("ground_truth", "ignored")):
        said = told.get(name, {}).get(kind, 0)
        if said != others[name, kind]:
            yield Finding(
                CARD, f"counts.by_category.{name}.{kind}: is {said}, the annotations hold {others[name, kind]}"
            )


class _Seen:
    """Finds what stands twice across splits."""

    def __init__(self, *, own: bool) -> None:
        self._own = own  # its one site has recordings in several splits
        self._sites: dict[str | None, list[str]] = {}
        self._images: set[int] = set()
        self._annotations: set[int] = set()
        self._files: set[str] = set()
        self.frames: set[tuple[str | None, str | None, int | None]] = set()

    def twice(self, name: str, split: str, file: AnnotationFile) -> Iterator[Finding]:
        for image in file.images:
            where = f"{name}: image {image.id}"
            if image.id in self._images:
                yield Finding(where, "id: stands in another split too", image.file_name)
            if image.file_name in self._files:
                yield Finding(where, f"file_name: {image.file_name} stands twice", image.file_name)
            self.frames.add((image.site, image.recording, image.frame_index))
            others = self._sites.setdefault(image.site, [])
            if split not in others:
                others.append(split)
            # Test splits may share sites, as those by condition do; what is learnt from shares none with any other.
            if not self._own and image.site and len(others) > 1 and "train" in others:
                other = next(name for name in others if name != split)
                yield Finding(where, f"site: {image.site} stands in split {other} too", image.file_name)
            self._files.add(image.file_name)
        self._images.update(image.id for image in file.images)
        names = {image.id: image.file_name for image in file.images}
        tracks: set[tuple[int, int]] = set()
        for annotation in (*file.annotations, *file.road_users):
            where, image_name = f"{name}: annotation {annotation.id}", names[annotation.image_id]
            if annotation.id in self._annotations:
                yield Finding(where, "id: stands in another split too", image_name)
            if annotation.track_id is not None:
                track = annotation.image_id, annotation.track_id
                if track in tracks:
                    yield Finding(where, f"track_id: {track[1]} stands twice in image {track[0]}", image_name)
                tracks.add(track)
        self._annotations.update(annotation.id for annotation in (*file.annotations, *file.road_users))


def _check_manifest(dataset: Dataset) -> Iterator[Finding]:
    """Check the checksums of all files, and find stray files; nothing for datasets that came without a manifest."""
    if "takes" not in dataset.card and not (dataset.root / MANIFEST).exists():
        return
    try:
        sums = read_manifest(dataset.root)["sha256"]
    except UserError as error:
        yield Finding(MANIFEST, f"cannot be read: {error}")
        return
    for name, wanted in sums.items():
        path = dataset.root / name
        image = name if name.startswith("images/") else None
        image = _image_of_depth(name, sums) if name.startswith("depth/") else image
        try:
            if hashlib.sha256(shards.read(path)).hexdigest() != wanted:
                yield Finding(name, "sha256: its bytes are not those that were written", image)
        except UserError as error:
            yield Finding(name, str(error).removeprefix(f"{path}: "), image)
    folders = ("images", "depth", "recordings", "annotations", shards.SHARD_FOLDER)
    found = (path for folder in folders for path in (dataset.root / folder).rglob("*") if path.is_file())
    for name in sorted(path.relative_to(dataset.root).as_posix() for path in found):
        if name not in sums and not added_by_system(name):
            yield Finding(name, f"is not in {MANIFEST}", stray=True)


def _check_takes(dataset: Dataset, made: Container[tuple[str | None, str | None, int | None]]) -> Iterator[Finding]:
    for site, recording, _, frames in dataset.card.get("takes", ()):
        lost = [frame for frame in range(frames) if (site, recording, frame) not in made]
        if lost:
            yield Finding(
                CARD, f"takes: {site}, recording {recording}: {len(lost)} frames have no image, from {lost[0]}"
            )


def _image_of_depth(name: str, sums: Mapping[str, str]) -> str | None:
    stem = name.removeprefix("depth/").removesuffix(".png")
    return next((image for suffix in SUFFIX_OF_FORMAT.values() if (image := f"images/{stem}{suffix}") in sums), None)


def _check_totals(dataset: Dataset, name: str, split: str) -> Iterator[Finding]:
    """Values that the reader of annotation files works out itself, and others take from the file."""
    for image, annotations in rows_of(dataset, split):
        for row in annotations:
            labelled = sum(v > 0 for v in row.get("keypoints", ())[2::3])
            if row.get("num_keypoints", labelled) != labelled:
                where = f"{name}: image {image['id']}, annotation {row['id']}"
                yield Finding(
                    where, f"num_keypoints: is {row['num_keypoints']}, {labelled} are labelled", image["file_name"]
                )


def _check_motion(name: str, file: AnnotationFile) -> Iterator[Finding]:
    """Velocities against how far a track's vehicle has come from image to image."""
    images = {image.id: image for image in file.images}
    tracks: dict[tuple[Any, ...], list[tuple[float, Image, Annotation | RoadUser]]] = {}
    every: list[Annotation | RoadUser] = [*file.annotations, *file.road_users]
    for one in every:
        image = images[one.image_id]
        if one.velocity is not None and one.box_3d is not None and one.track_id and image.time_s is not None:
            key = (image.site, image.recording, one.track_id)
            tracks.setdefault(key, []).append((image.time_s, image, one))
    for rows in tracks.values():
        rows.sort(key=lambda row: row[0])
        for (start, _, a), (end, image, b) in itertools.pairwise(rows):
            if end <= start or a.velocity is None or b.velocity is None or a.box_3d is None or b.box_3d is None:
                continue
            (here, lever), (there, _) = _measured_place(a), _measured_place(b)
            came = (there - here) / (end - start)
            wrong = float(np.linalg.norm(came - (a.velocity + b.velocity) / 2))
            turn = abs(float(wrapped(b.box_3d.yaw - a.box_3d.yaw))) / (end - start)
            # At most so far apart is the mean of two velocities from the mean velocity between them.
            if wrong > ACCELERATION * (end - start) / 4 + SPEED_DOUBT + turn * lever:
                yield Finding(
                    f"{name}: annotation {b.id}",
                    f"velocity: with annotation {a.id}'s is {wrong:.2f} m/s from how far it has come",
                    image.file_name,
                )


def _measured_place(annotation: Annotation | RoadUser) -> tuple[AnyFloats, float]:
    """A place (3,) on a road user that moves with its velocity, and how far at most it is from where that is measured.

    The box around both parts of an articulated vehicle grows and shrinks while it bends: its front axle is taken.
    """
    assert annotation.box_3d is not None
    if isinstance(annotation, RoadUser) or annotation.articulation is None or annotation.keypoints_3d is None:
        return annotation.box_3d.center, 0.0
    return annotation.keypoints_3d[list(keypoints.WHEELS[:2])].mean(axis=0), TURN_LEVER_M


def _check_image(dataset: Dataset, image: Image, labels: Sequence[Annotation | RoadUser]) -> Iterator[tuple[str, str]]:
    try:
        dataset.image(image)
        depth = dataset.depth(image)
    except UserError as error:
        yield f"image {image.id}", str(error)
        return
    if depth is not None and depth.shape != (image.height, image.width):
        found, size = f"{depth.shape[1]}x{depth.shape[0]}", f"{image.width}x{image.height}"
        yield f"image {image.id}", f"depth_file_name: is {found} instead of {size}"
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
        yield from ((where, text) for text in _check_keypoints(image, annotation))
        yield from ((where, text) for text in _check_keypoints_3d(annotation))
        if image.camera is not None and annotation.keypoints_3d is not None:
            yield from ((where, text) for text in _check_projection(image.camera, annotation))
            if depth is not None:
                yield from ((where, text) for text in _check_visibility(depth, image.camera, annotation))


def _check_keypoints(image: Image, annotation: Annotation) -> Iterator[str]:
    x, y, v = annotation.keypoints.T
    if ((v > 0) & ((x < 0) | (y < 0) | (x >= image.width) | (y >= image.height))).any():
        yield "keypoints: a labelled point lies outside the image"
    if ((v == 0) & ((x != 0) | (y != 0))).any():
        yield "keypoints: v = 0 with coordinates"
    # Of a point in the outermost pixels the part that holds it may lie beyond the image, and so in no box.
    inner = (x >= 1) & (y >= 1) & (x < image.width - 1) & (y < image.height - 1)
    for k in np.flatnonzero(far_outside(annotation) & (v == 2) & inner):
        yield f"keypoints: point {k} is called visible at {x[k]:g}, {y[k]:g}, far outside of its vehicle's box"


def _check_keypoints_3d(annotation: Annotation) -> Iterator[str]:
    """The keypoints in the world against the 3D box, and an articulated vehicle's angle."""
    box = annotation.box_3d
    if box is None or annotation.keypoints_3d is None:
        return
    own = (annotation.keypoints_3d - box.center) @ box.R
    if (np.abs(own) > box.size_lwh / 2 + OUTSIDE_M).any():
        yield "keypoints_3d: a point lies far outside box_3d"
    if annotation.articulation is not None:
        # The trailer's rearmost axle points to its left.
        right, left = annotation.keypoints_3d[list(keypoints.WHEELS[2:])]
        bend = float(wrapped(np.arctan2(*(left - right)[[1, 0]]) - np.pi / 2 - box.yaw))
        if abs(wrapped(bend - annotation.articulation)) > BEND_RAD:
            yield f"articulation: is {annotation.articulation:.4f}, the rear wheels of keypoints_3d say {bend:.4f}"


def _check_projection(camera: Camera, annotation: Annotation) -> Iterator[str]:
    assert annotation.keypoints_3d is not None
    pixels, _, valid = camera.project(annotation.keypoints_3d)
    labelled = annotation.keypoints[:, 2] > 0
    error = np.abs(np.nan_to_num(pixels, nan=np.inf) - annotation.keypoints[:, :2]).max(axis=1)
    for k in np.flatnonzero(labelled & ~(error <= REPROJECTION_PX)):
        yield f"keypoints: {keypoints.NAMES[k]} is {error[k]:.2f} px from where keypoints_3d projects"
    edge = np.nan_to_num(pixels, nan=-1e9)
    well_inside = (edge > 0.1).all(1) & (edge < [camera.width - 0.1, camera.height - 0.1]).all(1)
    for k in np.flatnonzero(~labelled & valid & well_inside):
        yield f"keypoints: {keypoints.NAMES[k]} projects into the image but has v = 0"


def _gaps(depth: AnyFloats, camera: Camera, points: AnyFloats) -> AnyFloats:
    """Distances of points (..., 3) behind what the 3 x 3 pixels around them show (9, ...), metres; NaN outside."""
    pixels, _, valid = camera.project(points)
    seen = valid & camera.inside(pixels)
    at = np.floor(np.where(seen[..., None], pixels, 0.0)).astype(int)
    distance = np.linalg.norm(camera.to_camera(points), axis=-1)
    out = []
    for down, right in itertools.product((-1, 0, 1), repeat=2):
        columns = np.clip(at[..., 0] + right, 0, camera.width - 1)
        rows = np.clip(at[..., 1] + down, 0, camera.height - 1)
        rays, _ = camera.rays(np.stack([columns, rows], axis=-1) + 0.5)
        shown = depth[rows, columns] * np.linalg.norm(rays, axis=-1)
        out.append(np.where(seen, distance - shown, np.nan))
    return np.stack(out)


def _tested_places(annotation: Annotation) -> AnyFloats:
    """(C, 33, 3) places where each point's visibility may have been tested.

    A wheel is tested at the middle of its outer face, which the annotation does not hold: half a wheel's width out
    along an axle that may be steered.
    """
    assert annotation.keypoints_3d is not None
    if annotation.box_3d is None:
        return annotation.keypoints_3d[None]
    R, bend = annotation.box_3d.R, annotation.articulation or 0.0
    # The rear wheels of an articulated vehicle are its trailer's.
    bends = np.array([[0.0], [0.0], [bend], [bend]])
    forward = np.cos(bends) * R[:, 0] + np.sin(bends) * R[:, 1]
    left = np.cos(bends) * R[:, 1] - np.sin(bends) * R[:, 0]
    side = np.array([[-1.0], [1.0], [-1.0], [1.0]])
    places = []
    for out, turn in itertools.product((0.09, 0.11, 0.13, 0.15), (-0.6, -0.3, 0.0, 0.3, 0.6)):
        points = annotation.keypoints_3d.copy()
        points[list(keypoints.WHEELS)] += side * out * (np.cos(turn) * left - np.sin(turn) * forward)
        places.append(points)
    return np.stack(places)


def _check_visibility(depth: AnyFloats, camera: Camera, annotation: Annotation) -> Iterator[str]:
    """Flags that no pixel near the point bears out.

    The file is rounded and has no slope, for which a point that is called visible was allowed: here the spread of the
    pixels around it stands for that. A point that none of them hides is visible without any allowance, but what hides
    a point of a small vehicle may be smaller than a pixel. Of a wheel at the image's edge nobody can say where it was
    tested.
    """
    assert annotation.keypoints_3d is not None
    gaps = _gaps(depth, camera, _tested_places(annotation)).reshape(-1, keypoints.K)
    least, most = np.fmin.reduce(gaps), np.fmax.reduce(gaps)
    at_edge = np.isnan(gaps).any(axis=0)
    with np.errstate(invalid="ignore"):
        doubt = DOUBT + np.minimum(np.nan_to_num(most - least, nan=SLOPE_CAP, posinf=SLOPE_CAP), SLOPE_CAP)
    v = annotation.keypoints[:, 2]
    near = (np.linalg.norm(camera.to_camera(annotation.keypoints_3d), axis=1) < DEPTH_LIMIT) & ~at_edge
    for k in np.flatnonzero(near & (v == 2) & (least > POINT_TOLERANCE + doubt)):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 2, but the depth file shows {least[k]:.2f} m less"
    for k in np.flatnonzero(
        near & (annotation.bbox[2:].max() >= SHARP_PX) & (v == 1) & (most < POINT_TOLERANCE - DOUBT)
    ):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 1, but the depth file shows nothing before it"
