"""Checks of single labels: boxes and masks of all road users, and keypoints of vehicles.

Labels are compared with the image, each other, the camera and depth.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pycocotools import mask as coco_mask

from skope import keypoints
from skope.camera.model import Camera
from skope.gen.labels.visibility import VISIBILITY_TOLERANCES
from skope.pictures.draw import visible_mask
from skope.schema import Annotation, Image, Labelled, RoadUser, far_outside
from skope.types import AnyFloats


@dataclass(frozen=True)
class LabelTolerances:
    """Tolerances for rounding and modelling."""

    box_px: float = 1.0
    """Tolerance of boxes, pixels. Boxes and masks are of silhouettes at pixel centres."""
    distance_m: float = 0.05
    """Tolerance of distances, metres."""
    limbs_m: float = 0.6
    """Maximum reach of arms, feet and loads outside the 3D box of a body at rest, metres."""
    depth_limit_m: float = 250.0
    """Maximum depth at which depth files are compared, metres. They end soon after."""
    reprojection_px: float = 0.1
    """Tolerance of reprojected keypoints, pixels."""
    outside_m: float = 0.35
    """Maximum reach of mirrors outside the box, metres."""
    bend_rad: float = 0.01
    """Tolerance between an articulated vehicle's angle and the angle of its rear wheels (rounding), radians."""
    sharp_px: float = 40.0
    """Box size below which points of a vehicle may be hidden by objects smaller than a pixel, pixels."""
    depth_slack_m: float = 0.015
    """Tolerance of the comparison of flags with the depth file, metres: 1 cm plus rounding."""


LABEL_TOLERANCES: Final = LabelTolerances()


def box_findings(image: Image, label: Labelled) -> Iterator[str]:
    """Check the boxes against the image's edges, and the numbers of pixels."""
    boxes = {"bbox": label.bbox, "bbox_visible": label.bbox_visible}
    for name, box in boxes.items():
        if box is not None and ((box[:2] < 0).any() or (box[:2] + box[2:] > [image.width, image.height]).any()):
            yield f"{name}: extends outside the image"
    if not label.ignored and label.bbox[2:].min() <= 0:
        yield f"bbox: has no area: width {label.bbox[2]:g}, height {label.bbox[3]:g}"
    if label.area_full is not None and label.area > label.area_full:
        yield "area: more visible pixels than in the whole silhouette"


def mask_findings(image: Image, label: Labelled) -> Iterator[str]:
    """Check the visible pixels against `area` and `bbox_visible`."""
    rle = label.segmentation
    if not isinstance(rle, dict):
        return
    if list(rle.get("size", [])) != [image.height, image.width]:
        yield f"segmentation.size: is {rle.get('size')}, expected {[image.height, image.width]}"
        return
    try:
        mask = coco_mask.decode({**rle, "counts": str(rle["counts"]).encode()})
    except Exception as error:  # pycocotools raises various exceptions
        yield f"segmentation.counts: cannot be decoded: {error}"
        return
    area = int(mask.sum())
    if area != round(label.area):
        yield f"segmentation: {area} pixels, expected {label.area:g} from area"
    if area and label.bbox_visible is not None:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        tight = np.array([columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])
        if np.abs(tight - label.bbox_visible).max() > LABEL_TOLERANCES.box_px:
            yield f"bbox_visible: {label.bbox_visible.tolist()}, expected {tight.tolist()} from the mask"
        low, size = label.bbox[:2], label.bbox[2:]
        if (tight[:2] < low - LABEL_TOLERANCES.box_px).any() or (
            tight[:2] + tight[2:] > low + size + LABEL_TOLERANCES.box_px
        ).any():
            yield "bbox: visible pixels lie outside"


