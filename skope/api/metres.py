"""From an image to the road: cameras, poses of vehicles in metres, and tracks."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from skope.camera.model import Camera
from skope.errors import UserError

if TYPE_CHECKING:
    from skope.detections import Detections
    from skope.pose.pose_records import Located
    from skope.tracking.track_list import Tracks


def read_camera(path: str | Path) -> Camera:
    """Read a camera with its pose in the world.

    Args:
        path: A file of `skope eval camera` or `save_camera`, an OpenCV .yml or .xml file, a TUMTraf or Rope3D
            calibration, or an annotation file (the camera of its first image). `distortion_model` of a .yml file names
            the lens model: equidistant (fisheye) or plumb_bob (Brown).

    Returns:
        The camera. `project` maps (N, 3) points in metres to pixels; `position` (3,) is in metres. If the file has four
        distortion coefficients and no lens model, Brown's model is assumed, with an `AssumptionWarning`.

    Raises:
        UserError: The file cannot be read, its lens model is unknown, or it has no pose of the camera.
    """
    from skope.dataset import camera_of_file

    camera, posed = camera_of_file.read_camera(Path(path))
    if not posed:
        raise UserError(f"{path}: has no pose of the camera; `skope eval camera` can estimate it")
    return camera


def estimate_poses(detections: "Detections", camera: Camera, *, ground: float | None = 0.0) -> "Located":
    """Estimate position, heading and size of the vehicles of one image, in metres.

    Args:
        detections: Detections of the image. Drop weak ones first, for example with `detections.above(0.5)`.
        camera: Camera of the image, for example from `read_camera`, with the image's aspect ratio.
        ground: Height of the level road in the camera's world, metres. None: unknown; distance then follows from the
            size of the vehicles, and is less exact.

    Returns:
        The vehicles in the order of the detections. `poses` has `position` (N, 3) in metres, `yaw` (N,) in radians,
        counter-clockwise from world x, `size_lwh` (N, 3) in metres, `covariance` (N, 4, 4), `types`, the reason for a
        missing pose in `refusal`, and `flags`. `good` (N,) is true for vehicles with a pose; other values are NaN.
        Vehicles that were only tracked from other frames have no pose.

    Raises:
        UserError: The camera and the image differ in aspect ratio.
    """
    from skope.camera.ground_plane import Ground
    from skope.dataset.camera_of_file import sized
    from skope.pose.estimate_pose import estimate_poses as solve
    from skope.pose.keypoint_views import view_of
    from skope.pose.pose_records import INTERPOLATED_REASON, Located

    own = sized(camera, detections.size, "image")
    view = view_of(detections)
    road = None if ground is None else Ground(height=ground)
    found = ~view.interpolated
    poses = solve(own, view.found[found], sigma_px=view.sigma_px[found], ground=road, cut=view.cut[found])
    return Located(view, own, poses if found.all() else poses.among(found, INTERPOLATED_REASON))


def track(frames: "Iterable[Located]", times_s: Sequence[float]) -> "Tracks":
    """Track vehicles through the frames of one camera.

    Args:
        frames: Results of `estimate_poses`, one per frame.
        times_s: Time of each frame, seconds, increasing.

    Returns:
        A list of tracks with smoothed `position` (M, 3), `velocity` (M, 2), `heading` (M,) and `speed` (M,) for the M
        `frames` of the vehicle, numbered from 0. `to_csv` writes the list; `at` returns the vehicles of a frame.

    Raises:
        ValueError: The times do not increase.
    """
    from skope.tracking.track_list import Tracks
    from skope.tracking.tracker_inputs import detections_of
    from skope.tracking.vehicle_tracker import track_vehicles
    from skope.tracks.csv_file import as_written
    from skope.traffic.observation import Observation

    if (np.diff(times_s) <= 0).any():
        raise ValueError("times_s: expected increasing times")
    seconds = np.asarray(times_s, dtype=np.float64)
    tracks = track_vehicles((detections_of(one) for one in frames), times_s)
    return Tracks([as_written(one) for one in tracks], Observation(times_s=seconds))
