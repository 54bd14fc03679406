"""`skope eval predict`: a checkpoint run over footage, frame by frame, so that a stopped run goes on."""

import hashlib
import math
import os
import signal
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path, PurePath
from typing import Any, Final, Protocol

import numpy as np

from skope.camera.model import Camera
from skope.dataset import coco
from skope.dataset.camera_of_file import with_camera
from skope.dataset.folder import BEGINS, CHANGES, FOLLOWED, FRAMES, PREDICTIONS, SIGHT_FIELD
from skope.detections import apart
from skope.detector.device import choose_device
from skope.errors import UserError
from skope.eval.box_links import FARTHEST_S
from skope.eval.inference.anonymize import blurred
from skope.eval.inference.camera_sway import SwayRecord, SwayWatch, motion_to_row, record_of_rows
from skope.eval.inference.confirmation import WEAK, Confirmation
from skope.eval.inference.footage import FOUND_AT, Footage
from skope.eval.inference.key_frames import INTERVAL_S, with_frames_between
from skope.eval.inference.numbers_by_category import Linked, NumbersByCategory
from skope.eval.inference.picture_sight import sight_rows
from skope.eval.inference.predictor import Predictor
from skope.eval.inference.settings import Settings
from skope.eval.inference.view_changes import Looks, ViewChange
from skope.eval.pose.camera_motion import MOTION, CameraMotion
from skope.files.atomic import replacing
from skope.files.json_files import read_json
from skope.files.output_folders import WORK, claim_output
from skope.files.progress import Progress
from skope.files.reading import sha256_of
from skope.keypoints import Scheme
from skope.pictures import draw
from skope.pictures.video import write_video
from skope.schema import CATEGORIES, AnnotationFile, AnyResult, Image
from skope.terminal.console import Console, counted
from skope.types import Pixels

_PROGRESS_FILE: Final = ".predict.jsonl"
OVERLAY_VIDEO: Final = "overlay.mp4"
OVERLAY_FOLDER: Final = "overlays"


