"""Videos, streams and folders of images, frame by frame, with detections and tracks."""

import itertools
import math
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

from skope.camera.model import Camera
from skope.dataset import coco
from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.detections import Detections, detections_of_results
from skope.errors import UserError
from skope.records import check_number
from skope.schema import AnyResult, Image
from skope.types import Pixels

if TYPE_CHECKING:
    from skope.camera.fit.fit_camera import CameraEstimate
    from skope.detector.predictor import Predictor
    from skope.footage.predict_job import PredictJob
    from skope.pose.keypoint_views import Scene
    from skope.tracking.track_list import TrackedRoadUser, Tracks
    from skope.video.footage import Footage

RoadHeight = float | Literal["auto", "fit"] | None
"""Height of the level road in the camera's world, metres, or the way to find it; see `Detector.video`."""
_HIGHEST_M = 10_000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoFrame:
    """A frame of a video with its detections and tracks."""

    image: Pixels
    """(H, W, 3) RGB."""
    index: int
    """Index of the frame among those that were taken, from 0."""
    name: str
    """Name of the image file; for a video, its name and the number of the frame."""
    time_s: float | None
    """Seconds since the first frame of the video; None for image files without a frame rate."""
    detections: Detections
    """Vehicles and other road users. Vehicles that are tracked from frame to frame have `numbers`."""
    tracks: "tuple[TrackedRoadUser, ...]" = ()
    """Road users in metres; empty if the video has no camera."""
    _all_tracks: "Tracks | None" = field(default=None, repr=False)

    def draw(self) -> Pixels:
        """Return a copy of the image with tracks (number, class, speed), or detections and their scores."""
        if self._all_tracks is not None:
            return self._all_tracks.draw(self.image, self.index)
        return self.detections.draw(self.image)


