"""Input of the page: frames of the footage, and files of points and cameras that a user loads."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from skope.camera.calibration_files import read_uncertain_camera
from skope.camera.model import Camera
from skope.camera.point_files import read_points
from skope.dataset.camera_of_file import fitted_camera, read_camera
from skope.dataset.folder import read_image
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.schema import Image
from skope.site.page.site_store import camera_dict, point_entry
from skope.types import Pixels
from skope.video.footage import open_footage
from skope.video.frame_cache import FrameCache
from skope.viewer.collection import Picture, encoded, read_picture


@dataclass(frozen=True)
class InputRules:
    """Settings for choosing a frame, and errors of a given lens."""

    compared_frames: int = 7
    """Number of compared frames for finding the sharpest one."""
    focal_share: float = 0.01
    """Relative standard deviation of the focal length of a camera file. Zoom and focus may have changed since."""
    k1_sigma: float = 0.02
    """Standard deviation of its k1."""


INPUT_RULES: Final = InputRules()


class SiteFrames:
    """Images of footage by number, all of one size."""

    def __init__(
        self,
        title: str,
        count: int,
        size: tuple[int, int],
        picture: Callable[[int], Picture],
        source: str | None = None,
    ) -> None:
        self.title, self.count, self.size, self.picture = title, count, size, picture
        self.source = source
        """Source of the footage for commands; None if there is none."""

    @classmethod
    def of_footage(cls, source: str) -> "SiteFrames":
        """Return the frames of an image, a folder of images or a video file.

        Raises:
            UserError: It is none of these, or cannot be read.
        """
        footage = open_footage(source)
        if footage.live or footage.location is None:
            raise UserError(f"{source}: a stream has no frames to go back to; record some seconds of it")
        if footage.images:
            paths = footage.images
            size = _size(read_image(paths[0]))
            return cls(Path(source).name or source, len(paths), size, lambda i: read_picture(paths[i]), source)
        frames, count = FrameCache(Path(source), encoded), max(1, len(footage))

        def picture(number: int) -> Picture:
            return frames.frame(Image(id=1, file_name=footage.name, width=1, height=1, frame_index=number))

        return cls(Path(source).name, count, _size(decoded_frame(picture(0))), picture, source)

    @classmethod
    def canvas(cls, size: tuple[int, int], title: str) -> "SiteFrames":
        """Return an empty canvas of a size without footage, for points that were marked elsewhere."""

        def picture(number: int) -> Picture:
            raise UserError("an empty canvas has no images")

        return cls(title, 0, size, picture)

    def clearest(self) -> int:
        """Return the number of the sharpest of some frames from all of the footage, to avoid fog and headlights."""
        numbers = (
            sorted({round(i) for i in np.linspace(0, self.count - 1, INPUT_RULES.compared_frames).tolist()})
            if self.count
            else []
        )
        best, most = 0, -1.0
        for number in numbers:
            try:
                pixels = decoded_frame(self.picture(number))
            except UserError:
                continue
            grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
            sharp = float(cv2.Laplacian(grey, cv2.CV_64F).var())
            if _size(pixels) == self.size and sharp > most:
                best, most = number, sharp
        return best


def decoded_frame(picture: Picture) -> Pixels:
    """Return (H, W, 3) RGB of an image."""
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise UserError("a frame cannot be decoded")
    return np.asarray(pixels, dtype=np.uint8)


def _size(pixels: Pixels) -> tuple[int, int]:
    return pixels.shape[1], pixels.shape[0]


POINT_FILES: Final = (".otrfpts", ".csv")
CAMERA_FILES: Final = (".json", ".yml", ".yaml", ".xml", ".txt")


def read_file(sent: Mapping[str, Any], folder: Path, size: tuple[int, int]) -> dict[str, Any]:
    """Return parts of the document from a file of the browser: `points` with their `world`, or `lens` and `camera`.

    `said` is a message to the user.

    Args:
        sent: `name` and `text` of the file.
        folder: An empty folder for a temporary copy of the file.
        size: Width and height of the footage, pixels.

    Raises:
        UserError: The file has another type; the message has its name in the browser.
    """
    name, text = sent.get("name"), sent.get("text")
    if not isinstance(name, str) or not isinstance(text, str):
        raise UserError("expected name and text of a file")
    suffix = Path(name).suffix.lower()
    if suffix not in POINT_FILES + CAMERA_FILES:
        raise UserError(f"{name}: expected points ({', '.join(POINT_FILES)}) or a camera ({', '.join(CAMERA_FILES)})")
    # The name comes from the user: as a path it could lead anywhere.
    path = folder / f"file{suffix}"
    write_text(path, text)
    try:
        found = loaded(path, size)
    except UserError as error:
        raise UserError(str(error).replace(str(path), name)) from None
    return found | {"said": found["said"].replace(str(path), name)}


def loaded(path: Path, size: tuple[int, int]) -> dict[str, Any]:
    """Return parts of the document from a file of points or a camera. Raises UserError if the file is invalid."""
    if path.suffix.lower() in POINT_FILES:
        file = read_points(path)
        # Coordinates from a local origin have more digits than the file: tenths of millimetres are kept.
        points = [entry | {"place": np.round(entry["place"], 4).tolist()} for entry in map(point_entry, file.points)]
        world = {"world": dict(file.world)} if file.world else {}
        return {"points": points, **world, "said": "; ".join(file.notes)}
    camera, posed = read_camera(path, size)
    known = read_uncertain_camera(path) if posed and path.suffix.lower() == ".json" else None
    camera, scaled = fitted_camera(camera, size, str(path), "the footage")
    lens = {"lens": lens_of(camera)}
    if not posed:
        message = "the file has only the lens: mark points, or lengths and parallel lines, for the pose of the camera"
        message = f"{scaled}; {message}" if scaled else message
        return {**lens, "said": message}
    return {**lens, "camera": camera_dict(known, camera) | {"trusted": True}, "said": scaled}


def lens_of(camera: Camera) -> dict[str, list[float]]:
    """Return the lens of a camera file as evidence: `focal_px`, and `k1` of OpenCV's usual model."""
    focal = round(float(camera.K[0, 0]), 3)
    out = {"focal_px": [focal, round(INPUT_RULES.focal_share * focal, 3)]}
    if camera.distortion.model == "brown":
        out["k1"] = [float(camera.distortion.coefficients[0]), INPUT_RULES.k1_sigma]
    return out
