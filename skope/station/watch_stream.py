"""Read the live stream of a camera of a station, and detect road users in it, window by window without a gap.

Each window becomes a folder of detections, as `skope eval predict` writes it. A folder is complete when its progress
file is gone. A process that was killed leaves an incomplete window; the next one completes it with what was detected.
"""

import contextlib
import math
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from skope.camera.model import Camera
from skope.dataset.camera_of_file import fitted_camera
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.footage.live_choice import LiveDetectorSelector
from skope.footage.predict_footage import Prediction, load_frame_detector
from skope.footage.predict_job import PROGRESS_FILE, PredictJob, claim
from skope.pose.camera_error import COVARIANCE_KEY
from skope.schema import Image
from skope.station.latest_picture import LatestPicture
from skope.station.station_file import StationCamera
from skope.station.track_windows import set_aside
from skope.terminal.console import Console, SilentConsole
from skope.video.footage import LiveStream, open_footage
from skope.video.stream_windows import StreamWindow, StreamWindows, without_frames

WINDOW_NAME: Final = "%Y-%m-%dT%H-%M-%SZ"
"""Name of a window's folder: its start in UTC."""


@dataclass(frozen=True)
class WatchLimits:
    """Waiting times of the process that reads a stream."""

    reopen_s: float = 5.0
    """Time between two attempts to open a stream, seconds."""
    state_s: float = 2.0
    """Time between two updates of the state, seconds."""


WATCH_LIMITS: Final = WatchLimits()


@dataclass(frozen=True, kw_only=True)
class StreamState:
    """State of the process that reads a stream."""

    updated: datetime
    process: int = field(default_factory=os.getpid)
    """Number of the process."""
    last_frame: datetime | None = None
    """Time of the last frame that was analysed; None: none yet."""
    frames: int = 0
    """Number of frames analysed since the process began."""
    rate: float = 0.0
    """Frames analysed per second in the current window."""
    skipped: float = 0.0
    """Share of the received frames that were not analysed in the current window."""
    delay_s: float = 0.0
    """Time from the arrival of the last frame to its detections, seconds."""
    in_view: int = 0
    """Number of road users in the last frame."""
    message: str = ""
    """Why no stream is read; empty while it is read."""

    def to_dict(self) -> dict[str, object]:
        """Return a JSON object."""
        values = asdict(self)
        return {key: value.isoformat() if isinstance(value, datetime) else value for key, value in values.items()}


