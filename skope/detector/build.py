"""Build a Keypoint R-CNN with 33 keypoints from torchvision's parts and a config.

Boxes and keypoints are continuous pixel coordinates of the input image, as everywhere in skope. torchvision resizes the
image before the network and scales the results back by the same two factors.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Self

from torch import nn
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.keypoint_rcnn import KeypointRCNNHeads, KeypointRCNNPredictor
from torchvision.ops import FrozenBatchNorm2d

from skope import keypoints, schema
from skope.detector.backbones import BACKBONE_CHOICES, DEFAULT_BACKBONE, with_pyramid
from skope.errors import UserError, one_of
from skope.records import check_number, check_whole, dataclass_of

NORM_NAMES: Final = ("frozen", "batch")


@dataclass(frozen=True)
class NetworkDefaults:
    """Sizes of torchvision's Keypoint R-CNN, and limits of its detections."""

    anchors: tuple[int, ...] = (32, 64, 128, 256, 512)
    """Sides of the anchors in torchvision's own model, pixels inside the network: one per level of the pyramid."""
    aspects: tuple[float, float, float] = (0.5, 1.0, 2.0)
    """Ratios of height to width of the anchors of a level, as in torchvision's own model."""
    max_detections: int = 300
    """Maximum number of detections in an image, vehicles and other road users together. torchvision's default of 100 is
    too low for a queue at rush hour."""
    proposals: int = 300
    """Number of regions that the second stage examines. The remaining regions of torchvision's default of 1000 take a
    third of the time on a CPU and give no additional vehicle (docs/evidence/speed.md)."""
    pyramid_width: int = 256
    """Number of channels of the pyramid in torchvision's own model."""
    heads: tuple[int, int, int] = (8, 512, 1024)
    """Number and width of the layers of torchvision's own keypoint head, and width of its box head."""
    box_cells: int = 7
    """Number of cells along each side of a region in the box head, as in torchvision's own model."""


NETWORK_DEFAULTS: Final = NetworkDefaults()

SIZE_RANGES: Final[dict[str, tuple[int, int]]] = {
    "pyramid_width": (16, 512),
    "keypoint_layers": (1, 16),
    "keypoint_width": (16, 1024),
    "box_width": (16, 4096),
}
"""Minimum and maximum of each field that sets the size of a part of the network."""


@dataclass(frozen=True, kw_only=True)
class DetectorConfig:
    """Configuration of a model that its state dict does not contain."""

    norm: str
    """`frozen` (FrozenBatchNorm2d, for pretrained weights) or `batch` (trainable BatchNorm2d)."""
    norm_eps: float
    """Number that normalisation adds to each variance; 0 in the weights trained on COCO."""
    min_size: int
    """Short side of the image inside the network, pixels, unless its long side would then exceed `max_size`."""
    max_size: int
    """Maximum long side of the image inside the network, pixels."""
    scheme: str = keypoints.SCHEME
    """Scheme of the keypoints: a name in `keypoints.SCHEMES`."""
    anchors: tuple[int, ...] = NETWORK_DEFAULTS.anchors
    """Sides of the anchors of each level of the pyramid, finest first, pixels inside the network."""
    categories: tuple[str, ...] = schema.VEHICLE_ALONE
    """Names of the classes, from `schema.CATEGORY_NAMES`. Label k of the network is the k-th class, label 0 the
    background. Vehicles have label 1; only they have keypoints."""
    box_passes: int = 1
    """Number of passes of the box head. The second pass corrects each box again, from the features inside it."""
    backbone: str = DEFAULT_BACKBONE
    """Network that computes the feature maps: a name in `skope.detector.backbones.BACKBONE_CHOICES`."""
    pyramid_width: int = NETWORK_DEFAULTS.pyramid_width
    """Number of channels of the pyramid's maps and of the proposals' head on them."""
    keypoint_layers: int = NETWORK_DEFAULTS.heads[0]
    """Number of convolutions of the keypoint head before its predictor."""
    keypoint_width: int = NETWORK_DEFAULTS.heads[1]
    """Number of channels of each of these convolutions."""
    box_width: int = NETWORK_DEFAULTS.heads[2]
    """Number of channels of both layers of the box head."""

    def __post_init__(self) -> None:
        one_of("scheme", self.scheme, tuple(keypoints.SCHEMES))
        check_anchors(self.anchors)
        object.__setattr__(self, "categories", schema.checked_categories(self.categories))
        one_of("norm", self.norm, NORM_NAMES)
        check_box_passes(self.box_passes)
        one_of("backbone", self.backbone, tuple(BACKBONE_CHOICES))
        for name in SIZE_RANGES:
            check_size(name, getattr(self, name))
        check_number("norm_eps", self.norm_eps, 0, 0.999)
        for name in ("min_size", "max_size"):
            # Below 64, the last map of the backbone may be a single cell, which has no variance for the normalisation.
            check_whole(name, getattr(self, name), 64, 16384)
        if self.max_size < self.min_size:
            raise UserError(f"max_size: {self.max_size} is less than min_size, {self.min_size}")

    def with_min_size(self, min_size: int) -> Self:
        """Return the config with another short side, pixels; the limit of the long side changes in proportion."""
        return replace(self, min_size=min_size, max_size=round(min_size * self.max_size / self.min_size))

    @property
    def keypoint_scheme(self) -> keypoints.Scheme:
        """Scheme of the keypoints."""
        return keypoints.SCHEMES[self.scheme]

    @property
    def heads(self) -> tuple[int, int, int]:
        """Number and width of the keypoint head's layers, and width of the box head's layers."""
        return self.keypoint_layers, self.keypoint_width, self.box_width

    @property
    def stock(self) -> bool:
        """Whether backbone and widths are those of torchvision's own Keypoint R-CNN."""
        return (self.backbone, self.pyramid_width, self.heads) == (
            DEFAULT_BACKBONE,
            NETWORK_DEFAULTS.pyramid_width,
            NETWORK_DEFAULTS.heads,
        )

    @property
    def architecture(self) -> str:
        """Description of backbone and widths; widths are omitted if they are torchvision's."""
        words = f"{BACKBONE_CHOICES[self.backbone].title}-FPN"
        if self.pyramid_width != NETWORK_DEFAULTS.pyramid_width:
            words += f" of {self.pyramid_width} channels"
        if self.heads != NETWORK_DEFAULTS.heads:
            layers, width, box_width = self.heads
            words += f", keypoint head of {layers} x {width} channels, box head of {box_width}"
        return words

    def to_dict(self) -> dict[str, Any]:
        """Return the config as JSON values, without those equal to `OPTIONAL_VALUES`."""
        values = {name: value for name, value in asdict(self).items() if OPTIONAL_VALUES.get(name) != value}
        return values | self.keypoint_scheme.fields("scheme")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the config from the result of `to_dict`.

        Raises UserError if a field is missing, unknown or invalid.
        """
        if isinstance(values, Mapping):
            keypoints.scheme_in(values, "scheme")
            values = {name: value for name, value in values.items() if name != "keypoint_edition"}
        return dataclass_of(cls, values, "config: ", OPTIONAL_VALUES)


OPTIONAL_VALUES: Final[dict[str, Any]] = {
    "categories": schema.VEHICLE_ALONE,
    "box_passes": 1,
    "backbone": DEFAULT_BACKBONE,
    "pyramid_width": NETWORK_DEFAULTS.pyramid_width,
    "keypoint_layers": NETWORK_DEFAULTS.heads[0],
    "keypoint_width": NETWORK_DEFAULTS.heads[1],
    "box_width": NETWORK_DEFAULTS.heads[2],
}
"""Values that a checkpoint may omit: those of torchvision's own model for vehicles alone."""


