"""`Detector`: a loaded detector that runs on images and videos."""

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
    """A loaded detector; made by `load_detector`. Threads can share it."""

    def __init__(self, predictor: "Predictor") -> None:
        self._predictor = predictor

    @property
    def checkpoint(self) -> Path:
        """Path of the file with the weights."""
        return self._predictor.weights

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the classes that it detects, for example ("vehicle", "pedestrian")."""
        return self._predictor.categories

    def __call__(self, image: Pixels | str | Path) -> "Detections":
        """Detect the vehicles in an image.

        Args:
            image: (H, W, 3) RGB pixels of type uint8, or the path of an image file. OpenCV reads BGR: give
                `bgr[..., ::-1]`.

        Returns:
            Detections with `boxes_xyxy` (N, 4), `scores` (N,) and `keypoints` (N, 33, 3) in image pixels, highest score
            first. `detections.above(0.5)` keeps those with higher scores. If the detector was trained for them,
            `road_users` has boxes, scores and categories of people on foot and on two wheels.

        Raises:
            UserError: The file cannot be read, or the pixels are of another shape or type.
        """
        return self._found([_pixels("image", image)])[0]

    def detect_batch(self, images: Sequence[Pixels | str | Path]) -> "list[Detections]":
        """Detect the vehicles in several images. Images of one size are processed as one batch.

        Args:
            images: (H, W, 3) RGB pixels of type uint8, or paths of image files.

        Returns:
            Detections of each image, in the order of the images.

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
        """Open a video, a stream or a folder of images. Computation starts with the first frame that is read.

        Args:
            source: A video file, an image, a folder or glob of images, or the address of a stream.
            camera: The camera, or its file as in `read_camera`. With a camera the video has tracks in metres. A camera
                of another image size is scaled, with a warning.
            ground: Height of the level road in the camera's world, metres. "auto": 0, or a fitted plane if the vehicles
                contradict 0. "fit": a fitted plane. None: unknown; distance follows from the size of the vehicles.
            score: Score threshold, 0 to 1.
            every: Frame stride: 1 takes every frame, 5 every fifth.
            start_s: Start, seconds of the video.
            end_s: End, seconds of the video; None for its end.
            every_frame: Run the detector on every frame. By default it runs twice per second on a CPU, and points on
                the vehicles are tracked in between, as in `skope eval predict`.
            fps: Frame rate of image files, which have no times, or of a video with missing or wrong time stamps.

        Returns:
            The footage. Iterate over it for its frames.

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
    """Return the pixels of an argument, which can be the path of an image file."""
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
        checkpoint: A checkpoint file, the folder of a training run, or the name of shipped weights ("road33",
            "road33-lite").
        device: "auto" (a GPU if there is one), "cpu", "cuda" or "cuda:1".
        backend: Inference backend: "torch", "openvino" (2 to 4 times as fast on a CPU; pip install 'skope[openvino]'),
            "onnx", or "auto": OpenVINO if it is installed and there is no GPU, else torch. OpenVINO compiles for each
            image size, which takes 1.5 s, and keeps the last four sizes.
        precision: Number format: "float32", "bfloat16", "int8" (OpenVINO), or "auto": the fastest one that backend,
            processor and checkpoint support. For equal results on all machines: backend="torch", precision="float32".
        min_size: Short side of the image in the network, pixels; None for the size of the training.
        min_score: Score threshold. Vehicles below it are not reported and cost no time.
        tiles: "auto" to process tiles of an image, too, if it is larger than the network's input.

    Returns:
        The detector. Call it with an image.

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
