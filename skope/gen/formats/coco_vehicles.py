"""Read the vehicles of a COCO file of somebody's: boxes, points and attributes."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, TypeVar

import numpy as np

from skope import field_checks, schema
from skope.boxes import area, clip, xywh_to_xyxy, xyxy_to_xywh
from skope.dataset import coco
from skope.errors import UserError
from skope.gen.formats.coco_categories import Label
from skope.gen.formats.coco_images import ImportedImage, telling
from skope.gen.formats.coco_write import UNSAID
from skope.gen.formats.remarks import Remarks
from skope.keypoints import K
from skope.schema import Annotation, Labelled
from skope.types import Array

_LEAST_PX: Final = 0.005
"""A box that is less wide or high than this has no area in a file, where pixels are rounded to 0.01."""


PLAIN: Final = ("image_id", "iscrowd", "area")
"""Fields that mean the same in files of other programs."""
L = TypeVar("L", bound=Labelled)


def vehicle_of_row(
    where: str, row: Mapping[str, Any], label: Label, image: ImportedImage, remarks: Remarks, *, ours: bool
) -> Annotation | None:
    """A vehicle of an image, its box cut to it.

    Args:
        where: File and record, for messages.
        row: The record.
        label: What its category's keypoints are.
        image: Where it is.
        remarks: Where it is noted what cannot be right.
        ours: Whether fields beyond COCO's mean what ours do.

    Returns:
        None where the box has no area inside the image: nothing can be learnt or found there.
    """
    size = image.record.width, image.record.height
    with telling(where):
        theirs = field_checks.array("keypoints", row.get("keypoints") or [0] * (3 * label.count), label.count, 3)
        points = np.zeros((K, 3))
        points[list(label.places)] = theirs[list(label.columns)]
        if image.turned is not None:
            points[:, :2] = image.turned.shown_points(points[:, :2])
        inside = ((points[:, :2] >= 0) & (points[:, :2] < size)).all(axis=1)
        points[~inside | (points[:, 2] <= 0)] = 0
        box = box_of_row(row.get("bbox"), points, image)
        fields = {name: row[name] for name in PLAIN if row.get(name) is not None}
        told = attributes_of(row)
        if told.get("ignore_reason"):
            told["iscrowd"] = 1
        if label.vehicle_type is not None:
            told.setdefault("vehicle_type", label.vehicle_type)
        fields = {**(row if ours else fields), **told, "bbox": box, "keypoints": points}
        fields |= {"category_id": schema.CATEGORY_ID, "id": 0}  # ids are given anew
        vehicle = cut_to(image, coco.annotation_from_dict(fields))
    if vehicle is None:
        remarks.add("vehicle", "left out, without area inside the image", where)
        return None
    return _without_impossible(where, vehicle, remarks)


def cut_to(image: ImportedImage, label: L) -> L | None:
    """A label with its box cut to the image; None where nothing is left of it."""
    corners = xywh_to_xyxy(label.bbox)
    cut = clip(corners, image.record.width, image.record.height)
    if min(cut[2] - cut[0], cut[3] - cut[1]) < _LEAST_PX:
        return None
    if (cut != corners).any():
        return replace(label, bbox=xyxy_to_xywh(cut), area=min(label.area, float(area(cut))))
    return label


def box_of_row(stated: Any, points: Array, image: ImportedImage) -> Any:
    """The box that a record states, in the picture as shown; without one the extent of its labelled keypoints."""
    if not stated or not any(stated):
        known = points[points[:, 2] > 0, :2]
        if not len(known):
            raise UserError("bbox: missing, and no keypoint is labelled")
        return xyxy_to_xywh(np.concatenate([known.min(axis=0), known.max(axis=0)]))
    if image.turned is None:
        return stated
    corners = image.turned.shown_points(xywh_to_xyxy(field_checks.array("bbox", stated, 4)).reshape(2, 2))
    return xyxy_to_xywh(np.concatenate([corners.min(axis=0), corners.max(axis=0)]))


def _without_impossible(where: str, vehicle: Annotation, remarks: Remarks) -> Annotation:
    """The vehicle without points that stand at 0, 0, as programs write what they do not have; doubtful ones are noted.

    A point that is called visible far outside of its vehicle's box stays, for somebody to look at.
    """
    points, outside = vehicle.keypoints, schema.far_outside(vehicle)
    if not outside.any():
        return vehicle
    unset = outside & (points[:, :2] == 0).all(axis=1)
    if unset.any():
        remarks.add("vehicle", "with keypoints at 0, 0, far from the box: they are taken as unlabelled", where)
        points = np.where(unset[:, None], 0.0, points)
        vehicle = replace(vehicle, keypoints=points)
    if (outside & ~unset & (points[:, 2] == 2)).any():
        remarks.add("vehicle", "with keypoints called visible far outside of the box: they cannot be right", where)
    return vehicle


def attributes_of(row: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a record by CVAT's attributes; what is empty, or not in our lists, is not taken."""
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
    if given.get("model", "") not in ("", UNSAID):
        out["model"] = str(given["model"])
    if re.fullmatch(r"\d{1,18}", str(given.get("track_id", ""))):
        out["track_id"] = int(given["track_id"])
    return out
