"""Frames of a video as pictures, in any order, though most are asked for one after another."""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from skope.errors import UserError
from skope.eval.inference.frame_sources import open_footage
from skope.schema import Image
from skope.types import Pixels
from skope.viewer.pictures import Picture, encoded

_KEPT_PICTURES: Final = 32
"""Pictures that are kept."""
_SEEK_FRAMES: Final = 50
"""So many frames are as soon decoded as jumped over."""
_BEFORE: Final = 8
"""So many frames before one that is jumped to are kept with it: who goes back meets them next, and a jump is slow."""


class VideoFrames:
    """A video file that pictures are taken from; several threads may ask at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._footage = open_footage(str(path))
        self._frames: Iterator[tuple[Image, Pixels]] = iter(())
        self._next = -1
        """Index of the frame that comes next; -1 where none has been decoded."""
        self._kept: OrderedDict[int, Picture] = OrderedDict()
        self._lock = threading.Lock()

    def picture(self, image: Image) -> Picture:
        """The picture of a frame, by its `frame_index`; a UserError where it cannot be decoded."""
        index = image.frame_index
        if index is None:
            raise UserError(f"{image.file_name}: frame_index: is missing")
        with self._lock:
            if index not in self._kept:
                self._decode(index)
            self._kept.move_to_end(index)
            return self._kept[index]

    def _decode(self, index: int) -> None:
        """Keep the picture of a frame, and of those shortly before it that are decoded on the way."""
        if not 0 <= self._next <= index <= self._next + _SEEK_FRAMES:
            begin = max(0, index - _BEFORE)
            self._frames, self._next = self._footage.frames(begin), begin
        for frame, pixels in self._frames:
            assert frame.frame_index is not None
            self._next = frame.frame_index + 1
            if frame.frame_index >= index - _BEFORE:
                self._kept[frame.frame_index] = encoded(pixels)
            while len(self._kept) > _KEPT_PICTURES:
                self._kept.popitem(last=False)
            if frame.frame_index == index:
                return
            if frame.frame_index > index:
                break
        self._next = -1
        raise UserError(f"{self._path}: frame {index} cannot be decoded")