def box_3d_findings(camera: Camera | None, label: Labelled) -> Iterator[str]:
    """Check the 3D box, and its distance from the camera."""
    box = label.box_3d
    if box is None:
        return
    if (box.size_lwh <= 0).any():
        yield "box_3d.size_lwh: is not positive"
    if np.abs(box.R @ box.R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(box.R) < 0:
        yield "box_3d.R: is no rotation"
        return
    turned = np.arctan2(box.R[1, 0], box.R[0, 0]) - box.yaw
    if abs(wrapped(turned)) > 1e-4:
        yield f"box_3d.yaw: {box.yaw:.4f}, expected {box.yaw + turned:.4f} from R"
    if camera is not None and label.distance is not None:
        away = float(np.linalg.norm(camera.to_camera(box.center)))
        if abs(away - label.distance) > LABEL_TOLERANCES.distance_m:
            yield f"distance: {label.distance:.2f} m, but the box's centre is {away:.2f} m away"


def depth_findings(depth: AnyFloats, camera: Camera, user: RoadUser) -> Iterator[str]:
    """Check the depth of the visible pixels against the 3D box; the mask of another body would show another depth."""
    visible = visible_mask(user)
    if visible is None or user.box_3d is None or visible.shape != depth.shape:
        return
    middle = float(np.median(depth[visible])) if visible.any() else np.inf
    z = float(camera.to_camera(user.box_3d.center)[2])
    reach = float(np.linalg.norm(user.box_3d.size_lwh)) / 2 + LABEL_TOLERANCES.limbs_m
    if max(middle, z) < LABEL_TOLERANCES.depth_limit_m and abs(middle - z) > reach:
        yield f"segmentation: the depth file shows {middle:.2f} m where the box's centre is at {z:.2f} m"


def wrapped(angle: Any) -> Any:
    """Return an angle wrapped to -pi to pi, radians."""
    return np.arctan2(np.sin(angle), np.cos(angle))


def keypoint_findings(image: Image, annotation: Annotation) -> Iterator[str]:
    x, y, v = annotation.keypoints.T
    if ((v > 0) & ((x < 0) | (y < 0) | (x >= image.width) | (y >= image.height))).any():
        yield "keypoints: a labelled point lies outside the image"
    if ((v == 0) & ((x != 0) | (y != 0))).any():
        yield "keypoints: v = 0 with coordinates"
    # The visible part at a point in the outermost pixels may lie outside the image, and therefore in no box.
    inner = (x >= 1) & (y >= 1) & (x < image.width - 1) & (y < image.height - 1)
    for k in np.flatnonzero(far_outside(annotation) & (v == 2) & inner):
        yield f"keypoints: point {k} is marked visible at {x[k]:g}, {y[k]:g}, far outside its vehicle's box"


def keypoint_3d_findings(annotation: Annotation) -> Iterator[str]:
    """Check the keypoints in the world against the 3D box, and an articulated vehicle's angle."""
    box = annotation.box_3d
    if box is None or annotation.keypoints_3d is None:
        return
    in_box_frame = (annotation.keypoints_3d - box.center) @ box.R
    if (np.abs(in_box_frame) > box.size_lwh / 2 + LABEL_TOLERANCES.outside_m).any():
        yield "keypoints_3d: a point lies far outside box_3d"
    if annotation.articulation is not None:
        # The direction along the trailer's rearmost axle is its left.
        right, left = annotation.keypoints_3d[list(keypoints.WHEELS[2:])]
        bend = float(wrapped(np.arctan2(*(left - right)[[1, 0]]) - np.pi / 2 - box.yaw))
        if abs(wrapped(bend - annotation.articulation)) > LABEL_TOLERANCES.bend_rad:
            yield f"articulation: {annotation.articulation:.4f}, expected {bend:.4f} from the wheels of keypoints_3d"


def projection_findings(camera: Camera, annotation: Annotation) -> Iterator[str]:
    assert annotation.keypoints_3d is not None
    pixels, _, valid = camera.project(annotation.keypoints_3d)
    labelled = annotation.keypoints[:, 2] > 0
    error = np.abs(np.nan_to_num(pixels, nan=np.inf) - annotation.keypoints[:, :2]).max(axis=1)
    for k in np.flatnonzero(labelled & ~(error <= LABEL_TOLERANCES.reprojection_px)):
        yield f"keypoints: {keypoints.NAMES[k]} is {error[k]:.2f} px from where keypoints_3d projects"
    edge = np.nan_to_num(pixels, nan=-1e9)
    well_inside = (edge > 0.1).all(1) & (edge < [camera.width - 0.1, camera.height - 0.1]).all(1)
    for k in np.flatnonzero(~labelled & valid & well_inside):
        yield f"keypoints: {keypoints.NAMES[k]} projects into the image but has v = 0"


def _gaps(depth: AnyFloats, camera: Camera, points: AnyFloats) -> AnyFloats:
    """Return distances of points (..., 3) behind the surfaces in the 3 x 3 pixels around them (9, ...), metres.

    Points outside the image have NaN.
    """
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
    """Return positions (C, 33, 3) at which each point's visibility may have been tested.

    A wheel is tested at the middle of its outer face, which the annotation does not contain. It is half a wheel's width
    outwards along an axle that may be steered.
    """
    assert annotation.keypoints_3d is not None
    if annotation.box_3d is None:
        return annotation.keypoints_3d[None]
    R, bend = annotation.box_3d.R, annotation.articulation or 0.0
    # The rear wheels of an articulated vehicle belong to its trailer.
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


def visibility_findings(depth: AnyFloats, camera: Camera, annotation: Annotation) -> Iterator[str]:
    """Report the visibility flags that no pixel near the point confirms.

    The visibility test has a tolerance for the slope of the surface, which the rounded depth file does not contain.
    Here the tolerance is the spread of the surrounding depths. A hidden point of a small vehicle is not reported,
    because the object that hides it can be smaller than a pixel. Points at the image's edge are skipped.
    """
    assert annotation.keypoints_3d is not None
    gaps = _gaps(depth, camera, _tested_places(annotation)).reshape(-1, keypoints.K)
    least, most = np.fmin.reduce(gaps), np.fmax.reduce(gaps)
    at_edge = np.isnan(gaps).any(axis=0)
    with np.errstate(invalid="ignore"):
        tolerance = LABEL_TOLERANCES.depth_slack_m + np.minimum(
            np.nan_to_num(most - least, nan=VISIBILITY_TOLERANCES.slope_m, posinf=VISIBILITY_TOLERANCES.slope_m),
            VISIBILITY_TOLERANCES.slope_m,
        )
    v = annotation.keypoints[:, 2]
    near = (
        np.linalg.norm(camera.to_camera(annotation.keypoints_3d), axis=1) < LABEL_TOLERANCES.depth_limit_m
    ) & ~at_edge
    for k in np.flatnonzero(near & (v == 2) & (least > VISIBILITY_TOLERANCES.point_m + tolerance)):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 2, but the depth file shows {least[k]:.2f} m less"
    for k in np.flatnonzero(
        near
        & (annotation.bbox[2:].max() >= LABEL_TOLERANCES.sharp_px)
        & (v == 1)
        & (most < VISIBILITY_TOLERANCES.point_m - LABEL_TOLERANCES.depth_slack_m)
    ):
        yield f"keypoints: {keypoints.NAMES[k]} has v = 1, but the depth file shows nothing in front of it"