class Watcher(Protocol):
    """Looks at frames on their way to the detector."""

    def watch(self, frames: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """The same frames, in their order."""


Kept = Callable[[dict[str, Any]], list[dict[str, Any]]]
"""The results of a frame, of its row in the file of progress, that stay."""


@dataclass(frozen=True, kw_only=True)
class PredictJob:
    """A run of a checkpoint on footage, and what it writes."""

    footage: Footage
    checkpoint: Path
    out: Path
    settings: Settings = field(default_factory=Settings)
    score: float = 0.5
    """Least score of a detection that is kept."""
    camera: Camera | None = None
    camera_info: Mapping[str, float] = field(default_factory=dict)
    """Further knowledge of the camera, for the `info` of the frames."""
    overlay: bool = False
    blur: bool = False
    unconfirmed: bool = False
    """Whether detections in a video are kept that its other frames do not confirm."""
    every_frame: bool = False
    """Whether the detector sees every frame of a video, not key frames only."""

    @property
    def key_every(self) -> int:
        """Number of frames from one that the detector sees to the next, where it runs on a CPU.

        Vehicles are followed through the frames of a recorded video that are dense enough for that; a live stream's
        come as they can.
        """
        dense = self.footage.fps is not None and self.footage.fps * FARTHEST_S >= 1
        if self.every_frame or not dense or choose_device(self.settings.device).type != "cpu":
            return 1
        return max(1, round(INTERVAL_S * (self.footage.fps or 0.0)))

    @property
    def least_score(self) -> float:
        """Score from which the detector makes detections: weak ones continue vehicles of a video."""
        return min(self.score, WEAK) if self.confirms else self.score

    @property
    def confirms(self) -> bool:
        """Whether frames are held against each other: those of a video, so far as it says how dense they are."""
        return self.links and not self.unconfirmed

    @property
    def links(self) -> bool:
        """Whether vehicles are followed from frame to frame."""
        dense = self.footage.fps is None or self.footage.fps * FARTHEST_S >= 1
        return self.footage.clip is not None and dense


def predict(job: PredictJob, console: Console) -> list[Path]:
    """Run a checkpoint over footage, and write what it finds under `job.out`; a stopped run goes on.

    A live stream comes once: where a run of it was killed, what that one has is written, and nothing more is read.

    Args:
        job: What to run, on what.
        console: Where messages and progress go.

    Returns:
        The files that were written. What could not be read is in `job.footage.skipped`.

    Raises:
        UserError: No image can be read, or the output folder holds other work.
    """
    # The frames of a live stream do not wait for a batch to be full.
    batch_size = job.settings.batch_size or (1 if job.footage.live else None)
    settings = replace(job.settings, min_score=job.least_score, batch_size=batch_size)
    predictor = Predictor.load(job.checkpoint, settings, console)
    _claim(job, predictor.files)
    prediction = Prediction(job, predictor)
    done = prediction.last
    if prediction.killed:
        console.say(f"{job.footage.name}: a run was killed here after {counted(done, 'image')}: writing what it has")
    elif done:
        console.say(f"{job.footage.name}: going on after frame {done}")
    bars = console.bar(total=len(job.footage) or None, unit="image", label=job.footage.name)
    with bars as bar, _ended_by_terminate(job.footage):
        bar.update(done)
        try:
            for image, _ in prediction.frames():
                bar.update(image.id - bar.n)
        except KeyboardInterrupt:
            if not job.footage.live:
                raise
            console.say(f"{job.footage.name}: stopped after {len(prediction.images)} images")
    return prediction.write(console)


class Prediction:
    """Detections in footage: kept frame by frame in a file of progress, then written as results."""

    def __init__(self, job: PredictJob, predictor: Predictor) -> None:
        """Go on after what a stopped run has kept in the job's output folder."""
        self._job, self._predictor = job, predictor
        self._progress = Progress(job.out / _PROGRESS_FILE, ("image", "results", "skipped", "key", "look", "motion"))
        self.images: list[Image] = []
        """The frames so far, with the job's camera."""
        self._last_key, self._last_look_s = 1, None
        self._last_numbers: list[int] = []
        """The `track_id` of each road user of the last key frame."""
        for row in self._progress.rows():
            self.images.append(coco.image_from_dict(row["image"]))
            if BEGINS in row["image"]:
                job.footage.begins = datetime.fromisoformat(row["image"][BEGINS])
            if row["key"]:
                self._last_key = self.images[-1].id
                self._last_numbers = [result.get("track_id", 0) for result in row["results"]]
            if row["look"] is not None:
                self._last_look_s = self.images[-1].time_s
            job.footage.skipped += [reason for reason in row["skipped"] if reason not in job.footage.skipped]
        self.killed = job.footage.live and bool(self.images)
        """Whether a run of a live stream was killed here: it comes once, and nothing is added to what that run has."""

    @property
    def last(self) -> int:
        """Number of the last frame that was looked at, from 1; 0: none."""
        return self.images[-1].id if self.images else 0

    def frames(self, watched: Sequence["Watcher"] = ()) -> Iterator[tuple[Image, list[AnyResult]]]:
        """The frames that are left, each with all that is found in it, also what `write` will drop.

        `watched` see the frames with their pixels before the detector does.
        """
        job, last = self._job, self.last
        if self.killed:
            return
        looks, sway = Looks(self._last_look_s), _sway_watch(job, last)
        for bare, found, key in found_in(
            job,
            self._predictor,
            last=last,
            last_key=self._last_key,
            names=self._last_numbers,
            watched=(looks, sway, *watched),
        ):
            image = with_camera(bare, job.camera)
            begins = {} if job.footage.begins is None else {BEGINS: job.footage.begins.isoformat()}
            row = {**coco.image_to_dict(image), **begins}
            entry = {"image": row, "results": list(map(coco.result_to_dict, found))}
            look = looks.taken.pop(image.id, None)
            motion = motion_to_row(sway.measured.pop(image.id, None))
            skipped = list(job.footage.skipped)
            self._progress.add({**entry, "skipped": skipped, "key": key, "look": look, "motion": motion})
            self.images.append(image)
            yield image, found

    def write(self, console: Console) -> list[Path]:
        """Write predictions, frames and, where the job asks for them, overlays; returns their paths.

        Raises:
            UserError: No frame could be read.
        """
        job, progress, images = self._job, self._progress, self.images
        if not images:
            progress.end()
            why = "; ".join(job.footage.skipped) or "there are none between --start and --end"
            raise UserError(f"{job.footage.name}: none of its images can be read: {why}")
        scheme = self._predictor.scheme
        kept = _kept(job, progress, images)
        written = [job.out / PREDICTIONS, job.out / FRAMES]
        seen = _Seen()
        coco.write_result_rows(written[0], (seen.noted(result) for row in progress.rows() for result in kept(row)))
        record, looked = _watched(progress, images[0].width)
        changed = record.view_changes(looked) if job.footage.clip else []
        sways = record.motion(changed) if job.footage.clip else None
        for change in changed:
            console.result(f"{job.footage.name}: {change}; its parts count apart")
        if sways:
            console.result(f"{job.footage.name}: {sways}")
        frames_file = AnnotationFile(
            images=tuple(images),
            annotations=(),
            info=_info(job, looked, changed, sways),
            name=job.footage.name,
            scheme=scheme,
            categories=self._predictor.categories,
        )
        coco.write(written[1], frames_file)
        if job.overlay:
            written.append(_overlay(job, progress, kept, len(images), scheme, console))
        progress.end()
        console.result(f"{seen} in {counted(len(images), 'image')}")
        return written


@contextmanager
def _ended_by_terminate(footage: Footage) -> Iterator[None]:
    """Take the signal that ends services (SIGTERM) as Ctrl+C: what has come of a live stream is then written."""
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
    sways: CameraMotion | None,
) -> dict[str, Any]:
    """The `info` of the frames: what is known of the footage."""
    info: dict[str, Any] = {"source": job.footage.name, "fps": job.footage.fps, **_found_at(job), **job.camera_info}
    if job.footage.begins is not None:
        info[BEGINS] = job.footage.begins.isoformat(timespec="milliseconds")
    if job.key_every > 1:
        info[FOLLOWED] = True
    if looked:
        info[SIGHT_FIELD] = sight_rows(looked)
    if changed:
        info[CHANGES] = [asdict(change) for change in changed]
    if sways:
        info[MOTION] = sways.to_dict()
    return info


