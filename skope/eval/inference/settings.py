"""How a checkpoint is run; apart from what runs it, so that the command line can say what is wrong without torch."""

from dataclasses import dataclass
from typing import Final

from skope.errors import UserError, one_of

PRECISIONS: Final = ("float32", "bfloat16", "auto")
TILES: Final = ("none", "auto")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a checkpoint is run."""

    device: str = "auto"
    """Where the network runs: "cpu", "cuda", "cuda:N", or "auto" for a GPU where there is one."""
    given: bool = False
    """Leave detection out and place the keypoints of the ground-truth vehicles inside their own boxes."""
    min_score: float | None = None
    """Only detections above this go through the keypoint head; None: those above the detector's own 0.05."""
    precision: str = "float32"
    """Number format of the network's costly parts; "auto" is bfloat16 where the processor has it, else float32."""
    batch_size: int | None = None
    """Images of one size that go through the network together; by default 1 on a CPU, 8 on a GPU."""
    tiles: str = "none"
    """Whether parts of the image go through the network too: "auto" where it is larger than the network takes it."""
    calibrated: bool = True
    """Use the calibration beside the weights, if there is one."""

    def __post_init__(self) -> None:
        one_of("--precision", self.precision, PRECISIONS)
        one_of("--tiles", self.tiles, TILES)
        if self.batch_size is not None and self.batch_size < 1:
            raise UserError(f"--batch-size: expected a whole number from 1, got {self.batch_size}")
