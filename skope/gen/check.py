"""Does a dataset hold what it says? Schema, ids, files, re-projection, visibility against the depth files."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera import Camera
from skope.dataset import Dataset
from skope.errors import UserError
from skope.gen.annotate import POINT_TOLERANCE, SLOPE_CAP
from skope.schema import Annotation, Image

Array = NDArray[np.floating[Any]]

REPROJECTION_PX = 0.1
DEPTH_LIMIT = 250.0
"""Depth files end soon after this, metres."""
DOUBT = 0.15
"""Metres by which the depth file must contradict a flag before it counts."""


def check(dataset: Dataset) -> Iterator[str]:
    """Findings, each naming file, id and field; none for a sound dataset."""
    sites: dict[str, str] = {}
    own = dataset.card.get("parameters", {}).get("own")  # its one site has recordings in several splits
    images: set[int] = set()
    annotations: set[int] = set()
    if not dataset.splits:
        yield f"{dataset.root}/annotations: no annotation files"
    for split in dataset.splits:
        name = f"annotations/{split}.json"
        try:
            file = dataset.read(split)
        except UserError as error:
            yield str(error)
            continue
        for image in file.images:
            if image.id in images:
                yield f"{name}: image {image.id}: id stands in another split too"
            if not own and image.site and sites.setdefault(image.site, split) != split:
                yield f"{name}: image {image.id}: site {image.site} stands in split {sites[image.site]} too"
        images.update(image.id for image in file.images)
        for annotation in file.annotations:
            if annotation.id in annotations:
                yield f"{name}: annotation {annotation.id}: id stands in another split too"
        annotations.update(annotation.id for annotation in file.annotations)
        groups = file.by_image()
        for image in file.images:
            yield from (f"{name}: {finding}" for finding in _check_image(dataset, image, groups[image.id]))


def _check_image(dataset: Dataset, image: Image, annotations: list[Annotation]) -> Iterator[str]:
    try:
        dataset.image(image)
        depth = dataset.depth(image)
    except UserError as error:
        yield f"image {image.id}: {error}"
        return
    if depth is not None and depth.shape != (image.height, image.width):
        found, size = f"{depth.shape[1]}x{depth.shape[0]}", f"{image.width}x{image.height}"
        yield f"image {image.id}: depth_file_name: is {found} instead of {size}"
        depth = None
    for annotation in annotations:
        where = f"image {image.id}, annotation {annotation.id}"
        yield from (f"{where}: {finding}" for finding in _check_annotation(image, annotation))
        if image.camera is not None and annotation.keypoints_3d is not None:
            yield from (f"{where}: {finding}" for finding in _check_projection(image.camera, annotation))
            if depth is not None:
                yield from (f"{where}: {finding}" for finding in _check_visibility(depth, image.camera, annotation))


def _check_annotation(image: Image, annotation: Annotation) -> Iterator[str]:
    boxes = {"bbox": annotation.bbox, "bbox_visible": annotation.bbox_visible}
    for name, box in boxes.items():
        if box is not None and ((box[:2] < 0).any() or (box[:2] + box[2:] > [image.width, image.height]).any()):
            yield f"{name}: reaches out of the image"
    x, y, v = annotation.keypoints.T
    if ((v > 0) & ((x < 0) | (y < 0) | (x >= image.width) | (y >= image.height))).any():
        yield "keypoints: a labelled point lies outside the image"
    if ((v == 0) & ((x != 0) | (y != 0))).any():
        yield "keypoints: v = 0 with coordinates"
    if annotation.iscrowd and annotation.ignore_reason is None:
        yield "ignore_reason: missing on an ignored vehicle"
    if annotation.area_full is not None and annotation.area > annotation.area_full:
        yield "area: more visible pixels than the whole silhouette has"


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


def _gaps(depth: Array, camera: Camera, points: Array) -> Array:
    """How far points (..., 3) lie behind what the 3 x 3 pixels around them show (9, ...), metres; NaN outside."""
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


def _tested_places(annotation: Annotation) -> Array:
    """(C, 33, 3) places where each point's visibility may have been tested.

    A wheel is tested at the middle of its outer face, which the annotation does not hold: half a wheel's width out
    along an axle that may be steered.
    """
    assert annotation.keypoints_3d is not None
    if annotation.box_3d is None:
        return annotation.keypoints_3d[None]
    forward, left = annotation.box_3d.R[:, 0], annotation.box_3d.R[:, 1]
    side = np.array([[-1.0], [1.0], [-1.0], [1.0]])
    places = []
    for out, turn in itertools.product((0.09, 0.11, 0.13), (-0.6, -0.3, 0.0, 0.3, 0.6)):
        points = annotation.keypoints_3d.copy()
        points[list(keypoints.WHEELS)] += side * out * (np.cos(turn) * left - np.sin(turn) * forward)
        places.append(points)
    return np.stack(places)


def _check_visibility(depth: Array, camera: Camera, annotation: Annotation) -> Iterator[str]:
    """Flags that no pixel near the point bears out.

    The file is rounded, has no slope, and a point may lie at an edge: where the pixels around it differ, their spread
    is allowed for.
    """
    assert annotation.keypoints_3d is not None
    gaps = _gaps(depth, camera, _tested_places(annotation)).reshape(-1, keypoints.K)
    least, most = np.fmin.reduce(gaps), np.fmax.reduce(gaps)
    with np.errstate(invalid="ignore"):
        doubt = DOUBT + np.minimum(np.nan_to_num(most - least, nan=SLOPE_CAP, posinf=SLOPE_CAP), SLOPE_CAP)
    v = annotation.keypoints[:, 2]
    near = np.linalg.norm(camera.to_camera(annotation.keypoints_3d), axis=1) < DEPTH_LIMIT
    for k in np.flatnonzero(near & (v == 2) & (least > POINT_TOLERANCE + doubt)):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 2, but the depth file shows {least[k]:.2f} m less"
    for k in np.flatnonzero(near & (v == 1) & (most < POINT_TOLERANCE - doubt)):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 1, but the depth file shows nothing before it"
