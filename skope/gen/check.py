"""Does a dataset hold what it says? Schema, ids, files, re-projection, visibility against the depth files."""

from collections.abc import Iterator

import numpy as np

from skope import keypoints
from skope.camera import Camera
from skope.dataset import Dataset
from skope.errors import UserError
from skope.gen.annotate import POINT_TOLERANCE, behind
from skope.gen.render import STATIC, View
from skope.schema import Annotation, Image

REPROJECTION_PX = 0.1
WHEEL_HALF_WIDTH = 0.11
DOUBT = 0.15
"""Metres by which the depth file must contradict a flag before it counts: the file is rounded and has no slope."""


def check(dataset: Dataset) -> Iterator[str]:
    """Findings, each naming file, id and field; none for a sound dataset."""
    sites: dict[str, str] = {}
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
            if image.site and sites.setdefault(image.site, split) != split:
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
    view = _view(depth) if depth is not None else None
    for annotation in annotations:
        where = f"image {image.id}, annotation {annotation.id}"
        yield from (f"{where}: {finding}" for finding in _check_annotation(image, annotation))
        if image.camera is not None and annotation.keypoints_3d is not None:
            yield from (f"{where}: {finding}" for finding in _check_projection(image.camera, annotation))
            if view is not None:
                yield from (f"{where}: {finding}" for finding in _check_visibility(view, image.camera, annotation))


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


def _view(depth: np.ndarray) -> View:
    """A view with the depth file's values and the slope that neighbouring pixels show."""
    inverse = 1 / depth.astype(np.float64)
    slope = np.zeros((*depth.shape, 2), dtype=np.float32)
    for axis in (0, 1):
        step = np.diff(inverse, axis=axis)
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 0)
        back = np.pad(step, pad, mode="edge")
        pad[axis] = (0, 1)
        forth = np.pad(step, pad, mode="edge")
        # The larger change is the safe one here: what a flag may claim, not what it must.
        change = np.where(np.abs(back) > np.abs(forth), back, forth)
        z2 = np.where(np.isfinite(depth), depth.astype(np.float64) ** 2, 0)
        slope[..., 1 - axis] = -change * z2
    ids = np.full(depth.shape, STATIC, dtype=np.int32)
    return View(np.zeros((*depth.shape, 3), np.uint8), depth, slope, ids, (), np.zeros(0))


def _check_visibility(view: View, camera: Camera, annotation: Annotation) -> Iterator[str]:
    assert annotation.keypoints_3d is not None
    points = annotation.keypoints_3d.copy()
    if annotation.box_3d is not None:
        # A wheel is tested at the middle of its outer face: about that far out along the axle.
        outward = np.array([[-1.0], [1.0], [-1.0], [1.0]]) * WHEEL_HALF_WIDTH
        points[list(keypoints.WHEELS)] += outward * annotation.box_3d.R[:, 1]
    gap, _ = behind(view, camera, points)
    v = annotation.keypoints[:, 2]
    far = np.linalg.norm(camera.to_camera(points), axis=1) > 250
    for k in np.flatnonzero((v == 2) & ~far & (gap > POINT_TOLERANCE + DOUBT)):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 2, but the depth file shows a surface {gap[k]:.2f} m before it"
    for k in np.flatnonzero((v == 1) & ~far & (gap < POINT_TOLERANCE - DOUBT - 5)):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 1, but the depth file shows nothing before it"
