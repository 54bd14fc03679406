"""Settings of inference; apart from what runs it, so that the command line can say what is wrong without torch."""

from dataclasses import dataclass
from typing import Final

from skope.errors import UserError, one_of

BACKEND_CHOICES: Final = ("auto", "torch", "openvino", "onnx")
FASTEST_BACKEND: Final = "openvino"
"""Backend that "auto" is on a CPU, where it is installed."""
PRECISION_CHOICES: Final = ("auto", "float32", "bfloat16", "int8")
TILE_CHOICES: Final = ("none", "auto")
MIN_SCORE: Final = 0.05
"""Default score threshold: a detector reports no detection with a lower score."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of inference."""

    device: str = "auto"
    """Device of the network: "cpu", "cuda", "cuda:N", or "auto" for a GPU where there is one."""
    given: bool = False
    """Leave detection out and place the keypoints of the ground-truth vehicles inside their own boxes."""
    min_score: float | None = None
    """Only detections above this go through the keypoint head; None: those above `MIN_SCORE`.

    Footage has a score of its own (`PredictJob.score`), from which this follows."""
    backend: str = "torch"
    """Library for the network's costly parts; "auto" is OpenVINO on a CPU where it is installed, else torch."""
    precision: str = "float32"
    """Number format of the costly parts' products; "auto": the fastest that backend, processor and checkpoint have."""
    min_size: int | None = None
    """Short side of images inside the network, pixels; None: what the checkpoint was trained with."""
    batch_size: int | None = None
    """Images of one size that go through the network together; default: 1 on a CPU, 8 on a GPU, 16 if it has 24 GB."""
    tiles: str = "none"
    """Whether parts of the image go through the network too: "auto" where it is larger than the network takes it."""
    one_size: bool = True
    """Whether all images have one of a few sizes. A backend then prepares for each size, which takes 1.5 s and is a
    fifth faster afterwards. The detections of an image never depend on earlier images."""
    calibrated: bool = True
    """Use the calibration beside the weights, if there is one."""

    def __post_init__(self) -> None:
        one_of("--backend", self.backend, BACKEND_CHOICES)
        one_of("--precision", self.precision, PRECISION_CHOICES)
        one_of("--tiles", self.tiles, TILE_CHOICES)
        if self.min_size is not None and not 64 <= self.min_size <= 4096:
            raise UserError(f"--min-size: expected 64 to 4096 pixels, got {self.min_size}")
        if self.batch_size is not None and self.batch_size < 1:
            raise UserError(f"--batch-size: expected a whole number from 1, got {self.batch_size}")
