"""Overlays: the results of a prediction, drawn over its footage, with plates, glass and heads anonymised on request."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Final

import cv2
import numpy as np

from skope.dataset import coco
from skope.detections import apart
from skope.files.atomic import replacing
from skope.files.progress import Progress
from skope.footage.predict_job import PredictJob
from skope.keypoints import INDEX, Scheme
from skope.pictures import draw
from skope.schema import Image, Result, RoadUserResult
from skope.terminal.console import Console
from skope.types import Array, Pixels
from skope.video.write import write_video

_BLURRED_PARTS: Final = tuple(
    tuple(INDEX[name] for name in names)
    for names in (
        ("roof_front_right", "roof_front_left", "windscreen_base_left", "windscreen_base_right"),
        ("roof_rear_right", "roof_rear_left", "rear_window_base_left", "rear_window_base_right"),
        ("roof_front_right", "roof_rear_right", "rear_window_base_right", "windscreen_base_right"),
        ("roof_front_left", "roof_rear_left", "rear_window_base_left", "windscreen_base_left"),
        ("headlight_inner_right", "headlight_inner_left", "bumper_front_left", "bumper_front_right"),
        ("taillight_inner_right", "taillight_inner_left", "bumper_rear_left", "bumper_rear_right"),
    )
)
"""Windscreen, rear window, side windows, and the lower middle of either end, where plates are."""


@dataclass(frozen=True)
class BlurCells:
    """Resolution of anonymised parts."""

    vehicle_cells: int = 8
    """Cells across a vehicle. A plate is about a quarter of its width; nothing smaller than an eighth survives."""
    head_share: float = 0.4
    """Share of the box of a pedestrian or rider that holds the head in any posture."""
    head_cells: int = 3
    """Cells across that part. A head is at most about a third as wide as the box."""


BLUR_CELLS: Final = BlurCells()


def blurred(image: Pixels, found: Iterable[Result], road_users: Iterable[RoadUserResult] = ()) -> Pixels:
    """A copy of an image without glass, plates and heads, which are averaged away.

    Args:
        image: (H, W, 3) RGB.
        found: Vehicles, of which glass and plates go, hidden sides' too.
        road_users: People on foot and on two wheels, of whom the upper part of the box goes, where the head is.
    """
    out = image.copy()
    for user in road_users:
        patch, _ = _around(out, user.bbox * [1, 1, 1, BLUR_CELLS.head_share])
        if patch.size:
            patch[:] = _averaged(patch, BLUR_CELLS.head_cells)
    for result in found:
        patch, (x0, y0) = _around(out, result.bbox)
        if not patch.size:
            continue
        mask = np.zeros(patch.shape[:2], dtype=np.uint8)
        for part in _BLURRED_PARTS:
            corners = np.clip(result.keypoints[list(part), :2] - [x0, y0], -1e4, 1e4)
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(corners).astype(np.int32)), 1)
        patch[mask > 0] = _averaged(patch, BLUR_CELLS.vehicle_cells)[mask > 0]
    return out


def _around(image: Pixels, bbox: Array) -> tuple[Pixels, tuple[int, int]]:
    """The pixels, not a copy, of a box and a tenth around it, and the first column and row."""
    x, y, w, h = bbox
    x0, y0 = (int(max(0, v)) for v in (x - 0.1 * w, y - 0.1 * h))
    x1, y1 = int(min(image.shape[1], x + 1.1 * w)) + 1, int(min(image.shape[0], y + 1.1 * h)) + 1
    return image[y0:y1, x0:x1], (x0, y0)


def _averaged(patch: Pixels, cells: int) -> Pixels:
    """A patch of which nothing is left that is smaller than one of `cells` x `cells` cells."""
    small = cv2.resize(patch, (cells, cells), interpolation=cv2.INTER_AREA)
    flat = cv2.resize(small, (patch.shape[1], patch.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(flat, dtype=np.uint8)


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
