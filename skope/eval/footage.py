"""Frames of images, folders, globs, videos and streams, one after another, with their times."""

import contextlib
import glob
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import dataset
from skope.errors import UserError
from skope.schema import Image

Pixels = NDArray[np.uint8]

IMAGES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
_GLOB: Final = frozenset("*?[")


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Which frames of a source are wanted."""

    every: int = 1
    start_s: float = 0.0
    end_s: float = math.inf

    def __post_init__(self) -> None:
        if self.every < 1:
            raise UserError(f"--every: expected a whole number from 1, got {self.every}")
        if not 0 <= self.start_s < self.end_s:
            raise UserError(f"--start, --end: expected 0 <= start < end, got {self.start_s:g} and {self.end_s:g}")


@dataclass
class Footage:
    """A source of frames; going over it again gives the same ones, except of a stream."""

    name: str
    cut: Cut = field(default_factory=Cut)
    images: tuple[Path, ...] = ()
    """Of images; empty for a video or stream."""
    video: str | None = None
    skipped: list[str] = field(default_factory=list)
    """What could not be read, in one line each."""

    @property
    def stream(self) -> bool:
        return self.video is not None and "://" in self.video

    def __len__(self) -> int:
        """How many frames there are, as far as the file says; 0: unknown."""
        if self.video is None:
            return len(self.images[:: self.cut.every])
        with _opened(self.video) as capture:
            count, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), _rate(capture)
        last = min(count, self.cut.end_s * fps)
        return max(0, math.ceil((last - math.floor(self.cut.start_s * fps)) / self.cut.every)) if count > 0 else 0

    def fps(self) -> float | None:
        """Frames a second after the cut; None of images."""
        if self.video is None:
            return None
        with _opened(self.video) as capture:
            return _rate(capture) / self.cut.every

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        """Frames with their pixels (H, W, 3) RGB, numbered from 1 as `Image.id`; `first` of them are left out.

        What cannot be read is noted in `skipped`, and keeps its number.
        """
        return self._of_video(first) if self.video is not None else self._of_images(first)

    def _of_images(self, first: int) -> Iterator[tuple[Image, Pixels]]:
        folder = self.images[0].parent
        for number, path in enumerate(self.images[:: self.cut.every][first:], start=first + 1):
            try:
                pixels = dataset.read_image(path)
            except UserError as error:
                self._skip(str(error))
                continue
            name = path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name
            yield _image(number, name, pixels, number - 1, None), pixels

    def _of_video(self, first: int) -> Iterator[tuple[Image, Pixels]]:
        assert self.video is not None
        with _opened(self.video) as capture:
            fps = _rate(capture)
            begin = math.floor(self.cut.start_s * fps) + first * self.cut.every
            at = 0
            if begin and not self.stream and capture.set(cv2.CAP_PROP_POS_FRAMES, begin):
                at = begin
            number = first
            while at / fps < self.cut.end_s:
                wanted = at >= begin and (at - begin) % self.cut.every == 0
                good, bgr = capture.read() if wanted else (capture.grab(), None)
                if not good:
                    break
                if bgr is not None:
                    number += 1
                    pixels = np.asarray(cv2.cvtColor(_three(bgr), cv2.COLOR_BGR2RGB), dtype=np.uint8)
                    yield _image(number, f"{self.name}/{at:06d}", pixels, at, at / fps), pixels
                at += 1
            expected = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            # Containers round their counts; half a second less is a file that ends early.
            if not self.stream and at < min(expected, self.cut.end_s * fps) - max(2.0, fps / 2):
                self._skip(f"{self.video}: frame {at} of {expected:.0f} cannot be decoded")

    def _skip(self, reason: str) -> None:
        if reason not in self.skipped:  # a second pass meets the same
            self.skipped.append(reason)


def open_footage(source: str, cut: Cut) -> Footage:
    """The frames of an image, a folder of images, a glob, a video file or a stream's address.

    Raises UserError for what is none of these.
    """
    if "://" in source:
        return Footage("stream", cut, video=source)
    path = Path(source)
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGES and not p.name.startswith("."))
        if not found:
            raise UserError(f"{source}: no images in it ({', '.join(IMAGES)})")
        return Footage(path.name, cut, images=tuple(found))
    if not path.exists() and _GLOB & set(source):
        found = sorted(Path(p) for p in glob.glob(source, recursive=True))  # noqa: PTH207 (absolute patterns too)
        if not found:
            raise UserError(f"{source}: matches no file")
        return Footage("images", cut, images=tuple(found))
    if not path.is_file():
        raise UserError(f"{source}: no such file or folder")
    if path.suffix.lower() in IMAGES:
        return Footage(path.stem, cut, images=(path,))
    with _opened(source):
        return Footage(path.stem, cut, video=source)


@contextlib.contextmanager
def _opened(video: str) -> Iterator[cv2.VideoCapture]:
    capture = cv2.VideoCapture(video)
    try:
        if not capture.isOpened():
            raise UserError(f"{video}: neither an image nor a video that can be opened")
        yield capture
    finally:
        capture.release()


def _rate(capture: cv2.VideoCapture) -> float:
    fps = capture.get(cv2.CAP_PROP_FPS)
    return fps if math.isfinite(fps) and 0 < fps <= 1000 else 25.0


def _three(pixels: NDArray[np.generic]) -> Pixels:
    """Grey or 16-bit frames as 8-bit of three channels."""
    eight = (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels.astype(np.uint8)  # type: ignore[operator]
    return np.repeat(eight[..., None], 3, axis=-1) if eight.ndim == 2 else eight


def _image(number: int, name: str, pixels: Pixels, index: int, time_s: float | None) -> Image:
    height, width = pixels.shape[:2]
    return Image(id=number, file_name=name, width=width, height=height, frame_index=index, time_s=time_s)