def _sway_watch(job: PredictJob, last: int) -> SwayWatch:
    """Make the measure of the camera's sway, against the first frame also where a run goes on."""
    if not last or job.footage.live:
        return SwayWatch()
    first = next(job.footage.frames(), None)
    return SwayWatch(first[1] if first and job.footage.clip else None)


def _watched(progress: Progress, width: int) -> tuple[SwayRecord, list[tuple[float, str]]]:
    """The camera's motion in each frame, and the small pictures with their times."""
    looks = [(row["image"].get("time_s"), row["look"]) for row in progress.rows() if row["look"] is not None]
    timed = [(float(time_s), look) for time_s, look in looks if time_s is not None]
    return record_of_rows(progress.rows(), width), timed


@dataclass
class _Seen:
    """Counts of what was found."""

    results: Counter[str] = field(default_factory=Counter)
    """By category."""
    numbers: dict[str, set[int]] = field(default_factory=lambda: defaultdict(set))
    """Numbers of the road users of each category, where they were followed from image to image."""

    def noted(self, result: dict[str, Any]) -> dict[str, Any]:
        category = CATEGORIES[result["category_id"] - 1]
        self.results[category] += 1
        if "track_id" in result:
            self.numbers[category].add(result["track_id"])
        return result

    def __str__(self) -> str:
        found = [name for name in CATEGORIES if name == CATEGORIES[0] or self.results[name]]
        return ", ".join(map(self._of, found))

    def _of(self, category: str) -> str:
        results, numbers = self.results[category], self.numbers[category]
        return (
            f"{counted(len(numbers), category)} ({counted(results, 'detection')})"
            if numbers
            else counted(results, category)
        )


def _found_at(job: PredictJob) -> dict[str, str]:
    """Paths of the frames' pictures relative to the output folder, so that both may move together."""
    place = job.footage.place
    return {FOUND_AT: os.path.relpath(place.resolve(), job.out.resolve())} if place else {}


