"""Random access to the frames of a video, optimised for mostly sequential access."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Generic, TypeVar

from skope.errors import UserError
from skope.schema import Image
from skope.types import Pixels
from skope.video.footage import FOOTAGE_LIMITS, open_footage

Encoded = TypeVar("Encoded")


@dataclass(frozen=True)
class CacheSize:
    """Number of frames in the cache."""

    frames: int = 32
    """Number of frames that are kept."""
    before: int = 8
    """Number of frames before a jump's target that are kept, too. Going back needs them next, and a jump is slow."""


CACHE_SIZE: Final = CacheSize()


class FrameCache(Generic[Encoded]):
    """Frames of a video file as encoded by `encode`; safe for several threads."""

    def __init__(self, path: Path, encode: Callable[[Pixels], Encoded]) -> None:
        """`encode` converts (H, W, 3) RGB to the cached form of a frame.

        Raises:
            UserError: The file cannot be opened.
        """
        self._path, self._encode = path, encode
        self._footage = open_footage(str(path))
        self._frames: Iterator[tuple[Image, Pixels]] = iter(())
        self._next = -1
        """Index of the next frame; -1 if none has been decoded."""
        self._kept: OrderedDict[int, Encoded] = OrderedDict()
        self._lock = threading.Lock()

    def frame(self, image: Image) -> Encoded:
        """Return the frame with the image's `frame_index`.

        Raises:
            UserError: It cannot be decoded, or the image has no index.
        """
        index = image.frame_index
        if index is None:
            raise UserError(f"{image.file_name}: frame_index: is missing")
        with self._lock:
            if index not in self._kept:
                self._decode(index)
            self._kept.move_to_end(index)
            return self._kept[index]

    def _decode(self, index: int) -> None:
        """Cache a frame, and those shortly before it that are decoded on the way."""
        if not 0 <= self._next <= index <= self._next + FOOTAGE_LIMITS.seek_frames:
            begin = max(0, index - CACHE_SIZE.before)
            self._frames, self._next = self._footage.frames(begin), begin
        for frame, pixels in self._frames:
            assert frame.frame_index is not None
            self._next = frame.frame_index + 1
            if frame.frame_index >= index - CACHE_SIZE.before:
                self._kept[frame.frame_index] = self._encode(pixels)
            while len(self._kept) > CACHE_SIZE.frames:
                self._kept.popitem(last=False)
            if frame.frame_index == index:
                return
            if frame.frame_index > index:
                break
        self._next = -1
        raise UserError(f"{self._path}: frame {index} cannot be decoded")
