"""`skope eval predict`: run a checkpoint over footage, frame by frame, so that an interrupted run resumes."""

import math
import signal
import threading
from collections import Counter, defaultdict
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from skope.camera.motion.camera_motion import MOTION_KEY, CameraMotion
from skope.camera.motion.camera_shake import CameraShakeEstimator, motion_of_row, motion_to_row, record_of
from skope.camera.motion.followed_views import with_homographies
from skope.camera.motion.frame_contrast import visibility_rows
from skope.camera.motion.image_shift import ImageMotion
from skope.camera.motion.view_changes import VIEW_CHANGES, ViewChange, ViewSamples, change_since
from skope.cpu_count import usable_processors
from skope.dataset import coco
from skope.dataset.camera_of_file import with_camera
from skope.dataset.folder import (
    CHANGES_KEY,
    DETECTOR_KEY,
    FOLLOWED_KEY,
    FRAMES_FILE,
    PIXEL_WIDTH,
    PREDICTIONS_FILE,
    SKIPPED_KEY,
    START_TIME_KEY,
    VISIBILITY_KEY,
)
from skope.detector import weights
from skope.detector.predictor import Predictor
from skope.errors import UserError
from skope.files.progress import Progress
from skope.footage.confirmation import Confirmation
from skope.footage.key_frames import with_frames_between
from skope.footage.live_choice import FrameDetector, LiveDetectorSelector
from skope.footage.overlays import KeepRule, write_overlay
from skope.footage.predict_job import PROGRESS_FILE, Linked, NumbersByCategory, PredictJob, claim, found_at
from skope.schema import CATEGORY_NAMES, AnnotationFile, AnyResult, Image
from skope.terminal.console import Console, counted
from skope.tracking.box_links import LINK_LIMITS
from skope.types import Pixels
from skope.video.footage import Footage

_SHAKE_PROCESSES: Final = 4
"""Maximum number of processes that measure camera shake beside a detector that runs on every frame. The number of
processors also limits it. With fewer, a GPU would wait."""


