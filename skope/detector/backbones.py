"""Backbones: torchvision's classifiers as feature extractors of a detector's pyramid.

Each has feature maps of strides 4, 8, 16 and 32; the pyramid adds one of stride 64. The ResNet50 pyramid equals that of
torchvision's resnet_fpn_backbone in layers and in the order of random draws.

A frozen norm is y = a x + b per channel with constant a and b. It can be folded into the convolution before it, with
weights w: the folded convolution has weights a w and bias b.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_weights
from torchvision.models import (
    MobileNet_V3_Large_Weights,
    ResNet18_Weights,
    ResNet50_Weights,
    WeightsEnum,
    mobilenet_v3_large,
    resnet18,
    resnet50,
)
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.backbone_utils import BackboneWithFPN


def convolutions_with_norms(model: KeypointRCNN) -> Iterator[tuple[nn.Module, str, str]]:
    """Modules of a backbone that contain a convolution and its norm, with the names of both.

    The blocks of a ResNet name them conv1 and bn1, conv2 and bn2, and so on. In its shortcuts, and everywhere in a
    MobileNet, they are the first two modules of a sequence.
    """
    for module in model.backbone.body.modules():
        sequence = isinstance(module, nn.Sequential)
        for convolution, norm in [("0", "1")] if sequence else [(f"conv{i}", f"bn{i}") for i in (1, 2, 3)]:
            if type(module._modules.get(convolution)) is nn.Conv2d:
                yield module, convolution, norm


@torch.no_grad()
def multiply_in(model: KeypointRCNN) -> None:
    """Permanently fold all norms of a model in evaluation mode into weights and biases."""
    for owner, convolution, norm in list(convolutions_with_norms(model)):
        layer: Any = owner.get_submodule(convolution)
        given_up: Any = owner.get_submodule(norm)
        layer.weight, layer.bias = fuse_conv_bn_weights(
            layer.weight,
            layer.bias,
            given_up.running_mean,
            given_up.running_var,
            given_up.eps,
            given_up.weight,
            given_up.bias,
        )
        owner.set_submodule(norm, nn.Identity())


NormLayer = Callable[[int], nn.Module]
"""Constructor of a normalisation layer for a number of channels."""


@dataclass(frozen=True, kw_only=True)
class Backbone:
    """Classifier of torchvision that serves as the backbone of a detector."""

    title: str
    """Name of the backbone, used in messages."""
    make: Callable[..., Any]
    """torchvision's function that builds the classifier; takes `weights` and `norm_layer`."""
    layers: str = ""
    """Attribute of the classifier that contains the layers; empty for the classifier itself."""
    stages: tuple[tuple[str, ...], ...]
    """Names of the layers of strides 2, 4, 8, 16 and 32. The last layer of each stage except the first gives a map."""
    channels: tuple[int, int, int, int]
    """Channels of the four maps, finest first."""
    imagenet: WeightsEnum
    """Weights trained on ImageNet."""
    norm_eps: float
    """Constant that normalisation adds to the variances in these weights."""

    @property
    def returned(self) -> dict[str, str]:
        """Name of the feature map of each layer that has one; argument of `BackboneWithFPN`."""
        return {stage[-1]: str(number) for number, stage in enumerate(self.stages[1:])}


RESNET_STAGES: Final = (("conv1", "bn1"), ("layer1",), ("layer2",), ("layer3",), ("layer4",))
MOBILENET_STAGES: Final = (
    ("0", "1"),
    ("2", "3"),
    ("4", "5", "6"),
    ("7", "8", "9", "10", "11", "12"),
    ("13", "14", "15", "16"),
)

DEFAULT_BACKBONE: Final = "resnet50"
"""Backbone of the paper."""
BACKBONE_CHOICES: Final[Mapping[str, Backbone]] = MappingProxyType(
    {
        DEFAULT_BACKBONE: Backbone(
            title="ResNet50",
            make=resnet50,
            stages=RESNET_STAGES,
            channels=(256, 512, 1024, 2048),
            imagenet=ResNet50_Weights.IMAGENET1K_V1,
            norm_eps=1e-5,
        ),
        "resnet18": Backbone(
            title="ResNet18",
            make=resnet18,
            stages=RESNET_STAGES,
            channels=(64, 128, 256, 512),
            imagenet=ResNet18_Weights.IMAGENET1K_V1,
            norm_eps=1e-5,
        ),
        "mobilenet_v3_large": Backbone(
            title="MobileNetV3-Large",
            make=mobilenet_v3_large,
            layers="features",
            stages=MOBILENET_STAGES,
            channels=(24, 40, 112, 960),
            imagenet=MobileNet_V3_Large_Weights.IMAGENET1K_V1,
            norm_eps=1e-3,
        ),
    }
)


def with_pyramid(name: str, width: int, *, norm_layer: NormLayer, trainable_stages: int) -> BackboneWithFPN:
    """Build a backbone with a feature pyramid (FPN; Lin et al., 2017) and random weights from torch's random state.

    Args:
        name: One of `BACKBONE_CHOICES`.
        width: Number of channels of each of the pyramid's five maps.
        norm_layer: Normalisation of the backbone; the pyramid has none.
        trainable_stages: Number of trainable stages, 0 to 5, counted from the last.

    Returns:
        Module that maps (N, 3, H, W) images to feature maps `0` to `3` and `pool`, of strides 4 to 64.
    """
    kind = BACKBONE_CHOICES[name]
    classifier = kind.make(weights=None, norm_layer=norm_layer)
    layers = classifier.get_submodule(kind.layers)
    learning = {layer for stage in kind.stages[len(kind.stages) - trainable_stages :] for layer in stage}
    for parameter_name, parameter in layers.named_parameters():
        parameter.requires_grad_(parameter_name.split(".")[0] in learning)
    return BackboneWithFPN(layers, kind.returned, list(kind.channels), width)
