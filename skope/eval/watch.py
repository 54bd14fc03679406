"""`skope eval predict`: a checkpoint run over footage, frame by frame, so that a stopped run goes on."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from skope import coco, draw
from skope.camera import Camera
from skope.console import Console
from skope.dataset import FRAMES, PREDICTIONS
from skope.errors import UserError
from skope.eval.blur import blurred
from skope.eval.footage import Footage, Pixels
from skope.eval.predict import Predictor
from skope.eval.progress import Progress
from skope.eval.scene import with_camera
from skope.eval.settings import Settings
from skope.files import replacing, sha256_of
from skope.keypoints import Scheme
from skope.outputs import claim
from skope.schema import AnnotationFile, Image, Result
from skope.video import write_video

_PROGRESS: Final = ".predict.jsonl"
OVERLAY: Final = "overlay.mp4"
OVERLAYS: Final = "overlays"


@dataclass(frozen=True, kw_only=True)
class Job:
    """What to run, on what."""

    footage: Footage
    checkpoint: Path
    out: Path
    settings: Settings = field(default_factory=Settings)
    score: float = 0.5
    """Least score of a detection that is kept."""
    camera: Camera | None = None
    overlay: bool = False
    blur: bool = False


@dataclass
class _Done:
    """What a run has found so far."""

    images: list[Image] = field(default_factory=list)
    results: list[Result] = field(default_factory=list)

    @property
    def last(self) -> int:
        """Number of the last frame."""
        return self.images[-1].id if self.images else 0


def predict(job: Job, console: Console) -> list[Path]:
    """Run the checkpoint; returns the files that were written. What could not be read is in `job.footage.skipped`."""
    predictor = Predictor(job.checkpoint, job.settings, console)
    _claim(job, predictor.files)
    progress = Progress(job.out / _PROGRESS, ("image", "results"))
    done = _resumed(job, progress, console)
    frames = job.footage.frames(done.last)
    with console.bar(total=len(job.footage) or None, unit="image", label=job.footage.name) as bar:
        bar.update(done.last)
        try:
            for image, found in predictor.each(frames):
                _note(done, progress, with_camera(image, job.camera), found)
                bar.update(image.id - bar.n)
        except KeyboardInterrupt:
            if not job.footage.live:
                raise
            console.say(f"{job.footage.name}: stopped after {len(done.images)} images")
    if not done.images:
        progress.end()
        why = "; ".join(job.footage.skipped) or "there are none between --start and --end"
        raise UserError(f"{job.footage.name}: none of its images can be read: {why}")
    written = [job.out / PREDICTIONS, job.out / FRAMES]
    coco.write_results(written[0], done.results)
    info = {"source": job.footage.name, "fps": job.footage.fps}
    frames_file = AnnotationFile(
        images=tuple(done.images), annotations=(), info=info, name=job.footage.name, scheme=predictor.scheme
    )
    coco.write(written[1], frames_file)
    if job.overlay:
        written.append(_overlay(job, done, predictor.scheme, console))
    progress.end()
    return written


def _note(done: _Done, progress: Progress, image: Image, found: list[Result]) -> None:
    done.images.append(image)
    done.results += found
    progress.add({"image": coco.image_to_dict(image), "results": [coco.result_to_dict(r) for r in found]})


def _claim(job: Job, files: Sequence[Path]) -> None:
    """Take the output folder for this footage, a predictor's files and settings; overlays may come later."""
    cut, settings = job.footage.cut, job.settings
    options = {
        "source": _content(job.footage),
        "every": cut.every,
        "start": cut.start_s,
        "end": cut.end_s if math.isfinite(cut.end_s) else None,
        "score": job.score,
        "precision": settings.precision,
        "camera": job.camera.to_dict() if job.camera else None,
    }
    claim(job.out, "skope eval predict", files, options)


def _content(footage: Footage) -> str:
    """What the frames are, wherever their files lie: a checksum; of a live stream, which comes only once, its begin."""
    if footage.live:
        return f"{footage.name} of {datetime.now(UTC).isoformat()}"
    if footage.clip and "://" in footage.clip.address:
        return footage.clip.address
    files = [Path(footage.clip.address)] if footage.clip else footage.images
    return hashlib.sha256(" ".join(map(sha256_of, files)).encode()).hexdigest()


def _resumed(job: Job, progress: Progress, console: Console) -> _Done:
    """What an interrupted run of the same work left behind; else nothing yet."""
    done = _Done()
    for row in progress.rows:
        done.images.append(coco.image_from_dict(row["image"]))
        done.results += [coco.result_from_dict(r) for r in row["results"]]
    if done.images:
        console.say(f"{job.footage.name}: going on after frame {done.last}")
    return done


def _overlay(job: Job, done: _Done, scheme: Scheme, console: Console) -> Path:
    """Draw what was found: a video of a video, images of images."""
    by_image: dict[int, list[Result]] = {image.id: [] for image in done.images}
    for result in done.results:
        by_image[result.image_id].append(result)
    drawn = _drawn(job, by_image, scheme, console)
    if job.footage.clip is None:
        folder = job.out / OVERLAYS
        for image, pixels in drawn:
            draw.write(folder / f"{Path(image.file_name).stem}.jpg", pixels)
        return folder
    path = job.out / OVERLAY
    with replacing(path) as temporary:
        write_video(temporary, (pixels for _, pixels in drawn), job.footage.fps or 25.0)
    return path


def _drawn(
    job: Job, found: dict[int, list[Result]], scheme: Scheme, console: Console
) -> Iterator[tuple[Image, Pixels]]:
    frames = ((image, pixels) for image, pixels in job.footage.frames() if image.id in found)
    for image, pixels in console.bar(frames, total=len(found), unit="image", label="overlay"):
        results = found[image.id]
        yield image, draw.results(blurred(pixels, results) if job.blur else pixels, results, scheme=scheme)
