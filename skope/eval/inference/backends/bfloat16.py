"""The detector's costly parts in bfloat16, everything that is a coordinate in float32.

Left to autocast alone, boxes would be decoded from bfloat16: 8 bits of mantissa place a corner at column 1000 to 4
pixels. Here the convolutions of backbone, proposals and heads multiply in bfloat16 and answer in float32; boxes,
suppression, the upsampling of heat maps and their maxima stay as they are.
"""

from typing import Any

import torch
from torch import nn
from torchvision.models.detection import KeypointRCNN

from skope.backbone_norms import multiply_in


def convert(model: KeypointRCNN) -> None:
    """Let the costly parts of `model` multiply in bfloat16 from now on; their weights are rounded to it for good."""
    multiply_in(model)
    heads = model.roi_heads
    model.backbone = _InBfloat16(model.backbone)
    model.rpn.head = _InBfloat16(model.rpn.head)
    heads.box_head = _InBfloat16(heads.box_head)
    heads.keypoint_head = _InBfloat16(heads.keypoint_head)


class _InBfloat16(nn.Module):
    """A module whose products are taken in bfloat16, from and to float32."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner
        # Weights are rounded and put in the order in which a CPU multiplies them once: at each call that took more than
        # half of the time.
        for layer in inner.modules():
            if isinstance(layer, nn.Conv2d):
                layer.to(torch.bfloat16).to(memory_format=torch.channels_last)
            elif isinstance(layer, nn.Linear):
                layer.to(torch.bfloat16)

    def forward(self, *inputs: Any) -> Any:
        device = next(self.inner.parameters()).device.type
        with torch.autocast(device, torch.bfloat16):
            return _as_float32(self.inner(*inputs))


def _as_float32(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.float()
    if isinstance(value, dict):
        return type(value)((name, _as_float32(part)) for name, part in value.items())
    return type(value)(_as_float32(part) for part in value)
