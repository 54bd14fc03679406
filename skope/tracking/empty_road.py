"""A picture of the road without its traffic, from the footage that was tracked."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from skope.camera.motion.known_views import read_views, view_numbers
from skope.pictures.median import median_of
from skope.schema import AnnotationFile
from skope.types import Pixels
from skope.video.footage import FOUND_AT, Cut, open_footage

_FRAMES: Final = 25
"""Frames that the picture is made of."""
_SECONDS: Final = 120.0
"""They are taken of so much footage: reading on through hours would take minutes."""
_ROUNDING_S: Final = 0.01
"""Files round the times of their frames: the last one shall be in."""


def empty_road(folder: Path, file: AnnotationFile) -> Pixels | None:
    """(H, W, 3) the median of frames of the footage: vehicles that drive are gone, those that stand remain.

    Frames are taken of the view that the first image shows.

    Args:
        folder: Where the file of frames lies.
        file: The frames; `info` says where their footage is.

    Returns:
        The picture; None where the file does not say where its footage is.

    Raises:
        UserError: The footage is not there any more, or cannot be read.
    """
    source = footage_of(folder, file.info)
    if source is None:
        return None
    times = [image.time_s for image in file.images if image.time_s is not None]
    shown = view_numbers(read_views(file.name, file.info), times).tolist()
    times = [time_s for time_s, view in zip(times, shown, strict=True) if view == shown[0]] or [0.0, math.inf]
    span = Cut(start_s=times[0], end_s=min(times[-1], times[0] + _SECONDS) + _ROUNDING_S)
    footage = open_footage(str(source), span)
    footage.cut = replace(span, every=max(1, len(footage) // _FRAMES))
    frames = [pixels for _, pixels in footage.frames()]
    return median_of(frames) if frames else None


def footage_of(folder: Path, info: Mapping[str, Any]) -> Path | None:
    """The video or the images as `skope eval predict` names them in its file of frames, or `skope gen video` in its."""
    if isinstance(found_at := info.get(FOUND_AT), str):
        return folder / found_at
    video = info.get("video")
    return folder / Path(video).name if isinstance(video, str) else None
