"""A detector that is ready to run: on images, and on videos."""

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from skope.api.footage import RoadHeight, Video, open_video
from skope.camera.model import Camera
from skope.dataset import folder
from skope.detector import weights
from skope.detector.network_settings import MIN_SCORE
from skope.errors import one_of
from skope.metrics.thresholds import KEPT_SCORE
from skope.records import check_image, check_number
from skope.types import Pixels

if TYPE_CHECKING:
    from skope.detections import Detections
    from skope.detector.predictor import Predictor


class Detector:
    """A detector that is ready to run; `load_detector` makes one. Threads may share it."""

    def __init__(self, predictor: "Predictor") -> None:
        self._predictor = predictor

    @property
    def checkpoint(self) -> Path:
        """The file that the weights were read from."""
        return self._predictor.weights

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of what it has learnt to find, as in ("vehicle", "pedestrian")."""
        return self._predictor.categories

    def __call__(self, image: Pixels | str | Path) -> "Detections":
        """Find the vehicles in an image.

        Args:
            image: (H, W, 3) RGB pixels of type uint8, or the path of an image file. OpenCV reads BGR: give
                `bgr[..., ::-1]`.

        Returns:
            Detections with `boxes_xyxy` (N, 4), `scores` (N,) and `keypoints` (N, 33, 3), in pixels of the image and
            best score first; `detections.above(0.5)` keeps those with higher scores. Where the detector has learnt
            them, `road_users` has boxes, scores and categories of people on foot and on two wheels.

        Raises:
            UserError: The file cannot be read, or the pixels are of another shape or type.
        """
        return self._found([_pixels("image", image)])[0]

    def many(self, images: Sequence[Pixels | str | Path]) -> "list[Detections]":
        """Find the vehicles in several images, which go through the network together where they have one size.

        Args:
            images: (H, W, 3) RGB pixels of type uint8, or paths of image files.

        Returns:
            The detections of each image, in their order.

        Raises:
            UserError: A file cannot be read, or pixels are of another shape or type.
        """
        return self._found([_pixels(f"images[{i}]", image) for i, image in enumerate(images)])

    def _found(self, pixels: Sequence[Pixels]) -> "list[Detections]":
        scheme = self._predictor.scheme
        return [replace(found, scheme=scheme) for found in self._predictor.detections(pixels)]

    def video(
        self,
        source: str | Path,
        *,
        camera: str | Path | Camera | None = None,
        ground: RoadHeight = "auto",
        score: float = KEPT_SCORE,
        every: int = 1,
        start_s: float = 0.0,
        end_s: float | None = None,
        every_frame: bool = False,
        fps: float | None = None,
    ) -> Video:
        """Look at a video, a stream or a folder of images, frame by frame; nothing is computed before it is asked for.

        Args:
            source: A video file, an image, a folder or glob of images, or the address of a stream.
            camera: The camera, or its file as `read_camera` takes it; with one the video has tracks in metres. A camera
                of another image size is scaled, with a warning.
            ground: Height of the level road in the camera's world, metres; "auto": 0 unless the vehicles clearly show
                another plane; "fit": the plane that they show; None: unknown, so that their size tells distance.
            score: Detections above this are kept, 0 to 1.
            every: Take every so many-th frame.
            start_s: Begin at this second of a video.
            end_s: End before this second of a video; None: at its end.
            every_frame: Run the detector on every frame of a video. By default, as `skope eval predict` does, on a CPU
                it runs twice a second, and points on the vehicles are followed between.
            fps: Frames per second of image files, which carry no times, or of a video whose time stamps are missing or
                wrong.

        Returns:
            The footage: a for loop goes through its frames.

        Raises:
            UserError: The source or the camera cannot be read, or an argument is out of range.
        """
        return open_video(
            self._predictor,
            source,
            camera=camera,
            ground=ground,
            score=score,
            every=every,
            seconds=(start_s, end_s),
            every_frame=every_frame,
            fps=fps,
        )


def _pixels(name: str, image: Pixels | str | Path) -> Pixels:
    """The pixels of an argument, which may be the path of an image file."""
    return folder.read_image(Path(image)) if isinstance(image, str | PathLike) else check_image(name, image)


def load_detector(
    checkpoint: str | Path = weights.DEFAULT_WEIGHTS,
    *,
    device: str = "auto",
    backend: str = "auto",
    precision: str = "auto",
    min_size: int | None = None,
    min_score: float = MIN_SCORE,
    tiles: str = "none",
) -> Detector:
    """Load a detector.

    Args:
        checkpoint: A checkpoint file, the folder of a training run, or the name of weights that come with skope.
        device: "auto" (a GPU where there is one), "cpu", "cuda" or "cuda:1".
        backend: What computes the costly parts: "torch", "openvino" (2 to 4 times as fast on a CPU; pip install
            'skope[openvino]'), "onnx", or "auto", as `skope eval predict` does: OpenVINO where it is installed and no
            GPU is. OpenVINO takes 1.5 s more for an image whose size none of the last four sizes was.
        precision: "float32", "bfloat16", "int8" (of OpenVINO), or "auto": the fastest that backend, processor and
            checkpoint have. For the same figures on every machine: backend="torch", precision="float32".
        min_size: Short side of the image in the network, pixels; None: that of the training.
        min_score: Vehicles with lower scores are not reported, and cost no time.
        tiles: "auto" to look at parts of an image too where it is larger than the network takes it.

    Returns:
        The detector, to be called with an image.

    Raises:
        UserError: There is no such checkpoint, it is damaged, or there is no such device.
    """
    from skope.detector.network_settings import BACKEND_CHOICES, PRECISION_CHOICES, TILE_CHOICES, Settings
    from skope.detector.predictor import Predictor
    from skope.terminal.console import Console

    one_of("backend", backend, BACKEND_CHOICES)
    one_of("precision", precision, PRECISION_CHOICES)
    one_of("tiles", tiles, TILE_CHOICES)
    check_number("min_score", min_score, 0.0, 1.0)
    settings = Settings(
        device=device, backend=backend, precision=precision, min_size=min_size, min_score=min_score, tiles=tiles
    )
    return Detector(Predictor.load(Path(checkpoint), settings, Console(quiet=True)))