class Video:
    """Footage with its detections; made by `Detector.video`.

    Iterating over it yields one `VideoFrame` after the other. Without a camera, frames come as they are read. With a
    camera, the whole video is processed first, because later frames improve earlier positions. Detections that no
    other frame confirms are then dropped, and each frame has its `tracks`.
    """

    def __init__(
        self, job: "PredictJob", predictor: "Predictor", *, ground: RoadHeight = "auto", image_fps: float | None = None
    ) -> None:
        self._job, self._predictor = job, predictor
        self._ground, self._image_fps = ground, image_fps

    @property
    def fps(self) -> float | None:
        """Frame rate, frames per second; None for live streams and for image files without a frame rate."""
        return self._image_fps or self._footage.fps

    def _time(self, image: Image, index: int) -> float | None:
        """Return the time of a frame, seconds."""
        return image.time_s if self._image_fps is None else index / self._image_fps

    @property
    def skipped(self) -> tuple[str, ...]:
        """Parts of the footage that could not be read until now, one line of text each."""
        return tuple(self._footage.skipped)

    @property
    def _footage(self) -> "Footage":
        return self._job.footage

    def __iter__(self) -> Iterator[VideoFrame]:
        return self._with_detections() if self._job.camera is None else self._with_tracks()

    def _with_detections(self) -> Iterator[VideoFrame]:
        """Yield the frames as they are read."""
        from skope.footage.predict_footage import found_in

        pictures = _Pictures()
        found_in_each = found_in(self._job, self._predictor.reporting(self._job.score), watched=[pictures])
        for index, (image, found, _) in enumerate(found_in_each):
            kept = (one for one in found if one.score > self._job.score)
            yield VideoFrame(
                image=pictures.taken.pop(image.id),
                index=index,
                name=image.file_name,
                time_s=self._time(image, index),
                detections=self._detections(kept, image),
            )

    def _with_tracks(self) -> Iterator[VideoFrame]:
        """Yield the frames in a second pass, after all tracks are known."""
        tracks, folder = self.tracks(), Path(self._results.name)
        images = coco.read(folder / FRAMES_FILE).images
        results = itertools.groupby(coco.iter_all_results(folder / PREDICTIONS_FILE), lambda one: one.image_id)
        image_id, found = next(results, (None, iter(())))
        numbers = {image.id: index for index, image in enumerate(images)}
        for image, pixels in self._footage.frames():
            if image.id not in numbers:  # the file has changed
                continue
            own: Iterable[AnyResult] = ()
            if image.id == image_id:
                own = list(found)
                image_id, found = next(results, (None, iter(())))
            index = numbers[image.id]
            yield VideoFrame(
                image=pixels,
                index=index,
                name=image.file_name,
                time_s=self._time(image, index),
                detections=self._detections(own, image),
                tracks=tracks.at(index),
                _all_tracks=tracks,
            )

    def _detections(self, found: Iterable[AnyResult], image: Image) -> Detections:
        return detections_of_results(found, (image.width, image.height), self._predictor.scheme)

    def tracks(self) -> "Tracks":
        """Track the road users of the whole video in metres, as `skope eval track` does. The result is kept.

        Returns:
            A list of `skope.tracks.track.Track` with smoothed `position` (M, 3) in metres, `velocity` (M, 2) in m/s,
            `heading` (M,) in radians and `speed` (M,) in m/s for the M `frames` of a road user; `category` is its
            class. `to_csv` writes the list. `skope.count` and `skope.measure_traffic` accept it.

        Raises:
            UserError: The video has no camera or cannot be read, or its images have no times (give `fps`).
        """
        if self._job.camera is None:
            raise UserError(f"{self._footage.name}: tracks need a camera: video(source, camera=...)")
        return self._tracks

    @cached_property
    def _tracks(self) -> "Tracks":
        from skope.camera.fit.fit_ground import with_fitted_ground
        from skope.terminal.console import SilentConsole
        from skope.tracking.track_footage import (
            TrackJob,
            followed,
            observation_of,
            poses_kept,
            start_time_of,
            times_of,
        )
        from skope.tracking.track_list import Tracks

        score = self._job.score
        scene = self._scene(0.0 if isinstance(self._ground, str) else self._ground)
        if isinstance(self._ground, str):
            scene, _ = with_fitted_ground(scene, self._ground, score=score, noise=0.0, sigma_px=None)
        folder = Path(self._results.name)
        job = TrackJob(
            scene=scene,
            place=folder,
            out=folder,
            fps=None,
            start_time=None,
            noise=0.0,
            score=score,
            sigma_px=None,
            video=False,
            overlay=False,
        )
        times = times_of(scene, self._image_fps)
        progress = poses_kept(folder)
        try:
            tracks = followed(job, times, progress, Counter[str](), SilentConsole())
        finally:
            progress.end()
        index = [i if image.frame_index is None else image.frame_index for i, image in enumerate(scene.file.images)]
        observation = observation_of(scene, times, start_time_of(scene, job.start_time))
        return Tracks(tracks, observation, frame_index=index)

    def estimate_camera(
        self, *, height_m: float | None = None, fov_deg: float | None = None, max_vehicles: int = 40
    ) -> "CameraEstimate":
        """Estimate the camera from the vehicles of the whole video, as `skope eval camera` does.

        Args:
            height_m: Height of the camera above the road, metres, if known.
            fov_deg: Horizontal field of view, degrees, if known.
            max_vehicles: Maximum number of vehicles to use.

        Returns:
            The estimate. Its `camera` is above (0, 0) and looks along x. `sigma_focal`, `sigma_height` and others are
            standard deviations.

        Raises:
            UserError: The vehicles do not determine the camera (the message has the reason), or an argument is out of
                range.
        """
        from skope.camera.fit.write_camera import camera_of_vehicles

        for name, value, most in (("height_m", height_m, 200.0), ("fov_deg", fov_deg, 170.0)):
            if value is not None:
                check_number(name, value, 0.5, most)
        check_number("max_vehicles", max_vehicles, 5, math.inf)
        return camera_of_vehicles(self._scene(None), max_vehicles, height=height_m, fov_deg=fov_deg).estimate

    def _scene(self, ground: float | None) -> "Scene":
        from skope.pose.keypoint_views import read_scene

        return read_scene(Path(self._results.name), None, None, None, ground)

    @cached_property
    def _results(self) -> "TemporaryDirectory[str]":
        """Temporary folder with predictions and frames of the whole video, as `skope eval predict` writes them."""
        from skope.footage.predict_footage import Prediction
        from skope.terminal.console import SilentConsole

        if self._footage.live:
            raise UserError(f"{self._footage.name}: a live stream has no end: record it to a file first")
        folder = TemporaryDirectory(prefix="skope-video-")
        prediction = Prediction(replace(self._job, out=Path(folder.name)), self._predictor)
        for _ in prediction.frames():
            pass
        prediction.write(SilentConsole())
        return folder


