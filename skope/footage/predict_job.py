"""A run of a checkpoint on footage: its settings, its identity in the output folder, and its track numbers."""

import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from skope.camera.model import Camera
from skope.detector.device import choose_device
from skope.detector.network_settings import Settings
from skope.files.atomic import sha256_of
from skope.files.json_files import read_json
from skope.files.output_folders import WORK_FILE, claim_output
from skope.footage.confirmation import CONFIRMATION_LIMITS
from skope.footage.key_frames import KEY_FRAME_LIMITS
from skope.metrics.thresholds import KEPT_SCORE
from skope.schema import CATEGORY_NAMES, AnyResult, Found
from skope.tracking.box_links import LINK_LIMITS, BoxLinks
from skope.types import Integers32
from skope.video.footage import FOUND_AT, Footage


class Numbering(Protocol):
    """Assigns numbers to the road users of one category, as `skope.footage.confirmation.Confirmation`
    does."""

    def add(self, time_s: float, found: Sequence[Found]) -> None: ...

    def confirmed(self) -> list[Integers32]: ...


class Linked:
    """Numbers all detections above a score, confirmed or not."""

    def __init__(self, score: float) -> None:
        self._score, self._links = score, BoxLinks()
        self._numbers: list[Integers32] = []

    def add(self, time_s: float, found: Sequence[Found]) -> None:
        """Add the detections of the next frame."""
        sure = np.array([detection.score > self._score for detection in found], dtype=bool)
        self._numbers.append(np.where(sure, self._links.add(time_s, found), -1).astype(np.int32))

    def confirmed(self) -> list[Integers32]:
        """Return for each frame the number of each detection, from 0; -1 for lower scores."""
        return self._numbers


class NumbersByCategory:
    """Numbering per category with consecutive ranges of numbers; vehicles have the first ones."""

    def __init__(self, make: Callable[[], Numbering]) -> None:
        self._of_category = {number: make() for number in range(1, 1 + len(CATEGORY_NAMES))}
        self._categories: list[Integers32] = []
        """(N,) category ids of the detections, per frame."""

    def add(self, time_s: float, found: Sequence[AnyResult]) -> None:
        """Add the detections of the next frame."""
        categories = np.array([result.category_id for result in found], dtype=np.int32)
        self._categories.append(categories)
        for category, numbering in self._of_category.items():
            numbering.add(time_s, [result for result in found if result.category_id == category])

    def confirmed(self) -> list[Integers32]:
        """Return for each frame the number of each detection's road user, from 0; -1 if not confirmed."""
        out = [np.full(len(categories), -1, dtype=np.int32) for categories in self._categories]
        count = 0
        for category, numbering in self._of_category.items():
            numbers = numbering.confirmed()
            for of_frame, categories, frame_numbers in zip(out, self._categories, numbers, strict=True):
                of_frame[categories == category] = np.where(frame_numbers >= 0, frame_numbers + count, -1)
            count += 1 + max((int(frame_numbers.max()) for frame_numbers in numbers if len(frame_numbers)), default=-1)
        return out


PROGRESS_FILE: Final = ".predict.jsonl"
"""File with a row per processed frame, until the results are written."""


