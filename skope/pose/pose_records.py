"""Records of vehicles in the world, and the files that hold them: JSON Lines and CSV."""

import itertools
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.camera.motion.camera_motion import MOVED_REASON
from skope.files.atomic import replacing
from skope.files.csv_files import write_csv
from skope.keypoints import WHEELS
from skope.pose.camera_error import with_camera_error
from skope.pose.estimate_pose import POSE_LIMITS, Poses, VehicleKeypoints, poses_of_images
from skope.pose.keypoint_views import Scene, View
from skope.types import Array

INTERPOLATED_REASON: Final = "interpolated"
"""Reason why a vehicle between key frames has no pose: its keypoints are not a new measurement."""
_BOX_CORNERS: Final = np.array(list(itertools.product((0.5, -0.5), (0.5, -0.5), (0.0, 1.0))))
"""(8, 3) corners of a vehicle's box in its own frame, in lengths, widths and heights: front before rear, left before
right, low before high."""


@dataclass(frozen=True, eq=False)
class Located:
    """Vehicles of one image with their poses."""

    view: View
    camera: Camera
    poses: Poses

    @property
    def good(self) -> NDArray[np.bool_]:
        """(N,) whether each vehicle has a pose."""
        return np.array([reason is None for reason in self.poses.refusal], dtype=bool)


MOST_IMAGES: Final = 50
"""Maximum number of images whose poses are estimated together."""


def locate_views(views: Iterable[View], scene: Scene) -> Iterator[Located]:
    """Estimate the poses of the vehicles in images of a scene. Interpolated vehicles, and those in images after the
    camera was moved, have none."""
    for road, group in itertools.groupby(views, lambda view: scene.road_in(view.image)):
        for some in _batches(group):
            found = [~view.interpolated & (not scene.moved_in(view.image)) for view in some]
            inputs = [
                VehicleKeypoints(scene.camera_in(view.image), view.found[rows], view.sigma_px[rows], view.cut[rows])
                for view, rows in zip(some, found, strict=True)
            ]
            for view, rows, given, poses in zip(some, found, inputs, poses_of_images(inputs, road), strict=True):
                # Unlike the calibration's error, this one is independent from frame to frame and affects the tracker.
                certain = with_camera_error(poses, scene.shake_in(view.image), road)
                reason = MOVED_REASON if scene.moved_in(view.image) else INTERPOLATED_REASON
                yield Located(view, given.camera, certain if rows.all() else certain.among(rows, reason))


def _batches(views: Iterable[View]) -> Iterator[list[View]]:
    """Yield consecutive images that together have about as many vehicles as are computed together."""
    some, vehicles = list[View](), 0
    for view in views:
        some.append(view)
        vehicles += int((~view.interpolated).sum())
        if vehicles >= POSE_LIMITS.chunk_vehicles or len(some) == MOST_IMAGES:
            yield some
            some, vehicles = [], 0
    if some:
        yield some


def locate_view(view: View, scene: Scene) -> Located:
    """Estimate the poses of the vehicles in one image of a scene, as `locate_views` does."""
    return next(locate_views([view], scene))


def corners_of(T_world_vehicle: Array, size_lwh: Array) -> Array:
    """Return (8, 3) corners of a vehicle's box, world: front before rear, left before right, low before high."""
    return np.asarray((_BOX_CORNERS * size_lwh) @ T_world_vehicle[:3, :3].T + T_world_vehicle[:3, 3])


def records(located: Located) -> Iterator[dict[str, Any]]:
    """Yield the row of each vehicle in `poses.jsonl`: metres, degrees (counter-clockwise from world x), pixels."""
    view, poses = located.view, located.poses
    T_camera_world = located.camera.T_camera_world
    for i, reason in enumerate(poses.refusal):
        row: dict[str, Any] = {
            "image_id": view.image.id,
            "file_name": view.image.file_name,
            "time_s": view.image.time_s,
            "vehicle": i,
            "score": round(float(view.scores[i]), 6),
            "bbox": _rounded(view.boxes[i], 2),
            "refused": reason,
            "flags": list(poses.flags[i]),
        }
        if reason is None:
            T, size = poses.T_world_vehicle[i], poses.size_lwh[i]
            corners = corners_of(T, size)
            wheels = (poses.points[i, list(WHEELS)] * [1, 1, 0]) @ T[:3, :3].T + T[:3, 3]
            row |= {
                "type": poses.types[i],
                "position": _rounded(T[:3, 3], 4),
                "position_camera": _rounded(_camera(T_camera_world, T[:3, 3]), 4),
                "heading_deg": round(float(np.degrees(poses.yaw[i])), 3),
                "sigma_position": _rounded(np.sqrt(np.diag(poses.covariance[i])[:3]), 4),
                "sigma_heading_deg": round(float(np.degrees(np.sqrt(poses.covariance[i, 3, 3]))), 3),
                "covariance": [[float(f"{v:.6g}") for v in line] for line in poses.covariance[i]],
                "size_lwh": _rounded(size, 3),
                "box_3d": _rounded(corners, 4),
                "box_3d_camera": _rounded(_camera(T_camera_world, corners), 4),
                "wheels": _rounded(wheels, 4),
                "wheels_camera": _rounded(_camera(T_camera_world, wheels), 4),
                "T_camera_vehicle": (T_camera_world @ T).tolist(),
                "keypoints_used": int(poses.used[i].sum()),
                "rms_px": round(float(poses.rms_px[i]), 3),
            }
        yield row


_CSV_COLUMNS: Final = (
    "image_id", "file_name", "time_s", "vehicle", "score", "refused", "flags", "type",
    "x", "y", "z", "heading_deg", "sigma_x", "sigma_y", "sigma_z", "sigma_heading_deg",
    "length", "width", "height", "camera_x", "camera_y", "camera_z",
    *(f"wheel_{end}_{side}_{axis}" for end in ("front", "rear") for side in ("right", "left") for axis in "xyz"),
    "keypoints_used", "rms_px",
)  # fmt: skip


def write_poses(folder: Path, rows: Callable[[], Iterable[dict[str, Any]]]) -> list[Path]:
    """Write `poses.jsonl` and `poses.csv` into a folder; return their paths.

    `rows` yields the rows, and is called once per file: an hour of footage does not fit into memory.
    """
    paths = [folder / "poses.jsonl", folder / "poses.csv"]
    with replacing(paths[0]) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(row, allow_nan=False) + "\n" for row in rows())
    write_csv(paths[1], _CSV_COLUMNS, map(_cells, rows()), byte_order_mark=False)
    return paths


def _cells(row: dict[str, Any]) -> list[Any]:
    head = [row["image_id"], row["file_name"], row["time_s"], row["vehicle"], row["score"], row["refused"]]
    head.append(" ".join(row["flags"]))
    if row["refused"] is not None:
        return head + [""] * (len(_CSV_COLUMNS) - len(head))
    return [
        *head,
        row["type"],
        *row["position"],
        row["heading_deg"],
        *row["sigma_position"],
        row["sigma_heading_deg"],
        *row["size_lwh"],
        *row["position_camera"],
        *itertools.chain.from_iterable(row["wheels"]),
        row["keypoints_used"],
        row["rms_px"],
    ]


def _camera(T_camera_world: Array, points: Array) -> Array:
    return np.asarray(points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3])


def _rounded(values: Array, digits: int) -> Any:
    return (np.round(values, digits) + 0.0).tolist()
