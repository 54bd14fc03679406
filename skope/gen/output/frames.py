"""Make finished frames: render, annotate and encode."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.dataset import coco
from skope.dataset.depth_files import depth_png
from skope.errors import UserError, one_of
from skope.gen.labels.annotate import RuleCounts, annotate, annotate_road_users
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output.writers import FrameFiles, Labels, checksum, label_fields
from skope.gen.render.frame import RenderedFrame, Renderer
from skope.gen.scene.recording import Recording
from skope.schema import Annotation, Image, RoadUser

SUFFIX_OF_FORMAT: Final = {"jpeg": ".jpg", "png": ".png", "webp": ".webp"}
"""File suffix of images for each `--image-format`."""


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """Format and quality of written images."""

    image: str = "jpeg"
    quality: int = 95
    """Quality of JPEG and WebP, 1 to 100."""
    depth: bool = True
    """Whether to write depth files."""

    def __post_init__(self) -> None:
        one_of("--image-format", self.image, tuple(SUFFIX_OF_FORMAT))
        if not 1 <= self.quality <= 100:
            raise UserError(f"--quality: expected a whole number from 1 to 100, got {self.quality}")

    def encoded(self, rgb: NDArray[np.uint8]) -> bytes:
        """Return the content of an image file."""
        options = {
            "jpeg": [cv2.IMWRITE_JPEG_QUALITY, self.quality],
            "png": [cv2.IMWRITE_PNG_COMPRESSION, 3],
            "webp": [cv2.IMWRITE_WEBP_QUALITY, self.quality],
        }[self.image]
        ok, data = cv2.imencode(SUFFIX_OF_FORMAT[self.image], cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
        assert ok
        return data.tobytes()


def frames_of(
    recording: Recording, renderer: Renderer, rules: Rules, encoding: Encoding, frames: Iterable[int]
) -> Iterator[FrameFiles]:
    """Render, annotate and encode frames of a recording.

    Args:
        recording: Recording to render.
        renderer: Renderer of the recording, from `make_renderer`.
        rules: Rules for ground truth and ignored road users.
        encoding: Format of images, and whether there are depth files.
        frames: Numbers of the frames.

    Yields:
        The bytes of each frame's files, and its labels.
    """
    for frame in frames:
        view = renderer.render(frame)
        moment, camera = recording.moment(frame), recording.camera
        annotations, tally = annotate(moment, view, camera, rules, image_id=0)
        road_users = annotate_road_users(moment, view, camera, rules, 0, 1) if recording.road_users else []
        yield files_of(recording, frame, view, annotations, tally, encoding, road_users)


def files_of(
    recording: Recording,
    frame: int,
    view: RenderedFrame,
    annotations: Sequence[Annotation],
    tally: RuleCounts,
    encoding: Encoding,
    road_users: Sequence[RoadUser] = (),
) -> FrameFiles:
    """Encode a rendered frame; the writer assigns the ids.

    Args:
        recording: The recording.
        frame: Number of the frame in it, from 0.
        view: The rendered frame.
        annotations: Labels of the vehicles, from `annotate`.
        tally: Number of vehicles that each rule applies to.
        encoding: Formats of the files.
        road_users: Labels of pedestrians and two-wheelers.
    """
    name = recording.info.frame_name(frame)
    files = {f"images/{name}{SUFFIX_OF_FORMAT[encoding.image]}": encoding.encoded(view.rgb)}
    depth_name = f"depth/{name}.png" if encoding.depth else None
    if depth_name:
        files[depth_name] = depth_png(view.depth)
    image = replace(image_of(recording, frame, next(iter(files))), depth_file_name=depth_name)
    labels = Labels(
        name=name,
        image=coco.image_to_dict(image),
        **label_fields(annotations, road_users),
        sha256={path: checksum(data) for path, data in files.items()},
        tally=vars(tally),
    )
    return FrameFiles(files, labels)


def image_of(recording: Recording, frame: int, file_name: str, image_id: int = 0) -> Image:
    """Return the image record of a recording's frame for annotation files.

    Args:
        recording: The recording.
        frame: Number of the frame in it, from 0.
        file_name: Path of the image inside the dataset.
        image_id: The image's id.
    """
    return Image(
        id=image_id,
        file_name=file_name,
        width=recording.camera.width,
        height=recording.camera.height,
        town=recording.town.name,
        site=recording.site,
        recording=recording.name,
        frame_index=frame,
        time_s=float(recording.times_s[frame]),
        split=recording.split,
        weather=recording.weather,
        sun_elevation_deg=recording.conditions.sun_elevation_deg,
        camera=recording.camera,
    )
