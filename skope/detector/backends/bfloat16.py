"""Run the costly parts of the detector in bfloat16 and all coordinates in float32.

With autocast alone, boxes would be decoded from bfloat16, whose 8-bit mantissa resolves 4 pixels at column 1000. Here
the convolutions of backbone, proposals and heads multiply in bfloat16 and return float32. Boxes, suppression, the
upsampling of heat maps and their maxima stay in float32.

On a GPU, memory access takes longer than multiplication. Convolutions therefore add their bias and the input of the
block, and take the positive part, before they write the result (fused convolutions of cuDNN).
"""

from collections import OrderedDict
from typing import Any

import torch
from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN
from torchvision.models.resnet import BasicBlock, Bottleneck

from skope.detector.backbones import multiply_in
from skope.detector.backends.network_parts import HandedProposals, PyramidWithProposals


def convert(model: KeypointRCNN) -> None:
    """Make the costly parts of `model` multiply in bfloat16. Weights of these parts are rounded permanently."""
    multiply_in(model)
    heads = model.roi_heads
    model.backbone = _Pyramid(model)
    model.rpn.head = HandedProposals(model.backbone)
    heads.box_head = _InBfloat16(heads.box_head)
    heads.keypoint_head = _InBfloat16(heads.keypoint_head)


class _InBfloat16(nn.Module):
    """Module that computes its products in bfloat16; input and output are float32."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner
        _round(inner)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, torch.bfloat16):
            return self.inner(x).float()  # type: ignore[no-any-return]


class _Pyramid(PyramidWithProposals):
    """Feature maps of an image, with the scores and offsets of the anchors on them."""

    def __init__(self, model: KeypointRCNN) -> None:
        super().__init__(model.backbone.out_channels)
        self.body, self.fpn, self.head = _body(model.backbone.body), model.backbone.fpn, model.rpn.head
        _round(self)

    def forward(self, images: Tensor) -> OrderedDict[str, Tensor]:
        with torch.autocast(images.device.type, torch.bfloat16):
            features = self.fpn(self.body(images))
            scores, offsets = self.head(list(features.values()))
        self.proposals = ([level.float() for level in scores], [level.float() for level in offsets])
        # Pooling needs maps with channels first; converting here avoids a conversion per pooling.
        return OrderedDict(
            (name, feature_map.to(torch.float32, memory_format=torch.contiguous_format))
            for name, feature_map in features.items()
        )


def _body(body: Any) -> nn.Module:
    """Layers of a backbone with folded norms; convolutions are fused if it is a ResNet."""
    return _ResNet(body) if "layer1" in body else _InTheirOrder(body)


class _InTheirOrder(nn.Module):
    """Backbone with torchvision's own layers, in bfloat16."""

    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.body = body

    def forward(self, images: Tensor) -> OrderedDict[str, Tensor]:
        return self.body(images.to(torch.bfloat16, memory_format=torch.channels_last))  # type: ignore[no-any-return]


class _ResNet(nn.Module):
    """ResNet of torchvision with fused convolutions."""

    def __init__(self, body: Any) -> None:
        super().__init__()
        self.conv1, self.maxpool = body.conv1, body.maxpool
        self.layers = nn.ModuleList(nn.Sequential(*map(_Block, body.get_submodule(f"layer{i}"))) for i in (1, 2, 3, 4))

    def forward(self, images: Tensor) -> OrderedDict[str, Tensor]:
        x = images.to(torch.bfloat16, memory_format=torch.channels_last)
        x = self.maxpool(_convolved(x, self.conv1))
        out = OrderedDict()
        for i, layer in enumerate(self.layers):
            x = out[str(i)] = layer(x)
        return out


class _Block(nn.Module):
    """Residual block of two or three convolutions."""

    def __init__(self, block: BasicBlock | Bottleneck) -> None:
        super().__init__()
        self.conv1, self.conv2 = block.conv1, block.conv2
        self.conv3 = block.conv3 if isinstance(block, Bottleneck) else None
        self.downsample = None if block.downsample is None else block.downsample[0]

    def forward(self, x: Tensor) -> Tensor:
        added = x if self.downsample is None else self.downsample(x)
        inner = _convolved(x, self.conv1)
        if self.conv3 is None:
            return _convolved(inner, self.conv2, added)
        return _convolved(_convolved(inner, self.conv2), self.conv3, added)


def _convolved(x: Tensor, layer: nn.Conv2d, added: Tensor | None = None) -> Tensor:
    """Positive part of a convolution, to which another map can be added."""
    geometry: Any = (layer.stride, layer.padding, layer.dilation, layer.groups)
    if x.is_cuda and torch.version.cuda is not None:
        if added is None:
            return torch.cudnn_convolution_relu(x, layer.weight, layer.bias, *geometry)
        return torch.cudnn_convolution_add_relu(x, layer.weight, added, 1.0, layer.bias, *geometry)
    y: Tensor = layer(x)
    return (y if added is None else y.add_(added)).relu_()


def _round(module: nn.Module) -> None:
    """Round the weights once and store them in the order of the multiplication, so that calls need not do it."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d):
            layer.to(torch.bfloat16).to(memory_format=torch.channels_last)
        elif isinstance(layer, nn.Linear):
            layer.to(torch.bfloat16)
