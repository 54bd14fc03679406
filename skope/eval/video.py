"""Pictures written as a video file."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.errors import UserError

Pixels = NDArray[np.uint8]


def write_video(path: Path, frames: Iterator[Pixels], fps: float) -> None:
    """RGB frames of one size as an MP4 file."""
    writer: cv2.VideoWriter | None = None
    try:
        for pixels in frames:
            if writer is None:
                size = (pixels.shape[1], pixels.shape[0])
                writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
                if not writer.isOpened():
                    raise UserError(f"{path}: cannot be written as a video")
            writer.write(np.ascontiguousarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)))
    finally:
        if writer is not None:
            writer.release()
