"""From an image to the road: the camera, where vehicles are, and their tracks through located frames."""

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
        path: What `skope eval camera` or `save_camera` wrote, OpenCV's .yml or .xml, a TUMTraf or Rope3D calibration,
            or an annotation file (the camera of its first image). `distortion_model` of a .yml names the
            lens, as equidistant (fisheye) or plumb_bob (Brown's).

    Returns:
        The camera: `project` takes (N, 3) places in metres to pixels, `position` (3,) is where it hangs. Four
        coefficients of a lens whose model the file does not name are taken for Brown's, with an `AssumptionWarning`.

    Raises:
        UserError: The file cannot be read, its lens model is not known, or it does not say where the camera hangs.
    """
    from skope.dataset import camera_of_file

    camera, posed = camera_of_file.read_camera(Path(path))
    if not posed:
        raise UserError(f"{path}: does not say where the camera hangs; `skope eval camera` finds that out")
    return camera


def locate(detections: "Detections", camera: Camera, *, ground: float | None = 0.0) -> "Located":
    """Position, heading and size of the vehicles of one image, in metres.

    Args:
        detections: What the detector found; drop weak ones before, as in `detections.above(0.5)`.
        camera: The image's camera, as `read_camera` reads it; of the image's size, or a multiple.
        ground: Height of the level road in the camera's world, metres; None where it is unknown: then the size of
            vehicles tells how far away they are, and less exactly.

    Returns:
        The vehicles in the order of the detections: its `poses` hold `position` (N, 3), `yaw` (N,) in radians
        counter-clockwise from world x, `size_lwh` (N, 3), `covariance` (N, 4, 4), `types`, and what to distrust in
        `refusal` and `flags`; its `good` (N,) says which vehicles have a pose. The numbers of the others are NaN, also
        of those that were followed from other frames, whose keypoints measure nothing anew.

    Raises:
        UserError: The camera's shape is not the image's.
    """
    from skope.camera.ground_plane import Ground
    from skope.dataset.camera_of_file import sized
    from skope.pose.estimate_pose import locate as solve
    from skope.pose.keypoint_views import view_of
    from skope.pose.pose_records import INTERPOLATED_REASON, Located

    own = sized(camera, detections.size, "image")
    view = view_of(detections)
    road = None if ground is None else Ground(height=ground)
    found = ~view.interpolated
    poses = solve(own, view.found[found], sigma_px=view.sigma_px[found], ground=road, cut=view.cut[found])
    return Located(view, own, poses if found.all() else poses.among(found, INTERPOLATED_REASON))


def track(frames: "Iterable[Located]", times_s: Sequence[float]) -> "Tracks":
    """Follow vehicles through the frames of one camera.

    Args:
        frames: What `locate` gave for each frame.
        times_s: The time of each frame, seconds, rising.

    Returns:
        A list of tracks with smoothed `position` (M, 3), `velocity` (M, 2), `heading` (M,) and `speed` (M,) in each of
        the vehicle's M `frames`, numbered from 0. `to_csv` writes them, `at` gives the vehicles of a frame.

    Raises:
        ValueError: The times do not rise.
    """
    from skope.tracking.track_list import Tracks
    from skope.tracking.tracker_inputs import detections_of
    from skope.tracking.vehicle_tracker import follow
    from skope.tracks.csv_file import as_written
    from skope.traffic.observation import Observation

    if (np.diff(times_s) <= 0).any():
        raise ValueError("times_s: expected times that rise from frame to frame")
    seconds = np.asarray(times_s, dtype=np.float64)
    tracks = follow((detections_of(one) for one in frames), times_s)
    return Tracks([as_written(one) for one in tracks], Observation(times_s=seconds))