class StreamWatch:
    """Detects road users in a camera's stream for as long as it runs."""

    def __init__(self, camera: StationCamera, window_s: float, settings: Settings, console: Console) -> None:
        """Prepare to read the stream of a camera.

        Args:
            camera: A camera with a stream.
            window_s: Length of the windows, seconds.
            settings: Settings of the detector.
            console: Console for messages.
        """
        assert camera.stream is not None
        self._camera, self._address, self._window_s, self._console = camera, camera.stream, window_s, console
        self._settings = settings
        self._detector: Predictor | LiveDetectorSelector | None = None
        self._state = StreamState(updated=datetime.now(UTC))
        self._saved_s = -math.inf
        self._picture = LatestPicture(camera.latest_picture, camera.site.gates, blur=camera.picture != "plain")

    def run(self) -> None:
        """Read the stream until the process is stopped (KeyboardInterrupt); open it again whenever it ends."""
        self._save(self._state)
        self._camera.latest_picture.unlink(missing_ok=True)
        while True:
            message = "the stream ended"
            try:
                stream = open_footage(self._address)
                if not isinstance(stream, LiveStream):
                    raise UserError("it is a video, not a live stream")
                stream.name = self._camera.name
                for _ in self.windows(stream):
                    pass
                message = stream.broken_off or message
            except UserError as error:
                message = str(error)
            if message != self._state.message:  # a long outage is one line
                self._console.warn(f"{self._camera.name}: {message}; trying again")
            self._save(replace(self._state, message=message))
            time.sleep(WATCH_LIMITS.reopen_s)

    def windows(self, stream: LiveStream) -> Iterator[Path]:
        """Detect road users in a stream, and yield the folder of each complete window until the stream ends.

        Windows that a killed process has left are completed first.

        Raises:
            UserError: The detector cannot be loaded, the camera does not fit the frames, or a file cannot be written.
        """
        if self._detector is None:
            job = self._job(without_frames(stream), self._camera.seen, None)
            self._detector = load_frame_detector(job, self._console)
        parts = StreamWindows(stream, self._window_s)
        for window in parts:
            camera = self._camera_of(parts.frame_size)
            self._complete(stream, camera)
            yield self._detect(window, camera)

    def _complete(self, stream: LiveStream, camera: Camera) -> None:
        """Write the results of the windows that a killed process has left; set those aside that are not its own."""
        for file in sorted(self._camera.seen.glob(f"*/{PROGRESS_FILE}")):
            try:
                self._write(self._prediction(without_frames(stream), file.parent, camera))
            except UserError as error:
                self._console.warn(f"{self._camera.name}: {error}; moved to {set_aside(self._camera, file.parent)}")

    def _detect(self, window: StreamWindow, camera: Camera) -> Path:
        """Detect road users in a window; return its folder."""
        assert window.start_time is not None
        begin = window.start_time.astimezone(UTC)
        out = self._camera.seen / begin.strftime(WINDOW_NAME)
        prediction = self._prediction(window, out, camera)
        try:
            watched = [] if self._camera.picture == "none" else [self._picture]
            for image, found in prediction.frames(watched):
                self._note(begin, image, len(found), prediction.images)
                if watched and self._detector is not None:
                    self._picture.write(found, camera, self._detector.scheme)
        finally:
            if len(prediction.images) > 1:
                self._write(prediction)
            else:  # the first image of a process, just before the end of a window
                shutil.rmtree(out)
        return out

    def _write(self, prediction: Prediction) -> None:
        """Write the results of a window, and compare its view with that of the windows before it.

        A window whose view has changed does not become the new reference: positions are wrong until the camera is
        turned back, or the station starts again with a changed site file.
        """
        held = read_json(self._camera.view) if self._camera.view.is_file() else None
        before = held["look"] if held and held["site"] == self._camera.site_sha256 else None
        prediction.write(SilentConsole(), before)
        for change in prediction.view_changes:
            self._console.warn(f"{self._camera.name}: {change}")
        if prediction.last_look is not None and not prediction.view_changes:
            write_json(self._camera.view, {"site": self._camera.site_sha256, "look": prediction.last_look})

    def _prediction(self, window: StreamWindow, out: Path, camera: Camera) -> Prediction:
        assert self._detector is not None
        job = self._job(window, out, camera)
        claim(job, self._detector.files)
        return Prediction(job, self._detector)

    def _job(self, window: StreamWindow, out: Path, camera: Camera | None) -> PredictJob:
        site_camera = self._camera.site.camera
        assert site_camera is not None
        known = site_camera.known
        return PredictJob(
            footage=window,
            checkpoint=None if self._camera.detector is None else Path(self._camera.detector),
            out=out,
            settings=self._settings,
            camera=camera,
            camera_info={COVARIANCE_KEY: known.covariance_dict()} if known else {},
        )

    def _camera_of(self, size: tuple[int, int] | None) -> Camera:
        """Return the site's camera at the size of the frames (None: not known)."""
        assert self._camera.site.camera is not None
        camera = self._camera.site.camera.camera
        return (
            fitted_camera(camera, size, f"{self._camera.site.path}: camera", self._camera.name)[0] if size else camera
        )

    def _note(self, begin: datetime, image: Image, in_view: int, images: Sequence[Image]) -> None:
        """Update the state after a frame of the window that begins at `begin`."""
        now, time_s = datetime.now(UTC), image.time_s or 0.0
        last_frame = begin + timedelta(seconds=time_s)
        received = 1 + (image.frame_index or 0) - (images[0].frame_index or 0)
        state = StreamState(
            updated=now,
            last_frame=last_frame,
            frames=self._state.frames + 1,
            rate=round((len(images) - 1) / time_s, 2) if time_s > 0 else 0.0,
            skipped=round(1 - len(images) / received, 4),
            delay_s=round((now - last_frame).total_seconds(), 3),
            in_view=in_view,
        )
        if time.monotonic() - self._saved_s > WATCH_LIMITS.state_s:
            self._save(state)
        self._state = state

    def _save(self, state: StreamState) -> None:
        self._saved_s, self._state = time.monotonic(), state
        with contextlib.suppress(UserError):  # a full disk; the camera is reported as silent
            write_json(self._camera.state, replace(state, updated=datetime.now(UTC)).to_dict())
