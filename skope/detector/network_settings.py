"""Settings of inference. This module does not import torch, so the command line can check them quickly."""

from dataclasses import dataclass
from typing import Final

from skope.errors import UserError, one_of

BACKEND_CHOICES: Final = ("auto", "torch", "openvino", "onnx")
FASTEST_BACKEND: Final = "openvino"
"""Backend that `auto` selects on a CPU if it is installed."""
PRECISION_CHOICES: Final = ("auto", "float32", "bfloat16", "int8")
INPUT_NAME: Final = "x"
"""Name of the input of exported parts of the network."""
TILE_CHOICES: Final = ("none", "auto")
MIN_SCORE: Final = 0.05
"""Default score threshold. Detections with a lower score are not reported."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of inference."""

    device: str = "auto"
    """Device of the network: "cpu", "cuda", "cuda:N", or "auto" for a GPU if there is one."""
    given: bool = False
    """Whether to skip detection and localise the keypoints of the ground-truth vehicles in their own boxes."""
    min_score: float | None = None
    """Score above which detections pass through the keypoint head; None: `MIN_SCORE`. Footage has its own score
    (`PredictJob.score`), from which this value follows."""
    backend: str = "torch"
    """Library for the costly parts of the network; "auto" selects OpenVINO on a CPU if it is installed, else torch."""
    precision: str = "float32"
    """Number format of the products; "auto" selects the fastest one that backend, processor and checkpoint support."""
    min_size: int | None = None
    """Short side of images inside the network, pixels; None: the short side of the checkpoint's training."""
    batch_size: int | None = None
    """Number of images of one size per batch. Default: 1 on a CPU, 8 on a GPU, 16 if it has 24 GB."""
    tiles: str = "none"
    """Whether tiles of the image also pass through the network; "auto": if the image exceeds the network's input."""
    one_size: bool = True
    """Whether all images have one of a few sizes. A backend then prepares for each size. This takes 1.5 s per size and
    makes inference a fifth faster. The detections in an image never depend on earlier images."""
    calibrated: bool = True
    """Whether to use the file with the score calibration beside the weights, if the file exists."""

    def __post_init__(self) -> None:
        one_of("--backend", self.backend, BACKEND_CHOICES)
        one_of("--precision", self.precision, PRECISION_CHOICES)
        one_of("--tiles", self.tiles, TILE_CHOICES)
        if self.min_size is not None and not 64 <= self.min_size <= 4096:
            raise UserError(f"--min-size: expected 64 to 4096 pixels, got {self.min_size}")
        if self.batch_size is not None and self.batch_size < 1:
            raise UserError(f"--batch-size: expected a whole number from 1, got {self.batch_size}")