def found_in(
    job: PredictJob,
    predictor: Predictor,
    *,
    last: int = 0,
    last_key: int = 1,
    names: Sequence[int] = (),
    watched: Sequence[Watcher] = (),
) -> Iterator[tuple[Image, list[AnyResult], bool]]:
    """Find vehicles and others in the frames of footage, from one number on.

    Args:
        job: The footage, and how often it is looked at.
        predictor: The detector.
        last: Frames up to this number are left out.
        last_key: Number of the last of them that the detector had seen.
        names: The `track_id` of each road user that it found there.
        watched: Look at the frames on the way.

    Yields:
        A frame, what is found in it, and whether the detector has seen it.
    """

    def watch(frames: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        for one in watched:
            frames = one.watch(frames)
        return frames

    every = job.key_every
    if every == 1:
        each = predictor.each if job.footage.live else predictor.each_ahead
        yield from ((image, found, True) for image, found in each(watch(job.footage.frames(last))))
        return

    def find(frame: tuple[Image, Pixels]) -> list[AnyResult]:
        ((_, found),) = predictor.each(iter([frame]))
        return found

    # A run that goes on begins with the key frame before, so that the frames after it become what they would have been.
    for image, found, key in with_frames_between(watch(job.footage.frames(last_key - 1)), find, every, names):
        if image.id > last:
            yield image, found, key


def _claim(job: PredictJob, files: Sequence[Path]) -> None:
    """Take the output folder for this footage, a predictor's files and settings; overlays may come later."""
    cut, settings = job.footage.cut, job.settings
    options = {
        "source": _killed_source(job) or content_of(job.footage),
        "every": cut.every,
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
    """Source of a killed run of a live stream in the output folder; None: there was none."""
    if not job.footage.live or not (job.out / _PROGRESS_FILE).is_file() or not (job.out / WORK).is_file():
        return None
    held = read_json(job.out / WORK)
    options = held.get("options") if isinstance(held, dict) else None
    source = options.get("source") if isinstance(options, dict) else None
    return source if isinstance(source, str) and source.startswith(f"{job.footage.name} of ") else None


def content_of(footage: Footage) -> str:
    """Identity of the frames: checksums of their files; for a live stream, which comes once, the time it began."""
    if footage.live:
        return f"{footage.name} of {datetime.now(UTC).isoformat()}"
    if footage.clip and "://" in footage.clip.address:
        return footage.clip.address
    files = [Path(footage.clip.address)] if footage.clip else footage.images
    digest = hashlib.sha256(" ".join(map(sha256_of, files)).encode()).hexdigest()
    return f"{footage.name}, {len(files)} files, {digest[:16]}" if footage.images else f"{footage.name}, {digest[:16]}"


def _kept(job: PredictJob, progress: Progress, images: Sequence[Image]) -> Kept:
    """Choose how the results of a frame that stay are told: those above the score, in a video those that others
    confirm.

    In a video they have the number of their vehicle or other road user, from 1.
    """
    times = [image.time_s for image in images if image.time_s is not None]
    interval = float(np.median(np.diff(times))) if job.links and len(times) > 1 else math.inf
    if interval > FARTHEST_S:
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


def _overlay(job: PredictJob, progress: Progress, kept: Kept, count: int, scheme: Scheme, console: Console) -> Path:
    """Draw what was found: a video of a video, images of images."""
    drawn = console.bar(_drawn(job, progress, kept, scheme), total=count, unit="image", label="overlay")
    if job.footage.clip is None:
        folder = job.out / OVERLAY_FOLDER
        shared = Counter(PurePath(name).with_suffix("") for name in job.footage.names)
        for image, pixels in drawn:
            bare = PurePath(image.file_name).with_suffix("")
            draw.write(folder / f"{bare if shared[bare] == 1 else image.file_name}.jpg", pixels)
        return folder
    path = job.out / OVERLAY_VIDEO
    with replacing(path) as temporary:
        write_video(temporary, (pixels for _, pixels in drawn), job.footage.fps or 25.0)
    return path


def _drawn(job: PredictJob, progress: Progress, kept: Kept, scheme: Scheme) -> Iterator[tuple[Image, Pixels]]:
    rows = progress.rows()
    row = next(rows, None)
    for image, pixels in job.footage.frames():
        if row is None:
            return
        if row["image"]["id"] == image.id:  # other images could not be read, and have no row
            found, others = apart(map(coco.any_result_from_dict, kept(row)))
            shown = blurred(pixels, found, others) if job.blur else pixels
            yield image, draw.results(shown, found, others, scheme=scheme)
            row = next(rows, None)
