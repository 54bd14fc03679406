"""Layers whose products are taken in eight bits: inputs and weights are rounded, sums are exact.

Rounded here means the pairs of quantising and dequantising nodes of ONNX, which runtimes turn into integer arithmetic.
Inputs are rounded to 256 steps over their layer's range, weights to 255 over each output channel's.
"""

from typing import Final

import torch
from torch import Tensor, nn

from skope.detector import int8_ranges
from skope.detector.int8_ranges import Ranges

_INPUT_STEPS: Final = 255
_LARGEST_STEP: Final = 127
_LEAST_STEP: Final = 1e-12
"""Least step of a weight: a channel of zeros has none."""


def convert(model: nn.Module, ranges: Ranges) -> None:
    """Put rounding layers in the place of those that have ranges."""
    for name, layer in int8_ranges.rounded_layers(model).items():
        parent, _, leaf = name.rpartition(".")
        setattr(model.get_submodule(parent), leaf, _Rounded(layer, *ranges[name]))


def revert(model: nn.Module) -> None:
    """Undo `convert`."""
    for name, rounded in [(n, m) for n, m in model.named_modules() if isinstance(m, _Rounded)]:
        parent, _, leaf = name.rpartition(".")
        setattr(model.get_submodule(parent), leaf, rounded.layer)


class _Rounded(nn.Module):
    def __init__(self, layer: nn.Conv2d | nn.Linear, low: float, high: float) -> None:
        super().__init__()
        self.layer = layer
        low, high = min(low, 0.0), max(high, 0.0)  # the padding's zeros have to be exact
        self._step = max(high - low, _LEAST_STEP) / _INPUT_STEPS
        self._zero = round(-low / self._step)
        largest = layer.weight.detach().flatten(1).abs().amax(1)
        self._steps = (largest / _LARGEST_STEP).clamp(min=_LEAST_STEP)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.fake_quantize_per_tensor_affine(x, self._step, self._zero, 0, _INPUT_STEPS)
        zeros = torch.zeros(len(self._steps), dtype=torch.int32)
        weight = torch.fake_quantize_per_channel_affine(
            self.layer.weight, self._steps, zeros, 0, -_LARGEST_STEP - 1, _LARGEST_STEP
        )
        if isinstance(self.layer, nn.Conv2d):
            layer = self.layer
            geometry = (layer.stride, layer.padding, layer.dilation, layer.groups)
            return nn.functional.conv2d(x, weight, layer.bias, *geometry)  # type: ignore[arg-type]
        return nn.functional.linear(x, weight, self.layer.bias)
