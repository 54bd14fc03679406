"""The shape of the network that a recipe asks for: its backbone, and how wide its parts are."""

from dataclasses import asdict, dataclass
from typing import Any, Final

from skope.detector.backbones import BACKBONE_CHOICES
from skope.detector.build import SIZE_RANGES, check_size
from skope.errors import one_of


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Fields of `DetectorConfig` that a recipe may set; None: as the first weights have it, else torchvision's own."""

    backbone: str | None = None
    """A name in `skope.detector.backbones.BACKBONE_CHOICES`."""
    pyramid_width: int | None = None
    """Channels of the pyramid's maps."""
    keypoint_layers: int | None = None
    """Convolutions of the keypoint head."""
    keypoint_width: int | None = None
    """Channels of each of these."""
    box_width: int | None = None
    """Channels of both layers of the box head."""

    def __post_init__(self) -> None:
        if self.backbone is not None:
            one_of("backbone", self.backbone, tuple(BACKBONE_CHOICES))
        for name in SIZE_RANGES:
            if getattr(self, name) is not None:
                check_size(name, getattr(self, name))

    @property
    def asked(self) -> dict[str, Any]:
        """The values that are asked for, by field."""
        return {name: value for name, value in asdict(self).items() if value is not None}


AS_GIVEN: Final = NetworkShape()
"""Asks for nothing."""
