"""Write images as a video file."""

import errno
import itertools
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np

from skope.errors import UserError
from skope.files.safe_names import for_ffmpeg
from skope.types import Pixels

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

VIDEO_FORMATS: Final[dict[str, tuple[str, str, str, dict[str, str]]]] = {
    ".mp4": ("mp4", "libx264", "yuv420p", {"preset": "veryfast", "crf": "20"}),
    ".avi": ("avi", "mjpeg", "yuvj420p", {"qmin": "2", "qmax": "2"}),
}
"""Container, codec, pixel format and codec options by file suffix.

H.264 is supported by all browsers, office programs and players. In MJPEG each frame is independent.
"""


@dataclass(frozen=True)
class VideoCoding:
    """Parameters of written videos."""

    denominator: int = 1001
    """Denominator of frame rates that are not whole numbers, as in television."""
    color_matrix: int = 6
    """Colour matrix (ITU-T H.273): OpenCV reads all files with this one."""
    color_range: int = 1
    """Limited range of values (ITU-T H.273)."""


VIDEO_CODING: Final = VideoCoding()


class VideoFile:
    """Video that is being written frame by frame."""

    def __init__(self, file: "OutputContainer", stream: "VideoStream", size: tuple[int, int]) -> None:
        self._file, self._stream, self._size = file, stream, size

    def add(self, pixels: Pixels) -> None:
        """Append a frame (H, W, 3) RGB of the video's size; if that is odd, its edge is repeated.

        Raises ValueError for a frame of another size or type.
        """
        from av import VideoFrame

        if pixels.dtype != np.uint8 or pixels.shape != (self._size[1], self._size[0], 3):
            raise ValueError(f"expected a frame of {self._size}, 8 bits RGB, got {pixels.shape} of {pixels.dtype}")
        right, below = self._stream.width - pixels.shape[1], self._stream.height - pixels.shape[0]
        if right or below:
            pixels = np.asarray(cv2.copyMakeBorder(pixels, 0, below, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)
        self._file.mux(self._stream.encode(VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")))

    def end(self) -> None:
        """Write the frames that the encoder still holds."""
        self._file.mux(self._stream.encode())


@contextmanager
def create_video(path: Path, size: tuple[int, int], fps: float) -> Iterator[VideoFile]:
    """Open a video file for writing: H.264 in an .mp4, MJPEG in an .avi.

    Args:
        path: The file.
        size: Width and height of the frames, pixels; an odd size is a pixel larger in an .mp4.
        fps: Frames per second.

    Raises:
        UserError: The video cannot be written in this form.
        OSError: The file cannot be written.
    """
    import av
    from av.error import FFmpegError

    container, codec, kept, options = VIDEO_FORMATS[path.suffix]
    try:
        # The prefix marks it as a file, because FFmpeg treats some names as addresses. FFmpeg writes the file itself,
        # because an interrupt during a call back into Python would be lost.
        with av.open(f"file:{for_ffmpeg(path)}", "w", format=container) as file:
            stream: Any = file.add_stream(codec, rate=_rate(path, fps), options=options)
            even = container == "mp4"
            stream.width, stream.height = (side + (side % 2 if even else 0) for side in size)
            stream.pix_fmt = kept
            if even:
                stream.codec_context.colorspace, stream.codec_context.color_range = (
                    VIDEO_CODING.color_matrix,
                    VIDEO_CODING.color_range,
                )
            video = VideoFile(file, stream, size)
            yield video
            video.end()
    except FFmpegError as error:
        number = error.errno or 0
        if number in errno.errorcode and number != errno.EINVAL:  # EINVAL comes from a codec that rejects the input
            raise OSError(number, os.strerror(number), str(path)) from None
        raise UserError(f"{path}: cannot be written as a video ({error.strerror})") from None


def _rate(path: Path, fps: float) -> Fraction:
    """Return a frame rate in frames per second as a fraction."""
    if not (math.isfinite(fps) and fps > 0):
        raise UserError(f"{path}: cannot be written as a video of {fps:g} frames/s")
    if fps < 1:
        return 1 / Fraction(1 / float(fps)).limit_denominator(VIDEO_CODING.denominator)
    return Fraction(float(fps)).limit_denominator(VIDEO_CODING.denominator)


def write_video(path: Path, frames: Iterable[Pixels], fps: float) -> None:
    """Write frames as a video file, as `create_video` does; without frames nothing is written.

    Args:
        path: The file, .mp4 or .avi.
        frames: (H, W, 3) RGB, all of one size.
        fps: Frames per second.

    Raises:
        UserError: The video cannot be written in this form.
        OSError: The file cannot be written.
    """
    left = iter(frames)
    first = next(left, None)
    if first is None:
        return
    with create_video(path, (first.shape[1], first.shape[0]), fps) as video:
        for pixels in itertools.chain([first], left):
            video.add(pixels)
