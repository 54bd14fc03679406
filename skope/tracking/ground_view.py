"""The road from above, computed from the camera's image, and an image of the road without its traffic."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.camera.motion.view_registration import read_views, view_numbers
from skope.pictures.median import median_of
from skope.schema import AnnotationFile
from skope.types import Array, Pixels
from skope.video.footage import FOUND_AT, FrameRange, open_footage


@dataclass(frozen=True)
class GroundImage:
    """Settings of the image of the empty road."""

    frames: int = 25
    """Number of frames that are combined."""
    seconds: float = 120.0
    """Duration of the footage from which they are taken, seconds. Reading hours would take minutes."""
    rounding_s: float = 0.01
    """Rounding of the frame times in files, seconds."""
    contrast_share: float = 0.62
    """Share of the image's contrast that is kept, so that drawings stand out."""
    fading_m: tuple[float, float] = (0.6, 2.5)
    """Size of a pixel on the road up to which it is fully shown, and from which it is not shown, metres."""


GROUND_IMAGE: Final = GroundImage()


def empty_road(folder: Path, file: AnnotationFile) -> Pixels | None:
    """Return the median (H, W, 3) of frames of the footage: moving vehicles vanish, stationary ones remain.

    Only frames with the view of the first image are used.

    Args:
        folder: Folder of the file of frames.
        file: The frames; `info` names their footage.

    Returns:
        The image; None if the file does not name its footage.

    Raises:
        UserError: The footage is missing or cannot be read.
    """
    source = footage_of(folder, file.info)
    if source is None:
        return None
    times = [image.time_s for image in file.images if image.time_s is not None]
    shown = view_numbers(read_views(file.name, file.info), times).tolist()
    times = [time_s for time_s, view in zip(times, shown, strict=True) if view == shown[0]] or [0.0, math.inf]
    span = FrameRange(start_s=times[0], end_s=min(times[-1], times[0] + GROUND_IMAGE.seconds) + GROUND_IMAGE.rounding_s)
    footage = open_footage(str(source), span)
    footage.cut = replace(span, every=max(1, len(footage) // GROUND_IMAGE.frames))
    frames = [pixels for _, pixels in footage.frames()]
    return median_of(frames) if frames else None


def footage_of(folder: Path, info: Mapping[str, Any]) -> Path | None:
    """Return the video or image folder that a file of frames of `skope eval predict` or `skope gen video` names."""
    if isinstance(found_at := info.get(FOUND_AT), str):
        return folder / found_at
    video = info.get("video")
    return folder / Path(video).name if isinstance(video, str) else None


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundView:
    """Rectangle of the road, north up, in square cells, as one camera shows it."""

    camera: Camera
    ground: Ground
    low: Array
    """(2,) world x, y of the rectangle's south-west corner, metres."""
    high: Array
    """(2,) world x, y of its north-east corner, metres."""
    cell_m: float
    """Side of a cell, metres."""

    @cached_property
    def _points(self) -> Array:
        """(H, W, 3) middles of the cells on the road, northernmost row first."""
        across, up = (np.maximum(1, np.rint((self.high - self.low) / self.cell_m))).astype(int)
        x = self.low[0] + (np.arange(across) + 0.5) * self.cell_m
        y = self.high[1] - (np.arange(up) + 0.5) * self.cell_m
        xy = np.stack(np.meshgrid(x, y), axis=-1)
        z = self.ground.height + (xy - self.ground.about) @ np.array(self.ground.slope)
        return np.concatenate([xy, z[..., None]], axis=-1)

    @cached_property
    def pixels(self) -> Array:
        """(H, W, 2) pixels of the camera's image for the cells; NaN behind the camera."""
        return self.camera.project(self._points)[0]

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W) whether the cells lie in the camera's field of view."""
        return self.camera.inside(self.pixels)

    def pale(self, picture: Pixels) -> Pixels:
        """Project the camera's `picture` onto the road, seen from above: (H, W, 3), pale grey, white outside the image.

        It becomes paler with distance, where one of its pixels covers metres of road.
        """
        at = (np.nan_to_num(self.pixels, nan=-1e4) - 0.5).clip(-1e4, 1e4).astype(np.float32)
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        above = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        fine, none = GROUND_IMAGE.fading_m
        share = GROUND_IMAGE.contrast_share * self.seen * np.clip((none - self._metres_a_pixel()) / (none - fine), 0, 1)
        shown = np.rint(255 - share * (255 - above.astype(np.float64))).astype(np.uint8)
        return np.repeat(shown[..., None], 3, axis=-1)

    def _metres_a_pixel(self) -> Array:
        """(H, W) approximate length of road along the viewing ray that one pixel covers, metres."""
        eye = self.camera.position
        away = self._points - eye
        distance = np.linalg.norm(away, axis=-1)
        return np.asarray(distance**2 / (self.camera.K[1, 1] * np.maximum(0.1, np.abs(away[..., 2]))))
