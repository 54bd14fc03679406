"""Shape of the network that a recipe requests: backbone and widths."""

from dataclasses import asdict, dataclass
from typing import Any, Final

from skope.detector.backbones import BACKBONE_CHOICES
from skope.detector.build import SIZE_RANGES, check_size
from skope.errors import one_of


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Fields of `DetectorConfig` that a recipe may set. None: the value of the initial weights, else torchvision's."""

    backbone: str | None = None
    """Name in `skope.detector.backbones.BACKBONE_CHOICES`."""
    pyramid_width: int | None = None
    """Number of channels of the pyramid's maps."""
    keypoint_layers: int | None = None
    """Number of convolutions of the keypoint head."""
    keypoint_width: int | None = None
    """Number of channels of each of these convolutions."""
    box_width: int | None = None
    """Number of channels of both layers of the box head."""

    def __post_init__(self) -> None:
        if self.backbone is not None:
            one_of("backbone", self.backbone, tuple(BACKBONE_CHOICES))
        for name in SIZE_RANGES:
            if getattr(self, name) is not None:
                check_size(name, getattr(self, name))

    @property
    def asked(self) -> dict[str, Any]:
        """Return the requested values by field."""
        return {name: value for name, value in asdict(self).items() if value is not None}


AS_GIVEN: Final = NetworkShape()
"""Shape that requests nothing."""
