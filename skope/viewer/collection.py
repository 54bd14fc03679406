"""Collection of images for the viewer: splits with their vehicles, detections, and source of the images."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.dataset import shards
from skope.dataset.folder import read_image
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.schema import AnnotationFile, Image, Result

_MEDIA_TYPES: Final = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
"""Media types of the files that every browser shows, by suffix."""
_JPEG_QUALITY: Final = 90


@dataclass(frozen=True, kw_only=True)
class Picture:
    """Bytes of an image file, and its media type."""

    media_type: str
    data: bytes = field(repr=False)


def read_picture(path: Path) -> Picture:
    """Return the image in a file or in a shard's member. Raises UserError if it cannot be read."""
    media_type = _MEDIA_TYPES.get(path.suffix.lower())
    if media_type is None:
        return encoded(read_image(path))
    return Picture(media_type=media_type, data=shards.read(path))


def encoded(pixels: NDArray[np.uint8]) -> Picture:
    """Return (H, W, 3) RGB as an image file."""
    done, data = cv2.imencode(
        ".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
    assert done
    return Picture(media_type="image/jpeg", data=data.tobytes())


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownSplit:
    """Split with the detections in its images."""

    file: AnnotationFile
    results: tuple[Result, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Collection:
    """All images of the page, in the order of the splits and of their files."""

    title: str
    """Title: the dataset and its splits, or the detector and its input."""
    splits: tuple[ShownSplit, ...]
    """At least one split; all have the same keypoint scheme."""
    picture: Callable[[Image], Picture]
    """Function that returns the file of an image, or raises a UserError if it cannot be read."""
    truth: bool = True
    """Whether the vehicles in the files are ground truth; footage has none."""
    options: MetricOptions | None = None
    """Options for matching detections to the ground truth; None without predictions."""
