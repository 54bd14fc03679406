"""Pictures written as a video file."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from skope.errors import UserError
from skope.files.safe_names import for_opencv
from skope.types import Pixels


def write_video(path: Path, frames: Iterable[Pixels], fps: float, codec: str = "mp4v") -> None:
    """Write frames as a video file.

    Args:
        path: The file.
        frames: (H, W, 3) RGB, all of one size.
        fps: Frames a second.
        codec: FourCC that goes with the path's suffix.
    """
    writer: cv2.VideoWriter | None = None
    try:
        for pixels in frames:
            if writer is None:
                size = (pixels.shape[1], pixels.shape[0])
                writer = cv2.VideoWriter(for_opencv(path), cv2.VideoWriter.fourcc(*codec), fps, size)
                if not writer.isOpened():
                    raise UserError(f"{path}: cannot be written as a video")
            writer.write(np.ascontiguousarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)))
    finally:
        if writer is not None:
            writer.release()
