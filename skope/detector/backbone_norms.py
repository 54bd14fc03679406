"""The norms of the detector's backbone, which can be multiplied into the convolutions before them.

A norm that learns no more is y = a x + b per channel with constant a and b; after a convolution with weights w it is a
convolution with weights a w and bias b.
"""

from collections.abc import Iterator
from typing import Any

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_weights
from torchvision.models.detection import KeypointRCNN


def convolutions_with_norms(model: KeypointRCNN) -> Iterator[tuple[nn.Module, str, str]]:
    """The backbone's modules that own a convolution and its norm, with the names of both.

    A ResNet's blocks call them conv1 and bn1, conv2 and bn2 ...; in its shortcuts, and in all of a MobileNet, they are
    the first two of a sequence.
    """
    for module in model.backbone.body.modules():
        sequence = isinstance(module, nn.Sequential)
        for convolution, norm in [("0", "1")] if sequence else [(f"conv{i}", f"bn{i}") for i in (1, 2, 3)]:
            if type(module._modules.get(convolution)) is nn.Conv2d:
                yield module, convolution, norm


@torch.no_grad()
def multiply_in(model: KeypointRCNN) -> None:
    """Give up the norms of a model in evaluation mode for good: their factors and shifts become weights and biases."""
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
