"""Frames of a video as pictures, in any order, though most are asked for one after another."""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from skope.errors import UserError
from skope.eval.inference.footage import Pixels, open_footage
from skope.schema import Image
from skope.viewer.pictures import Picture, encoded

_KEPT: Final = 32
"""Pictures that are kept."""
_FAR: Final = 50
"""So many frames are as soon decoded as jumped over."""


class VideoFrames:
    """A video file that pictures are taken from; several threads may ask at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._footage = open_footage(str(path))
        self._frames: Iterator[tuple[Image, Pixels]] = iter(())
        self._next = -1
        """Index of the frame that comes next, or less; -1 before the first."""
        self._kept: OrderedDict[int, Picture] = OrderedDict()
        self._lock = threading.Lock()

    def picture(self, image: Image) -> Picture:
        """The picture of a frame, by its `frame_index`; a UserError where it cannot be decoded."""
        index = image.frame_index
        if index is None:
            raise UserError(f"{image.file_name}: frame_index: is missing")
        with self._lock:
            if index not in self._kept:
                self._kept[index] = encoded(self._decoded(index))
            self._kept.move_to_end(index)
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
            return self._kept[index]

    def _decoded(self, index: int) -> Pixels:
        if not 0 <= index - self._next <= _FAR or self._next < 0:
            self._frames, self._next = self._footage.frames(index), index
        for frame, pixels in self._frames:
            assert frame.frame_index is not None
            self._next = frame.frame_index + 1
            if frame.frame_index == index:
                return pixels
            if frame.frame_index > index:
                break
        self._next = -1
        raise UserError(f"{self._path}: frame {index} cannot be decoded")