class Watcher(Protocol):
    """Observer of the frames of footage before they are detected."""

    def watch(self, frames: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """Yield the same frames, in their order."""


def predict(job: PredictJob, console: Console) -> list[Path]:
    """Run a checkpoint over footage, and write the results to `job.out`; an interrupted run resumes.

    A live stream cannot be read again. If its run was killed, the results so far are written, and nothing more is read.

    Args:
        job: Footage and settings.
        console: Console for messages and progress.

    Returns:
        The written files. Unreadable images are listed in `job.footage.skipped`.

    Raises:
        UserError: No image can be read, or the output folder holds the output of another run.
    """
    detector = load_frame_detector(job, console)
    claim(job, detector.files)
    prediction = Prediction(job, detector)
    if job.footage.clip and not job.footage.clip.square:
        console.warn(
            f"{job.footage.name}: the video states that a pixel is {job.footage.clip.pixel_width:.2f} times as wide as "
            "high; it is used as stored. Rescale it to square pixels to detect more vehicles and calibrate the camera"
        )
    done = prediction.last
    if prediction.killed:
        console.say(f"{job.footage.name}: a run was killed here after {counted(done, 'image')}: writing its results")
    elif done:
        console.say(f"{job.footage.name}: resuming after frame {done}")
    bars = console.bar(total=len(job.footage) or None, unit="image", label=job.footage.name)
    reported = _report_notes(job.footage, 0, console)
    with bars as bar, _ended_by_terminate(job.footage):
        bar.update(done)
        try:
            with closing(prediction.frames()) as frames:
                for image, _ in frames:
                    bar.update(image.id - bar.n)
                    reported = _report_notes(job.footage, reported, console)
        except KeyboardInterrupt:
            if not job.footage.live:
                raise
            console.say(f"{job.footage.name}: stopped after {len(prediction.images)} images")
    _report_notes(job.footage, reported, console)
    return prediction.write(console)


def _report_notes(footage: Footage, reported: int, console: Console) -> int:
    """Report the notes on the footage from number `reported` on; return the number of notes."""
    for note in footage.notes[reported:]:
        console.warn(note)
    return len(footage.notes)


def load_frame_detector(job: PredictJob, console: Console) -> Predictor | LiveDetectorSelector:
    """Load a job's detector; for a live stream those that come with skope, unless another detector is requested.

    Raises:
        UserError: The detector cannot be loaded.
    """
    settings = job.detector_settings
    given = None if job.checkpoint is None else str(job.checkpoint)
    if job.footage.live and (given is None or (given in weights.BY_ACCURACY and not Path(given).exists())):
        return LiveDetectorSelector.load(given, settings, job.footage.cut.every, console)
    return Predictor.load(Path(given or weights.DEFAULT_WEIGHTS), settings, console)


class Prediction:
    """Detections in footage, stored frame by frame in a progress file, then written as results."""

    def __init__(self, job: PredictJob, detector: FrameDetector) -> None:
        """Resume after the frames that an interrupted run has stored in the job's output folder."""
        self._job, self._detector = job, detector
        self._progress = Progress(job.out / PROGRESS_FILE, ("image", "results", "skipped", "key", "look", "motion"))
        self.images: list[Image] = []
        """Frames so far, with the job's camera."""
        self._motions: list[ImageMotion | None] = []
        """Motion of each frame."""
        self._looks: list[tuple[float, str]] = []
        """Small images, with their times in seconds."""
        self._last_key = 1
        self._last_numbers: list[int] = []
        """`track_id` of each road user of the last key frame."""
        for row in self._progress.rows():
            self._keep(coco.image_from_dict(row["image"]), motion_of_row(row["motion"]), row["look"])
            if START_TIME_KEY in row["image"]:
                job.footage.start_time = datetime.fromisoformat(row["image"][START_TIME_KEY])
            if row["key"]:
                self._last_key = self.images[-1].id
                self._last_numbers = [result.get("track_id", 0) for result in row["results"]]
            job.footage.skipped += [reason for reason in row["skipped"] if reason not in job.footage.skipped]
        self.view_changes: list[ViewChange] = []
        """Changes of the view, after `write`."""
        self.killed = job.footage.live and bool(self.images)
        """Whether a run of a live stream was killed here. The stream cannot be read again, so nothing is added."""

    @property
    def last_look(self) -> str | None:
        """Small image of the end of the footage; None if the footage is too short to find a change of view."""
        return self._looks[-1][1] if len(self._looks) >= 2 * VIEW_CHANGES.lasting_frames else None

    @property
    def last(self) -> int:
        """Number of the last processed frame, from 1; 0: none."""
        return self.images[-1].id if self.images else 0

    def frames(self, watched: Sequence["Watcher"] = ()) -> Generator[tuple[Image, list[AnyResult]]]:
        """Yield the remaining frames, each with all its detections, including those that `write` drops.

        `watched` receive the frames with their pixels before the detector.
        """
        job, last = self._job, self.last
        if self.killed:
            return
        looks, shake = ViewSamples(self._looks[-1][0] if self._looks else None), _shake_estimator(job, last)
        for bare, found, key in found_in(
            job,
            self._detector,
            last=last,
            last_key=self._last_key,
            names=self._last_numbers,
            watched=(looks, shake, *watched),
        ):
            image = with_camera(bare, job.camera)
            start_time = {} if job.footage.start_time is None else {START_TIME_KEY: job.footage.start_time.isoformat()}
            row = {**coco.image_to_dict(image), **start_time}
            entry = {"image": row, "results": list(map(coco.result_to_dict, found))}
            look = looks.taken.pop(image.id, None)
            motion = shake.taken(image.id)
            skipped = list(job.footage.skipped)
            measured = {"look": look, "motion": motion_to_row(motion)}
            self._progress.add({**entry, "skipped": skipped, "key": key, **measured})
            self._keep(image, motion, look)
            yield image, found

    def _keep(self, image: Image, motion: ImageMotion | None, look: str | None) -> None:
        self.images.append(image)
        self._motions.append(motion)
        if look is not None and image.time_s is not None:
            self._looks.append((image.time_s, look))

    def write(self, console: Console, before: str | None = None) -> list[Path]:
        """Write predictions, frames and, on request, overlays; return their paths.

        Args:
            console: Console for the results.
            before: Small image of the camera's view before the footage, if it continues other footage.

        Raises:
            UserError: No frame could be read.
        """
        job, progress, images = self._job, self._progress, self.images
        if not images:
            progress.end()
            why = "; ".join(job.footage.skipped) or "there are none between --start and --end"
            raise UserError(f"{job.footage.name}: none of its images can be read: {why}")
        scheme = self._detector.scheme
        kept = _kept(job, progress, images)
        written = [job.out / PREDICTIONS_FILE, job.out / FRAMES_FILE]
        seen = _Seen()
        coco.write_result_rows(written[0], (seen.noted(result) for row in progress.rows() for result in kept(row)))
        record, looked = record_of(images, self._motions, images[0].width), self._looks
        changed = record.view_changes(looked) if job.footage.clip else []
        changed = [*(change_since(before, looked) if before else ()), *changed]
        if changed:
            changed = with_homographies(job.footage, changed, images[-1].time_s or 0.0)
        shake = record.motion(changed) if job.footage.clip else None
        self.view_changes = changed
        for change in changed:
            console.result(f"{job.footage.name}: {change}")
        if shake:
            console.result(f"{job.footage.name}: {shake}")
        frames_file = AnnotationFile(
            images=tuple(images),
            annotations=(),
            info={**_info(job, looked, changed, shake), DETECTOR_KEY: self._detector.name},
            name=job.footage.name,
            scheme=scheme,
            categories=self._detector.categories,
        )
        coco.write(written[1], frames_file)
        if job.overlay:
            written.append(write_overlay(job, progress, kept, len(images), scheme, console))
        progress.end()
        console.result(f"{seen} in {counted(len(images), 'image')}")
        return written


@contextmanager
def _ended_by_terminate(footage: Footage) -> Iterator[None]:
    """Treat the signal that ends services (SIGTERM) like Ctrl+C, so that the results of a live stream are written."""
    if not footage.live or threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _info(
    job: PredictJob,
    looked: Sequence[tuple[float, str]],
    changed: Sequence[ViewChange],
    shake: CameraMotion | None,
) -> dict[str, Any]:
    """Return the `info` of the frames on the footage."""
    info: dict[str, Any] = {"source": job.footage.name, "fps": job.footage.fps, **found_at(job), **job.camera_info}
    if job.footage.start_time is not None:
        info[START_TIME_KEY] = job.footage.start_time.isoformat(timespec="milliseconds")
    if job.footage.clip and not job.footage.clip.square:
        info[PIXEL_WIDTH] = round(job.footage.clip.pixel_width, 4)
    if job.footage.skipped:
        info[SKIPPED_KEY] = list(job.footage.skipped)
    if job.key_every > 1:
        info[FOLLOWED_KEY] = True
    if looked:
        info[VISIBILITY_KEY] = visibility_rows(looked)
    if changed:
        info[CHANGES_KEY] = [change.to_dict() for change in changed]
    if shake:
        info[MOTION_KEY] = shake.to_dict()
    return info


def _shake_estimator(job: PredictJob, last: int) -> CameraShakeEstimator:
    """Return the estimator of camera shake, relative to the first frame also if a run is resumed."""
    # Frames of a stream do not wait. With key frames only, the detector takes most of the time.
    apart = not job.footage.live and job.key_every == 1
    processes = min(_SHAKE_PROCESSES, usable_processors() // _SHAKE_PROCESSES) if apart else 0
    if not last or job.footage.live:
        return CameraShakeEstimator(processes=processes)
    first = next(job.footage.frames(), None)
    return CameraShakeEstimator(first[1] if first and job.footage.clip else None, processes)


@dataclass
class _Seen:
    """Counts of detections."""

    results: Counter[str] = field(default_factory=Counter)
    """Number of detections by category."""
    numbers: dict[str, set[int]] = field(default_factory=lambda: defaultdict(set))
    """Numbers of the road users of each category, if they were followed from image to image."""

    def noted(self, result: dict[str, Any]) -> dict[str, Any]:
        category = CATEGORY_NAMES[result["category_id"] - 1]
        self.results[category] += 1
        if "track_id" in result:
            self.numbers[category].add(result["track_id"])
        return result

    def __str__(self) -> str:
        found = [name for name in CATEGORY_NAMES if name == CATEGORY_NAMES[0] or self.results[name]]
        return ", ".join(map(self._of, found))

    def _of(self, category: str) -> str:
        results, numbers = self.results[category], self.numbers[category]
        return (
            f"{counted(len(numbers), category)} ({counted(results, 'detection')})"
            if numbers
            else counted(results, category)
        )


def found_in(
    job: PredictJob,
    detector: FrameDetector,
    *,
    last: int = 0,
    last_key: int = 1,
    names: Sequence[int] = (),
    watched: Sequence[Watcher] = (),
) -> Iterator[tuple[Image, list[AnyResult], bool]]:
    """Yield the detections in the frames of footage, after a given frame.

    Args:
        job: The footage, and the interval of key frames.
        detector: The detector.
        last: Number of the last frame to skip.
        last_key: Number of the last key frame up to there.
        names: The `track_id` of each road user in that key frame.
        watched: Observers that receive the frames first.

    Yields:
        A frame, its detections, and whether the detector has processed it.
    """

    def watch(frames: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        for watcher in watched:
            frames = watcher.watch(frames)
        return frames

    every = job.key_every
    if every == 1:
        each = detector.each if job.footage.live else detector.each_ahead
        yield from ((image, found, True) for image, found in each(watch(job.footage.frames(last))))
        return

    # A resumed run starts with the previous key frame, so that the frames after it get the same results.
    for image, found, key in with_frames_between(
        watch(job.footage.frames(last_key - 1)), detector.each_ahead, every, names
    ):
        if image.id > last:
            yield image, found, key


def _kept(job: PredictJob, progress: Progress, images: Sequence[Image]) -> KeepRule:
    """Return the function that selects a frame's results: those above the score, in a video those that are confirmed.

    In a video they have the number of their road user, from 1.
    """
    times = [image.time_s for image in images if image.time_s is not None]
    interval = float(np.median(np.diff(times))) if job.links and len(times) > 1 else math.inf
    if interval > LINK_LIMITS.frame_gap_s:
        return lambda row: [result for result in row["results"] if result["score"] > job.score]
    numbering = NumbersByCategory(
        partial(Confirmation, job.score, every=job.key_every) if job.confirms else partial(Linked, job.score)
    )
    for row, time_s in zip(progress.rows(), times, strict=True):
        numbering.add(time_s, list(map(coco.any_result_from_dict, row["results"])))
    of_frame = dict(zip([image.id for image in images], numbering.confirmed(), strict=True))
    return lambda row: [
        {**result, "track_id": number + 1}
        for result, number in zip(row["results"], of_frame[row["image"]["id"]].tolist(), strict=True)
        if number >= 0
    ]
