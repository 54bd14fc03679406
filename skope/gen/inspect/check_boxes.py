"""Findings on the boxes and masks of road users of any category: against the image, each other and depth."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from pycocotools import mask as coco_mask

from skope.camera.model import Camera
from skope.pictures.draw import visible_mask
from skope.schema import Image, Labelled, RoadUser
from skope.types import AnyFloats

BOX_PX: Final = 1.0
"""Boxes are of silhouettes at pixel centres, masks too."""
DISTANCE_M: Final = 0.05
LIMBS_M: Final = 0.6
"""Arms, legs and loads reach out of the 3D box of a body at rest, metres."""
DEPTH_LIMIT: Final = 250.0
"""Depth files end soon after this, metres."""


def box_findings(image: Image, label: Labelled) -> Iterator[str]:
    """The boxes against the image's edges, and the numbers of pixels."""
    boxes = {"bbox": label.bbox, "bbox_visible": label.bbox_visible}
    for name, box in boxes.items():
        if box is not None and ((box[:2] < 0).any() or (box[:2] + box[2:] > [image.width, image.height]).any()):
            yield f"{name}: reaches out of the image"
    if not label.ignored and label.bbox[2:].min() <= 0:
        yield f"bbox: has no area: width {label.bbox[2]:g}, height {label.bbox[3]:g}"
    if label.area_full is not None and label.area > label.area_full:
        yield "area: more visible pixels than the whole silhouette has"


def mask_findings(image: Image, label: Labelled) -> Iterator[str]:
    """The visible pixels against `area` and `bbox_visible`."""
    rle = label.segmentation
    if not isinstance(rle, dict):
        return
    if list(rle.get("size", [])) != [image.height, image.width]:
        yield f"segmentation.size: is {rle.get('size')}, expected {[image.height, image.width]}"
        return
    try:
        mask = coco_mask.decode({**rle, "counts": str(rle["counts"]).encode()})
    except Exception as error:  # pycocotools raises what it likes
        yield f"segmentation.counts: cannot be decoded: {error}"
        return
    area = int(mask.sum())
    if area != round(label.area):
        yield f"segmentation: has {area} pixels, area says {label.area:g}"
    if area and label.bbox_visible is not None:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        tight = np.array([columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])
        if np.abs(tight - label.bbox_visible).max() > BOX_PX:
            yield f"bbox_visible: is {label.bbox_visible.tolist()}, the mask's is {tight.tolist()}"
        low, size = label.bbox[:2], label.bbox[2:]
        if (tight[:2] < low - BOX_PX).any() or (tight[:2] + tight[2:] > low + size + BOX_PX).any():
            yield "bbox: visible pixels lie outside"


def box_3d_findings(camera: Camera | None, label: Labelled) -> Iterator[str]:
    """The 3D box by itself, and its distance from the camera."""
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
        yield f"box_3d.yaw: is {box.yaw:.4f}, R says {box.yaw + turned:.4f}"
    if camera is not None and label.distance is not None:
        away = float(np.linalg.norm(camera.to_camera(box.center)))
        if abs(away - label.distance) > DISTANCE_M:
            yield f"distance: is {label.distance:.2f} m, the box's centre is {away:.2f} m away"


def depth_findings(depth: AnyFloats, camera: Camera, user: RoadUser) -> Iterator[str]:
    """The depth of the visible pixels against the 3D box: another mask than that of this body shows another depth."""
    visible = visible_mask(user)
    if visible is None or user.box_3d is None or visible.shape != depth.shape:
        return
    middle = float(np.median(depth[visible])) if visible.any() else np.inf
    z = float(camera.to_camera(user.box_3d.center)[2])
    reach = float(np.linalg.norm(user.box_3d.size_lwh)) / 2 + LIMBS_M
    if max(middle, z) < DEPTH_LIMIT and abs(middle - z) > reach:
        yield f"segmentation: the depth file shows {middle:.2f} m where the box's centre is at {z:.2f} m"


def wrapped(angle: Any) -> Any:
    """An angle brought into -pi to pi, radians."""
    return np.arctan2(np.sin(angle), np.cos(angle))
