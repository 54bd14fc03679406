"""Draw the results of a prediction over its footage, with plates, glass and heads anonymised on request."""

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
"""Windscreen, rear window, side windows, and the lower middle of both ends, where plates are."""


@dataclass(frozen=True)
class BlurCells:
    """Resolution of anonymised parts."""

    vehicle_cells: int = 8
    """Number of cells across a vehicle. A plate is about a quarter of its width; details below an eighth disappear."""
    head_share: float = 0.4
    """Share of the box of a pedestrian or rider that contains the head in any posture."""
    head_cells: int = 3
    """Number of cells across that part. A head is at most about a third as wide as the box."""


BLUR_CELLS: Final = BlurCells()


def blurred(image: Pixels, found: Iterable[Result], road_users: Iterable[RoadUserResult] = ()) -> Pixels:
    """Return a copy of an image in which glass, plates and heads are averaged.

    Args:
        image: (H, W, 3) RGB.
        found: Vehicles. Their glass and plates are averaged, also those of hidden sides.
        road_users: Pedestrians and two-wheelers. The upper part of their boxes is averaged, because it has the head.
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
    """Return a view of the pixels of a box with a margin of a tenth, and its first column and row."""
    x, y, w, h = bbox
    x0, y0 = (int(max(0, v)) for v in (x - 0.1 * w, y - 0.1 * h))
    x1, y1 = int(min(image.shape[1], x + 1.1 * w)) + 1, int(min(image.shape[0], y + 1.1 * h)) + 1
    return image[y0:y1, x0:x1], (x0, y0)


def _averaged(patch: Pixels, cells: int) -> Pixels:
    """Average a patch over `cells` x `cells` cells, so that no smaller detail remains."""
    small = cv2.resize(patch, (cells, cells), interpolation=cv2.INTER_AREA)
    flat = cv2.resize(small, (patch.shape[1], patch.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(flat, dtype=np.uint8)


OVERLAY_VIDEO: Final = "overlay.mp4"
OVERLAY_FOLDER: Final = "overlays"
KeepRule = Callable[[dict[str, Any]], list[dict[str, Any]]]
"""Function from a frame's row in the progress file to the results to keep."""


def write_overlay(
    job: PredictJob, progress: Progress, kept: KeepRule, count: int, scheme: Scheme, console: Console
) -> Path:
    """Draw the results: a video for a video, images for images.

    Args:
        job: The footage and the output folder.
        progress: The processed frames, with their results.
        kept: Function that returns the results to keep.
        count: Number of frames, for the progress bar.
        scheme: Scheme of the keypoints.
        console: Console for the progress bar.

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
        if row["image"]["id"] == image.id:  # images that could not be read have no row
            found, road_users = apart(map(coco.any_result_from_dict, kept(row)))
            shown = blurred(pixels, found, road_users) if job.blur else pixels
            yield image, draw.results(shown, found, road_users, scheme=scheme)
            row = next(rows, None)
