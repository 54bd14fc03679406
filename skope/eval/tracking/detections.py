"""Detections of one image as a tracker sees them: a box, and what its pose says."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.eval.pose.records import Located

Array = NDArray[np.float64]

_FLOOR: Final = 0.05
"""Least standard deviation of a measured place, metres: shape errors stay the same from frame to frame."""


@dataclass(frozen=True, eq=False, slots=True)
class PoseMeasurement:
    """What a detection's pose says."""

    place: Array
    """(2,) world."""
    covariance: Array
    """(2, 2)"""
    height: float
    """z of the road there."""
    heading: float
    heading_sigma: float
    size_lwh: Array
    kind: str
    """Body type."""


@dataclass(frozen=True, eq=False, slots=True)
class Detection:
    """One detection."""

    bbox: Array
    """(4,) x, y, width, height, pixels."""
    score: float
    truth_id: int | None
    """The track of the ground-truth vehicle that it is, or matches."""
    pose: PoseMeasurement | None
    """None where it was refused."""


def detections_of(image: Located) -> list[Detection]:
    """The vehicles of an image as a tracker sees them."""
    view, poses = image.view, image.poses
    out = []
    for i, good in enumerate(image.good):
        pose = PoseMeasurement(
            place=poses.position[i, :2],
            covariance=poses.covariance[i, :2, :2] + _FLOOR**2 * np.eye(2),
            height=float(poses.position[i, 2]),
            heading=float(poses.yaw[i]),
            heading_sigma=float(np.sqrt(poses.covariance[i, 3, 3])),
            size_lwh=poses.size_lwh[i],
            kind=poses.types[i],
        )
        vehicle = view.truth[i]
        truth = vehicle.track_id if vehicle else None
        out.append(Detection(view.boxes[i], float(view.scores[i]), truth, pose if good else None))
    return out


def detection_to_dict(detection: Detection) -> dict[str, Any]:
    """JSON values of a detection, not rounded."""
    told = {"bbox": detection.bbox.tolist(), "score": detection.score, "truth_id": detection.truth_id, "pose": None}
    if (pose := detection.pose) is not None:
        arrays = {name: getattr(pose, name).tolist() for name in ("place", "covariance", "size_lwh")}
        told["pose"] = {one.name: getattr(pose, one.name) for one in fields(pose)} | arrays
    return told


def detection_from_dict(told: Mapping[str, Any]) -> Detection:
    """What `detection_to_dict` was given."""
    pose = told["pose"]
    if pose is not None:
        pose = PoseMeasurement(
            **{**pose, **{name: np.array(pose[name]) for name in ("place", "covariance", "size_lwh")}}
        )
    return Detection(np.array(told["bbox"]), told["score"], told["truth_id"], pose)