def check_anchors(anchors: Sequence[int]) -> None:
    """Raise a UserError unless the values are valid anchor sides, one per level of the pyramid, in ascending order."""
    whole = all(isinstance(side, int) and not isinstance(side, bool) and side >= 4 for side in anchors)
    if not whole or len(anchors) != len(NETWORK_DEFAULTS.anchors) or list(anchors) != sorted({*anchors}):
        raise UserError(
            f"anchors: expected {len(NETWORK_DEFAULTS.anchors)} rising sides from 4 pixels, got {list(anchors)}"
        )


def check_box_passes(passes: int) -> None:
    """Raise a UserError unless the number of box head passes is supported."""
    if isinstance(passes, bool) or passes not in (1, 2):
        raise UserError(f"box_passes: expected 1 or 2, got {passes!r}")


def check_size(name: str, value: object) -> None:
    """Raise a UserError unless a field of `SIZE_RANGES` may have this value."""
    check_whole(name, value, *SIZE_RANGES[name])


class KeypointNetwork(KeypointRCNN):  # type: ignore[misc]  # torchvision has no types
    """torchvision's Keypoint R-CNN with one or two passes of the box head."""

    box_passes: int = 1
    """Number of passes of the box head."""


def box_passes_of(model: KeypointRCNN) -> int:
    """Return the number of box head passes of a model; 1 for torchvision's own."""
    return int(getattr(model, "box_passes", 1))


def build(config: DetectorConfig, *, trainable_layers: int = 5, num_keypoints: int = keypoints.K) -> KeypointNetwork:
    """Build a Keypoint R-CNN (He et al., 2017) for a config, with random weights from torch's random state.

    Args:
        config: Backbone, widths, categories, normalisation, and size of the images inside the network.
        trainable_layers: Number of trainable backbone stages with frozen normalisation, 0 to 5, from the last one. With
            trainable normalisation all stages are trainable, as in torchvision.
        num_keypoints: Number of keypoints. Values other than 33 are for weights with a different keypoint scheme; the
            keypoint predictor is then replaced afterwards.
    """
    norm = FrozenBatchNorm2d if config.norm == "frozen" else nn.BatchNorm2d
    backbone = with_pyramid(
        config.backbone,
        config.pyramid_width,
        norm_layer=functools.partial(norm, eps=config.norm_eps),
        trainable_stages=trainable_layers if config.norm == "frozen" else 5,
    )
    model = KeypointNetwork(
        backbone,
        **_heads(config, num_keypoints),
        min_size=config.min_size,
        max_size=config.max_size,
        box_detections_per_img=NETWORK_DEFAULTS.max_detections,
        rpn_post_nms_top_n_test=NETWORK_DEFAULTS.proposals,
        rpn_anchor_generator=AnchorGenerator(
            tuple((side,) for side in config.anchors), (NETWORK_DEFAULTS.aspects,) * len(NETWORK_DEFAULTS.anchors)
        ),
    )
    model.box_passes = config.box_passes
    return model


def _heads(config: DetectorConfig, num_keypoints: int) -> dict[str, Any]:
    """Return torchvision's arguments for the heads of a config; empty for torchvision's own heads."""
    classes = 1 + len(config.categories)  # 0 is the background
    if config.heads == NETWORK_DEFAULTS.heads:
        return {"num_classes": classes, "num_keypoints": num_keypoints}
    layers, width, box_width = config.heads
    return {
        "box_head": TwoMLPHead(config.pyramid_width * NETWORK_DEFAULTS.box_cells**2, box_width),
        "box_predictor": FastRCNNPredictor(box_width, classes),
        "keypoint_head": KeypointRCNNHeads(config.pyramid_width, (width,) * layers),
        "keypoint_predictor": KeypointRCNNPredictor(width, num_keypoints),
    }
