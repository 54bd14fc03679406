"""Size and orientation of images, from the first bytes of their files.

Cameras store an image as the sensor was oriented and record the required rotation in EXIF. Viewers, including OpenCV,
apply it. Programs that use the stored pixels place their labels differently.
"""

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, UnidentifiedImageError

from skope.types import Array

ORIENTATION_TAG: Final = 0x0112
UPRIGHT_ORIENTATION: Final = 1


@dataclass(frozen=True)
class PictureHeader:
    """Size of an image, and its EXIF orientation."""

    stored: tuple[int, int]
    """Width and height of the stored pixels."""
    orientation: int
    """1 for an image that is shown as stored; 2 to 8 as in EXIF."""

    @property
    def turned(self) -> bool:
        """Whether the shown pixels differ from the stored pixels."""
        return self.orientation != UPRIGHT_ORIENTATION

    @property
    def shown(self) -> tuple[int, int]:
        """Width and height of the image as shown."""
        width, height = self.stored
        return (height, width) if self.orientation >= 5 else (width, height)

    def shown_points(self, points: Array) -> Array:
        """Convert points (..., 2) of the stored image to the image as shown, pixels from its corner."""
        width, height = self.stored
        x, y = points[..., 0], points[..., 1]
        left, up = width - x, height - y
        turned = {
            1: (x, y), 2: (left, y), 3: (left, up), 4: (x, up), 5: (y, x), 6: (up, x), 7: (up, left), 8: (y, left),
        }  # fmt: skip
        return np.stack(turned[self.orientation], axis=-1)


def read_header(content: Path | bytes) -> PictureHeader | None:
    """Return the header of an image in a file or in memory; None if Pillow does not recognise it."""
    try:
        with (
            warnings.catch_warnings(),
            Image.open(io.BytesIO(content) if isinstance(content, bytes) else content) as file,
        ):
            warnings.simplefilter("ignore")  # about very large images and unusual EXIF
            size, kind = file.size, file.format
            has_orientation = "exif" in file.info or kind == "TIFF"
            orientation = (
                file.getexif().get(ORIENTATION_TAG, UPRIGHT_ORIENTATION) if has_orientation else UPRIGHT_ORIENTATION
            )
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError, Image.DecompressionBombError):
        return None
    if not isinstance(orientation, int) or not 1 <= orientation <= 8:
        orientation = UPRIGHT_ORIENTATION
    if kind == "TIFF" and orientation >= 5:  # only for these, Pillow reports the size as shown
        size = (size[1], size[0])
    return PictureHeader(stored=size, orientation=orientation)
