"""Times at which the camera observed the road, which distinguish an empty road from an unobserved one."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.calibration_files import camera_of_json, uncertain_of_json
from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.files.json_files import check_version, read_json
from skope.records import check_share, is_number, value_of
from skope.tracks.csv_file import TRACKS_CSV
from skope.tracks.track import Track
from skope.traffic.counting_intervals import time_of
from skope.types import Array

FOOTAGE_FILE: Final = "footage.json"
"""Name of the file with frame times and camera that `skope eval track` writes beside the tracks."""


@dataclass(frozen=True)
class ObservationLimits:
    """Durations that define a gap in an observation."""

    version: int = 1
    """Version of the format of `footage.json`."""
    gap_s: float = 1.0
    """Minimum time between two frames at a gap, seconds; the time must also exceed `gap_steps`."""
    gap_steps: float = 3.0
    """Minimum time between two frames at a gap, in usual frame intervals; the time must also exceed `gap_s`."""
    cut_s: float = 1.0
    """Time from an end of the footage, or from a gap, within which a track counts as cut off by it, seconds."""


OBSERVATION_LIMITS: Final = ObservationLimits()

_WITH_OFFSET: Final = "2026-11-26T10:00:00+01:00"


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """Frame times of the footage, and the calibration of its camera."""

    times_s: Array
    """(F,) times of the frames that have positions, seconds, increasing."""
    source: str = ""
    """Name of the footage."""
    common_scale_sigma: float | None = None
    """Relative standard deviation that all distances and speeds share, from the camera's calibration. None: the camera
    file has no covariance."""
    camera: Camera | None = None
    """The calibrated camera, in the world of the tracks; None: not known."""
    uncertainty: UncertainCamera | None = None
    """`camera` with the covariance of its parameters. All road users share this error, so the covariances of tracks
    exclude it. None: not known."""
    ground: Ground | None = None
    """Road surface on which positions were computed; None: not known."""
    camera_moved_s: Array = field(default_factory=lambda: np.zeros(0))
    """(M,) times of the frames after the camera was moved, seconds, increasing. `times_s` does not contain them."""
    turned: tuple[tuple[float, Camera], ...] = ()
    """Camera after each rotation within the footage, with its start time in seconds, increasing."""
    visibility_samples: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(L, 3) times (s, increasing), brightness (0 to 1) and contrast of sampled images; empty: not measured."""
    start_time: datetime | None = None
    """Time of second 0, with its zone, from the metadata of the footage; None: not available."""
    end_s: float = math.inf
    """End of the footage, seconds, if other footage begins before the usual end of the last frame."""
    parts: tuple["Observation", ...] = ()
    """Observations of the single recordings, in order, on the same time axis, each with its own camera. Empty for one
    recording."""

    @cached_property
    def spans(self) -> Array:
        """(S, 2) start and end of each period without a gap, seconds.

        The last frame of a period lasts one usual frame interval. Frames of a moved camera make a gap of any length.
        """
        if self.parts:
            return np.concatenate([part.spans for part in self.parts])
        if len(self.times_s) == 0:
            return np.zeros((0, 2))
        steps = np.diff(self.times_s)
        usual = _usual_step(self.times_s)
        moved = np.diff(np.searchsorted(self.camera_moved_s, self.times_s)) > 0
        cuts = np.flatnonzero((steps > longest_step_s(usual)) | moved)
        starts = self.times_s[np.concatenate([[0], cuts + 1]).astype(int)]
        ends = self.times_s[np.concatenate([cuts, [len(self.times_s) - 1]]).astype(int)]
        return np.stack([starts, np.minimum(ends + usual, max(self.end_s, ends[-1]))], axis=1)

    @cached_property
    def extent(self) -> tuple[float, float]:
        """Start and end of the footage, seconds. Frames after a camera move are included."""
        every = self._frame_times_s
        if not len(every):
            return 0.0, 0.0
        return float(every[0]), max(self.last_frame_s, min(self.last_frame_s + _usual_step(every), self.end_s))

    @property
    def last_frame_s(self) -> float:
        """Time of the last frame, seconds; 0 without frames."""
        return float(self._frame_times_s[-1]) if len(self._frame_times_s) else 0.0

    @cached_property
    def _frame_times_s(self) -> Array:
        """Times of all frames, seconds, increasing; also of those after a camera move."""
        return np.union1d(self.times_s, self.camera_moved_s)

    @cached_property
    def recording_starts_s(self) -> Array:
        """(R - 1,) start times of the second and later recordings, seconds; empty for one recording."""
        return np.array([part.extent[0] for part in self.parts[1:]])

    def recording_at(self, time_s: float) -> int:
        """Return the number, from 1, of the recording that contains a time or was the last to start before it."""
        return 1 + int(np.searchsorted(self.recording_starts_s, time_s, side="right"))

    @property
    def observed_s(self) -> float:
        """Total observed time, seconds."""
        return self.seconds_in(-math.inf, math.inf)

    def seconds_in(self, begin_s: float, end_s: float) -> float:
        """Return the observed time between `begin_s` and `end_s`, seconds."""
        spans = np.clip(self.spans, begin_s, end_s)
        return float((spans[:, 1] - spans[:, 0]).sum())

    def together(self, first_s: float, second_s: float) -> bool:
        """Return whether the road was observed without a gap between two times."""
        low, high = sorted((first_s, second_s))
        return bool(((self.spans[:, 0] <= low) & (high <= self.spans[:, 1])).any())

    def is_cut(self, time_s: float) -> bool:
        """Return whether a track that begins or ends at a time is cut off by an end of the footage or by a gap."""
        return not len(self.spans) or bool(np.abs(self.spans - time_s).min() < OBSERVATION_LIMITS.cut_s)

    def pixels_per_metre(self, position: Array) -> float | None:
        """Return the image size of one metre at a road position (2,), pixels per metre; None: not known.

        The metre is perpendicular to the viewing direction. With several recordings this is the smallest value.
        """
        if self.parts:
            known = [value for value in (part.pixels_per_metre(position) for part in self.parts) if value is not None]
            return min(known, default=None)
        if self.camera is None:
            return None
        return float(self.camera.K[0, 0]) / max(1.0, math.dist(self.camera.position, (*map(float, position), 0.0)))

    def total_sigma(self, sigma: float, value: float) -> float:
        """Return the standard deviation of a single speed or length, including the camera's common scale error.

        Args:
            sigma: Standard deviation for an exactly known camera.
            value: The speed or length, in the unit of `sigma`.
        """
        return math.hypot(sigma, (self.common_scale_sigma or 0.0) * value)

    def with_camera_error(self, track: Track) -> Track:
        """Return the track with the camera's error in its covariance and speed errors, for showing a single track.

        Do not use the result to measure traffic, because all tracks share one camera error.
        """
        recording = self.parts[self.recording_at(float(track.times_s[0])) - 1] if self.parts else self
        speed_sigma = np.hypot(track.speed_sigma, (self.common_scale_sigma or 0.0) * track.speed)
        known = recording.uncertainty
        if known is None:
            return replace(track, speed_sigma=speed_sigma)
        slope = recording.ground.slope if recording.ground else (0.0, 0.0)
        found = known.covariance_at(track.position, slope)
        visible = np.asarray(np.isfinite(found).all(axis=(1, 2)))
        away = np.linalg.norm(track.xy - known.camera.position[:2], axis=1)
        unseen = ((self.common_scale_sigma or 0.0) * away)[:, None, None] ** 2 * np.eye(2)
        added = np.where(visible[:, None, None], found, unseen)
        return replace(track, covariance=track.covariance + added, speed_sigma=speed_sigma)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `footage.json`."""
        return {
            "version": OBSERVATION_LIMITS.version,
            "source": self.source,
            "times_s": [round(float(time), 4) for time in self.times_s],
            "moved_times_s": [round(float(time), 4) for time in self.camera_moved_s],
            "common_scale_sigma": self.common_scale_sigma,
            "camera": None if self.camera is None else _camera_dict(self.camera, self.uncertainty),
            "ground": None if self.ground is None else asdict(self.ground),
            **({"turned": [self._turned_dict(*turn) for turn in self.turned]} if self.turned else {}),
            "visibility_samples": self.visibility_samples.tolist(),
            **({} if self.start_time is None else {"start_time": self.start_time.isoformat()}),
        }

    @staticmethod
    def _turned_dict(from_s: float, camera: Camera) -> dict[str, Any]:
        return {"from_s": round(from_s, 4), **_camera_dict(camera, None)}


def longest_step_s(usual_s: float) -> float:
    """Return the longest time between two frames without a gap, seconds, for a usual frame interval."""
    return max(OBSERVATION_LIMITS.gap_s, OBSERVATION_LIMITS.gap_steps * usual_s)


def frame_durations_s(
    times_s: Array, begin_s: float, end_s: float, recording_starts_s: Sequence[float] | Array = ()
) -> Array:
    """Return the time in an interval that each frame covers, seconds.

    A frame lasts until the next frame. Before a gap (see `Observation.spans`) it lasts one usual frame interval.

    Args:
        times_s: (N,) times of the frames, seconds, increasing.
        begin_s: Start of the interval, seconds.
        end_s: End of the interval, seconds.
        recording_starts_s: Start times of the second and later recordings, seconds. No frame extends into the next
            recording.

    Returns:
        (N,) durations, seconds.
    """
    ends = [_ends(part) for part in np.split(times_s, np.searchsorted(times_s, recording_starts_s))]
    return np.asarray(np.clip(np.concatenate(ends), begin_s, end_s) - np.clip(times_s, begin_s, end_s))


def _ends(times_s: Array) -> Array:
    """Return the (N,) end times of the frames of one recording, seconds."""
    usual, steps = _usual_step(times_s), np.diff(times_s)
    return np.asarray(times_s + np.append(np.where(steps > longest_step_s(usual), usual, steps), usual)[: len(times_s)])


def _usual_step(times_s: Array) -> float:
    """Return the median time between consecutive frames, seconds; 0 for fewer than two frames."""
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0


def track_files(folder: Path) -> list[Path]:
    """Return the files of a folder of tracks that a report is made from."""
    return [folder / TRACKS_CSV, folder / FOOTAGE_FILE]


def read_observation(folder: Path) -> Observation:
    """Read `footage.json`, which `skope eval track` writes to a folder of tracks.

    Raises:
        UserError: The file is missing or invalid. The message names the file and the field.
    """
    path = folder / FOOTAGE_FILE
    if not path.is_file():
        raise UserError(f"{path}: no such file; `skope eval track` writes it beside the tracks")
    document = read_json(path)
    if not isinstance(document, dict):
        raise UserError(f"{path}: expected an object")
    check_version(path, document.get("version"), OBSERVATION_LIMITS.version)
    times = _numbers(path, document, "times_s")
    if (np.diff(times) <= 0).any():
        raise UserError(f"{path}: times_s: expected increasing times")
    sigma = document.get("common_scale_sigma")
    check_share(f"{path}: common_scale_sigma", sigma)
    camera, uncertainty = _read_camera(path, document.get("camera"))
    source = document.get("source")
    return Observation(
        times_s=times,
        source=source if isinstance(source, str) else "",
        common_scale_sigma=document.get("common_scale_sigma"),
        camera=camera,
        uncertainty=uncertainty,
        ground=value_of(document.get("ground"), Ground | None, f"{path}: ground"),
        camera_moved_s=np.unique(_numbers(path, document, "moved_times_s")),
        turned=_read_turned(path, document.get("turned", [])),
        visibility_samples=checked_visibility(document.get("visibility_samples"), f"{path}: visibility_samples"),
        start_time=None
        if document.get("start_time") is None
        else read_start_time(document["start_time"], f"{path}: start_time"),
    )


def _camera_dict(camera: Camera, uncertainty: UncertainCamera | None) -> dict[str, Any]:
    covariance = {} if uncertainty is None else {"covariance": uncertainty.covariance_dict()}
    return {"width": camera.width, "height": camera.height, **camera.to_dict(), **covariance}


def _read_camera(path: Path, value: Any) -> tuple[Camera | None, UncertainCamera | None]:
    """Return the camera of `footage.json` and its covariance, if present."""
    if value is None:
        return None, None
    if not isinstance(value, dict):
        raise UserError(f"{path}: camera: expected an object, or null")
    try:
        camera = camera_of_json(path, value)
        return camera, uncertain_of_json(path, value, camera)
    except UserError as error:
        raise UserError(f"{path}: camera: {str(error).removeprefix(f'{path}: ')}") from None


def _read_turned(path: Path, value: Any) -> tuple[tuple[float, Camera], ...]:
    """Return the turned cameras of `footage.json` with their start times."""
    if not isinstance(value, list) or not all(
        isinstance(entry, dict) and is_number(entry.get("from_s")) for entry in value
    ):
        raise UserError(f"{path}: turned: expected cameras, each with from_s")
    cameras = [_read_camera(path, entry)[0] for entry in value]
    return tuple((float(entry["from_s"]), camera) for entry, camera in zip(value, cameras, strict=True) if camera)


def checked_visibility(rows: Any, where: str) -> Array:
    """Return (L, 3) `Observation.visibility_samples` from rows of a file.

    Raises:
        UserError: The rows are invalid. The message begins with `where`.
    """
    if rows == []:
        return np.zeros((0, 3))
    try:
        values = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all() or (np.diff(values[:, 0]) <= 0).any():
        raise UserError(f"{where}: expected rows of time, brightness and contrast, with increasing times")
    return values


def read_start_time(text: Any, where: str) -> datetime:
    """Return the time that a text gives, which must include its UTC offset.

    Raises:
        UserError: The text is no such time. The message begins with `where`.
    """
    start_time = time_of(text, where, _WITH_OFFSET)
    if start_time.tzinfo is None:
        raise UserError(f"{where}: expected a time with its UTC offset, like {_WITH_OFFSET}, got {text!r:.40}")
    return start_time


def _numbers(path: Path, document: dict[str, Any], name: str) -> Array:
    values = document.get(name)
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        raise UserError(f"{path}: {name}: expected a list of numbers")
    numbers = np.array(values, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise UserError(f"{path}: {name}: expected finite numbers")
    return numbers
