"""Size and orientation of pictures, from the first bytes of their files.

Cameras store a picture as the sensor lay and say in EXIF how to turn it. Whatever shows pictures, OpenCV included,
turns them; programs that take the stored pixels put their labels elsewhere.
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
    """Size of a picture, and its EXIF orientation."""

    stored: tuple[int, int]
    """Width and height of the pixels in the file."""
    orientation: int
    """1: shown as it is stored; 2 to 8 as EXIF counts them."""

    @property
    def turned(self) -> bool:
        """Whether what is shown are other pixels than those stored."""
        return self.orientation != UPRIGHT_ORIENTATION

    @property
    def shown(self) -> tuple[int, int]:
        """Width and height of the picture as shown."""
        width, height = self.stored
        return (height, width) if self.orientation >= 5 else (width, height)

    def shown_points(self, points: Array) -> Array:
        """Places in the picture as shown of points (..., 2) of the stored one, pixels from its corner."""
        width, height = self.stored
        x, y = points[..., 0], points[..., 1]
        left, up = width - x, height - y
        turned = {
            1: (x, y), 2: (left, y), 3: (left, up), 4: (x, up), 5: (y, x), 6: (up, x), 7: (up, left), 8: (y, left),
        }  # fmt: skip
        return np.stack(turned[self.orientation], axis=-1)


def read_header(content: Path | bytes) -> PictureHeader | None:
    """The header of a picture in a file or in memory; None where it is none that Pillow knows."""
    try:
        with (
            warnings.catch_warnings(),
            Image.open(io.BytesIO(content) if isinstance(content, bytes) else content) as file,
        ):
            warnings.simplefilter("ignore")  # of very large pictures and odd EXIF
            size, kind = file.size, file.format
            told = "exif" in file.info or kind == "TIFF"
            orientation = file.getexif().get(ORIENTATION_TAG, UPRIGHT_ORIENTATION) if told else UPRIGHT_ORIENTATION
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError, Image.DecompressionBombError):
        return None
    if not isinstance(orientation, int) or not 1 <= orientation <= 8:
        orientation = UPRIGHT_ORIENTATION
    if kind == "TIFF" and orientation >= 5:  # of these alone Pillow gives the size as shown
        size = (size[1], size[0])
    return PictureHeader(stored=size, orientation=orientation)
