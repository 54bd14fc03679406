"""Options that several commands of `skope eval` take, and checks of their values."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final

from skope.detector.network_settings import BACKEND_CHOICES, PRECISION_CHOICES
from skope.errors import UserError
from skope.terminal.command_options import panel

if TYPE_CHECKING:
    from skope.detector.network_settings import Settings


_MOST_PIXELS: Final = 10_000.0


def numbers_of(flag: str, text: str) -> list[float]:
    """Return the numbers of a text like "0,1,2.5". Raises UserError with the flag for other texts."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise UserError(f"{flag}: expected numbers, got {text!r}")
    return values


def check_pixels(flag: str, *values: float | None) -> None:
    """Raise a UserError that names the flag unless all values are None or plausible lengths in an image, pixels."""
    for value in values:
        if value is not None and not 0 <= value <= _MOST_PIXELS:
            raise UserError(f"{flag}: expected pixels from 0 to {_MOST_PIXELS:g}, got {value:g}")


def check_probability(flag: str, value: float) -> None:
    """Raise a UserError that names the flag unless the value is from 0 to 1."""
    if not 0 <= value <= 1:
        raise UserError(f"{flag}: expected a number from 0 to 1, got {value}")


data_option, counts, output, machine = map(panel, ("Data", "What counts", "Output", "Machine"))

PAPER_PROTOCOL = "paper"
PROTOCOL_CHOICES = ("pooled", PAPER_PROTOCOL)
"""Protocols of the metrics: `pooled` (ratios of sums over the split) and `paper` (means of per-image ratios)."""

BackendOption = Annotated[
    str,
    machine(
        choices=BACKEND_CHOICES,
        help="Inference backend. auto: OpenVINO if it is installed and there is no GPU, else torch.",
    ),
]
PrecisionOption = Annotated[
    str,
    machine(
        choices=PRECISION_CHOICES,
        help="Number format of the network. auto: the fastest that backend, processor and checkpoint support.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """Options on how a checkpoint is run on this machine."""

    device: Annotated[str, machine(metavar="[auto|cpu|cuda|cuda:N]", help="Device for computation.")] = "auto"
    backend: BackendOption = "torch"
    precision: PrecisionOption = "float32"
    min_size: Annotated[
        int | None,
        machine(help="Short side of the image in the network, pixels.", show_default="that of the training"),
    ] = None
    batch_size: Annotated[
        int | None, machine(help="Number of images per batch.", show_default="1, on a GPU 8 or 16")
    ] = None

    def settings(self, **further: Any) -> "Settings":
        """Return the settings of inference; `further` are values of its other fields."""
        from skope.detector.network_settings import Settings

        names = ("device", "backend", "precision", "min_size", "batch_size")
        return Settings(**{name: getattr(self, name) for name in names}, **further)


@dataclass(frozen=True, kw_only=True)
class FastMachineOptions(MachineOptions):
    """Machine options for commands that may give slightly different results on different machines."""

    backend: BackendOption = "auto"
    precision: PrecisionOption = "auto"
