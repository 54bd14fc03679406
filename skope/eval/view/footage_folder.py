"""Folders of `skope eval predict`, with pictures from the footage itself."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from skope import schema
from skope.dataset import coco
from skope.dataset.folder import FRAMES, PREDICTIONS
from skope.detections import apart
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.files.output_folders import WORK
from skope.metrics import read_inputs
from skope.metrics.keypoint_outcomes import Options
from skope.schema import Image, RoadUser, RoadUserResult
from skope.video.footage import FOUND_AT
from skope.video.frame_cache import FrameCache
from skope.viewer.collection import Collection, ShownSplit
from skope.viewer.pictures import Picture, encoded, read_picture


def footage_collection(folder: Path) -> Collection:
    """The frames of a folder that `skope eval predict` wrote, and what was found in them."""
    file = replace(coco.read(folder / FRAMES), name="")  # footage is no split
    results, others = apart(read_inputs.read_all_results(folder / PREDICTIONS, file))
    users = tuple(_as_label(number, other) for number, other in enumerate(others, start=1))
    known = schema.checked_categories({*file.categories, *(user.category for user in users)})
    file = replace(file, road_users=users, categories=known)
    checkpoint = _checkpoint(folder)
    return Collection(
        title=f"{checkpoint} on {file.info.get('source', folder.resolve().name)}",
        splits=(ShownSplit(file=file, results=tuple(results)),),
        picture=_pictures(folder, file.info.get(FOUND_AT)),
        truth=False,
        options=Options(score=0.0, scheme=file.scheme),
    )


def _as_label(number: int, found: RoadUserResult) -> RoadUser:
    """Somebody who was found on foot or on two wheels as a label, since the page draws no detections of theirs."""
    return RoadUser(
        id=number,
        image_id=found.image_id,
        category_id=found.category_id,
        bbox=found.bbox,
        area=float(found.bbox[2:].prod()),
        track_id=found.track_id,
    )


def _checkpoint(folder: Path) -> str:
    """The name of the checkpoint that was run, if the folder says it."""
    work = read_json(folder / WORK) if (folder / WORK).is_file() else None
    inputs = work.get("inputs") if isinstance(work, dict) else None
    return "/".join(Path(next(iter(inputs))).parts[-2:]) if isinstance(inputs, dict) and inputs else "a detector"


def _pictures(folder: Path, found_at: Any) -> Callable[[Image], Picture]:
    """Make a reader of the frames' pictures: those of the files or the video that the folder says it is of."""
    source = folder / found_at if isinstance(found_at, str) else None
    if source and source.is_file():
        return FrameCache(source, encoded).frame

    def picture(image: Image) -> Picture:
        if source is None:
            raise UserError(f"{folder / FRAMES}: info.{FOUND_AT}: does not say where the images are; predict again")
        if not source.is_dir():
            raise UserError(f"{source}: no such file or folder, but {folder / FRAMES} is of it")
        return read_picture(source / image.file_name)

    return picture
