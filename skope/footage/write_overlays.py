"""Overlays: the results of a prediction, drawn over its footage."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import Any, Final

from skope.dataset import coco
from skope.detections import apart
from skope.files.atomic import replacing
from skope.files.progress import Progress
from skope.footage.anonymize import blurred
from skope.footage.predict_job import PredictJob
from skope.keypoints import Scheme
from skope.pictures import draw
from skope.schema import Image
from skope.terminal.console import Console
from skope.types import Pixels
from skope.video.write import write_video

OVERLAY_VIDEO: Final = "overlay.mp4"
OVERLAY_FOLDER: Final = "overlays"
KeepRule = Callable[[dict[str, Any]], list[dict[str, Any]]]
"""The results of a frame, of its row in the file of progress, that stay."""


def write_overlay(
    job: PredictJob, progress: Progress, kept: KeepRule, count: int, scheme: Scheme, console: Console
) -> Path:
    """Draw what was found: a video of a video, images of images.

    Args:
        job: The footage, and where to write.
        progress: The frames that were looked at, with their results.
        kept: Gives the results that stay.
        count: Number of frames, for the bar.
        scheme: What the keypoints are.
        console: Where the bar goes.

    Returns:
        The video, or the folder of images.
    """
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


def _drawn(job: PredictJob, progress: Progress, kept: KeepRule, scheme: Scheme) -> Iterator[tuple[Image, Pixels]]:
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
