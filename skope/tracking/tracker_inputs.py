"""Input of a tracker for one image: detections with their boxes and poses."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from skope.pose.pose_records import INTERPOLATED_REASON, Located
from skope.types import Array

LEAST_SIGMA_M: Final = 0.05
"""Minimum standard deviation of a measured position, metres. Shape errors are the same from frame to frame."""


@dataclass(frozen=True, eq=False, slots=True)
class PoseMeasurement:
    """Position, heading and size of a detection from its pose, with their uncertainty."""

    place: Array
    """(2,) world x, y, metres, on the ground under the middle of the box."""
    covariance: Array
    """(2, 2) covariance of the position, square metres."""
    height: float
    """z of the road there, metres."""
    heading: float
    """Heading, radians, counter-clockwise from world x."""
    heading_sigma: float
    """Standard deviation of the heading, radians."""
    size_lwh: Array
    """(3,) length, width, height, metres."""
    kind: str
    """Body type."""


@dataclass(frozen=True, eq=False, slots=True)
class Detection:
    """Vehicle that was detected in one image."""

    bbox: Array
    """(4,) x, y, width, height, pixels."""
    score: float
    truth_id: int | None
    """Ground-truth track of the vehicle, labelled or matched; None if there is none."""
    pose: PoseMeasurement | None
    """Pose of the vehicle; None if the pose solver rejected it or was not run."""
    link: int | None = None
    """Number that the detections of one vehicle share from frame to frame, from boxes and followed points; None: not
    known."""
    refused: str | None = None
    """Reason why the pose solver rejected the pose; None also if no pose was estimated, as between key frames."""


def detections_of(image: Located, *, linked: bool = True) -> list[Detection]:
    """Return the vehicles of an image as tracker input. `linked`: store their numbers in `Detection.link`."""
    view, poses = image.view, image.poses
    out = []
    for i, good in enumerate(image.good):
        pose = PoseMeasurement(
            place=poses.position[i, :2],
            covariance=poses.covariance[i, :2, :2] + LEAST_SIGMA_M**2 * np.eye(2),
            height=float(poses.position[i, 2]),
            heading=float(poses.yaw[i]),
            heading_sigma=float(np.sqrt(poses.covariance[i, 3, 3])),
            size_lwh=poses.size_lwh[i],
            kind=poses.types[i],
        )
        vehicle = view.truth[i]
        truth = vehicle.track_id if vehicle else None
        link = int(view.tracks[i]) if linked and view.tracks[i] >= 0 else None
        reason = poses.refusal[i] if poses.refusal[i] != INTERPOLATED_REASON else None
        out.append(Detection(view.boxes[i], float(view.scores[i]), truth, pose if good else None, link, reason))
    return out


def detection_to_dict(detection: Detection) -> dict[str, Any]:
    """Return JSON values of a detection, not rounded."""
    values = {"bbox": detection.bbox.tolist(), "pose": None}
    values |= {name: getattr(detection, name) for name in ("score", "truth_id", "link", "refused")}
    if (pose := detection.pose) is not None:
        arrays = {name: getattr(pose, name).tolist() for name in ("place", "covariance", "size_lwh")}
        values["pose"] = {pose_field.name: getattr(pose, pose_field.name) for pose_field in fields(pose)} | arrays
    return values


def detection_from_dict(values: Mapping[str, Any]) -> Detection:
    """Return the detection of JSON values from `detection_to_dict`."""
    pose = values["pose"]
    if pose is not None:
        pose = PoseMeasurement(
            **{**pose, **{name: np.array(pose[name]) for name in ("place", "covariance", "size_lwh")}}
        )
    plain = {name: values[name] for name in ("score", "truth_id", "link", "refused")}
    return Detection(bbox=np.array(values["bbox"]), pose=pose, **plain)