class _Pictures:
    """Buffer of frames that wait for their detections."""

    def __init__(self) -> None:
        self.taken: dict[int, Pixels] = {}

    def watch(self, frames: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """Yield the same frames, and keep their pixels."""
        for image, pixels in frames:
            self.taken[image.id] = pixels
            yield image, pixels


def open_video(
    predictor: "Predictor",
    source: str | Path,
    *,
    camera: str | Path | Camera | None,
    ground: RoadHeight,
    score: float,
    every: int,
    seconds: tuple[float, float | None],
    every_frame: bool,
    fps: float | None,
) -> Video:
    """Open the video that `Detector.video` returns. Computation starts with the first frame that is read.

    Args:
        predictor: The detector with its settings.
        source: A video file, an image, a folder or glob of images, or the address of a stream.
        camera: The camera, or its file as in `read_camera`; None for no tracks in metres. A camera of another image
            size is scaled, with a warning.
        ground: Height of the level road in the camera's world, metres, or another value of `Detector.video`.
        score: Score threshold, 0 to 1.
        every: Frame stride, from 1.
        seconds: Start and end in the footage, seconds; None for its end.
        every_frame: Run the detector on every frame. Otherwise it runs twice per second on a CPU.
        fps: Frame rate of image files, or of a video with missing or wrong time stamps; None for their own times.

    Raises:
        UserError: The source or the camera cannot be read, or an argument is out of range.
    """
    from skope.dataset.camera_of_file import fitted_camera, read_camera
    from skope.footage.predict_job import PredictJob
    from skope.pose.camera_error import camera_info
    from skope.video.footage import FrameRange, open_footage

    check_number("score", score, 0.0, 1.0)
    check_number("every", every, 1, math.inf)
    start_s, end_s = seconds
    check_number("start_s", start_s, 0.0, math.inf)
    if end_s is not None and not end_s > start_s:
        raise UserError(f"end_s: expected a time after start_s, {start_s:g}, got {end_s:g}")
    if isinstance(ground, str) and ground not in ("auto", "fit"):
        raise UserError(f'ground: expected metres, "auto", "fit" or None, got {ground!r}')
    if ground is not None and not isinstance(ground, str):
        check_number("ground", ground, -_HIGHEST_M, _HIGHEST_M)
    if fps is not None:
        check_number("fps", fps, 0.001, 1000.0)
    cut = FrameRange(every=every, start_s=start_s, end_s=math.inf if end_s is None else end_s)
    footage = open_footage(str(source), cut)
    if fps is not None and footage.clip is not None:
        footage = open_footage(str(source), cut, fps=fps)
    for note in footage.notes:
        warnings.warn(note, stacklevel=3)
    name, known = "camera", dict[str, Any]()
    size = None if camera is None else footage.frame_size()
    if isinstance(camera, str | Path):
        name, known = str(camera), camera_info(Path(camera))
        camera = read_camera(Path(camera), size)[0]
    if camera is not None and size is not None:
        camera, scaled = fitted_camera(camera, size, name, footage.name)
        if scaled:
            warnings.warn(scaled, stacklevel=3)
    job = PredictJob(
        footage=footage,
        checkpoint=predictor.weights,
        out=Path(),  # replaced by a temporary folder when results are kept
        settings=predictor.settings,
        score=score,
        camera=camera,
        camera_info=known,
        every_frame=every_frame,
    )
    return Video(
        job,
        predictor.reporting(job.least_score, batch_size=1 if footage.live else None),
        ground=ground,
        image_fps=fps if footage.clip is None else None,
    )