@dataclass(frozen=True, kw_only=True)
class PredictJob:
    """Settings of a run of a checkpoint on footage."""

    footage: Footage
    checkpoint: Path | None
    """Detector: a file, a run folder, or a name that comes with skope; None: the one that suits the footage."""
    out: Path
    settings: Settings = field(default_factory=Settings)
    score: float = KEPT_SCORE
    """Minimum score of a detection that is kept."""
    camera: Camera | None = None
    camera_info: Mapping[str, Any] = field(default_factory=dict)
    """Further fields on the camera, for the `info` of the frames."""
    overlay: bool = False
    blur: bool = False
    unconfirmed: bool = False
    """Whether to keep detections in a video that its other frames do not confirm."""
    every_frame: bool = False
    """Whether the detector runs on every frame of a video, not on key frames only."""

    @property
    def key_every(self) -> int:
        """Number of frames from one key frame to the next. 1: the detector runs on every frame.

        The result is above 1 only on a CPU, and only for recorded footage with a frame rate that is high enough to
        follow vehicles through the frames in between.
        """
        dense = self.footage.fps is not None and self.footage.fps * LINK_LIMITS.frame_gap_s >= 1
        if self.every_frame or not dense or choose_device(self.settings.device).type != "cpu":
            return 1
        return max(1, round(KEY_FRAME_LIMITS.interval_s * (self.footage.fps or 0.0)))

    @property
    def detector_settings(self) -> Settings:
        """Settings with which the detector is loaded."""
        # The frames of a live stream must not wait for a full batch.
        batch_size = self.settings.batch_size or (1 if self.footage.live else None)
        return replace(self.settings, min_score=self.least_score, batch_size=batch_size, one_size=self.footage.one_size)

    @property
    def least_score(self) -> float:
        """Minimum score of the detector's results: weak ones continue vehicles of a video."""
        return min(self.score, CONFIRMATION_LIMITS.weak_score) if self.confirms else self.score

    @property
    def confirms(self) -> bool:
        """Whether detections are confirmed by other frames: in a video, unless its frame rate is too low."""
        return self.links and not self.unconfirmed

    @property
    def links(self) -> bool:
        """Whether vehicles are followed from frame to frame."""
        dense = self.footage.fps is None or self.footage.fps * LINK_LIMITS.frame_gap_s >= 1
        return self.footage.clip is not None and dense


def claim(job: PredictJob, files: Sequence[Path]) -> None:
    """Claim the output folder for this footage, a predictor's files and settings; overlays may be added later."""
    cut, settings = job.footage.cut, job.settings
    options = {
        "source": _killed_source(job) or content_of(job.footage),
        "every": cut.every,
        "fps": job.footage.clip.given_fps if job.footage.clip else None,
        "start": cut.start_s,
        "end": cut.end_s if math.isfinite(cut.end_s) else None,
        "score": job.score,
        "backend": settings.backend,
        "precision": settings.precision,
        "min_size": settings.min_size,
        "tiles": settings.tiles,
        "unconfirmed": job.unconfirmed,
        "key_every": job.key_every,
        "camera": job.camera.to_dict() if job.camera else None,
    }
    claim_output(job.out, "skope eval predict", files, options)


def _killed_source(job: PredictJob) -> str | None:
    """Return the source of a killed run of a live stream in the output folder; None: there was none."""
    if not job.footage.live or not (job.out / PROGRESS_FILE).is_file() or not (job.out / WORK_FILE).is_file():
        return None
    held = read_json(job.out / WORK_FILE)
    options = held.get("options") if isinstance(held, dict) else None
    source = options.get("source") if isinstance(options, dict) else None
    return source if isinstance(source, str) and source.startswith(f"{job.footage.name} of ") else None


def content_of(footage: Footage) -> str:
    """Return the identity of the frames: checksums of files or of an address (it may hold a password); or the time."""
    if footage.live:
        return f"{footage.name} of {datetime.now(UTC).isoformat()}"
    if footage.clip and footage.clip.on_server:
        return f"{footage.name}, {hashlib.sha256(footage.clip.address.encode()).hexdigest()[:16]}"
    files = [Path(footage.clip.address)] if footage.clip else footage.images
    digest = hashlib.sha256(" ".join(map(sha256_of, files)).encode()).hexdigest()
    return f"{footage.name}, {len(files)} files, {digest[:16]}" if footage.images else f"{footage.name}, {digest[:16]}"


def found_at(job: PredictJob) -> dict[str, str]:
    """Return the path of the footage relative to the output folder, so that both may be moved together."""
    location = job.footage.location
    return {FOUND_AT: os.path.relpath(location.resolve(), job.out.resolve())} if location else {}
