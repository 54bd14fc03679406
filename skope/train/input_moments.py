"""Statistics of the inputs of a detector's layers, gathered from images: second moments, for rounding its weights."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN

from skope.detector.detect import detect
from skope.schema import VEHICLE_ALONE

_CALL_SAMPLES: Final = 256
"""Positions, or regions, that each call of a layer gives."""


def gather(
    model: KeypointRCNN, images: Iterable[NDArray[np.uint8]], categories: Sequence[str] = VEHICLE_ALONE
) -> dict[str, Tensor]:
    """Second moments of the inputs of all convolutions and linear layers, by the names of their weights.

    Args:
        model: In evaluation mode, on the CPU or a GPU.
        images: (H, W, 3) RGB, dozens of what the detector is for.
        categories: What the network's labels are: only vehicles go through the keypoint head.

    Returns:
        Weight's name -> (N, N) float32 mean of x x^T, where N is the number of weights of an output channel and x lie
        in the order of `weight.flatten(1)`. Layers that no image reached are left out, and convolutions in groups,
        each of whose outputs has other inputs.
    """
    layers = {name: module for name, module in model.named_modules() if _has_moments(module)}
    sums: dict[str, Tensor] = {}
    counts = dict.fromkeys(layers, 0)
    generator = torch.Generator().manual_seed(0)

    def add(name: str, module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        x = _sample(module, inputs[0].float(), generator)
        counts[name] += len(x)
        sums[name] = sums[name].addmm_(x.T, x) if name in sums else x.T @ x

    hooks = [module.register_forward_pre_hook(partial(add, name)) for name, module in layers.items()]
    device = next(model.parameters()).device
    try:
        for pixels in images:
            detect(model, [pixels], device, categories=categories)
    finally:
        for hook in hooks:
            hook.remove()
    return {f"{name}.weight": total / counts[name] for name, total in sums.items() if counts[name]}


def _has_moments(module: nn.Module) -> bool:
    return isinstance(module, nn.Linear) or (isinstance(module, nn.Conv2d) and module.groups == 1)


def _sample(module: nn.Module, x: Tensor, generator: torch.Generator) -> Tensor:
    """(M, N) inputs of some of the layer's outputs."""
    if not isinstance(module, nn.Conv2d):
        return x[_some(len(x), generator).to(x.device)]
    height, width = module.kernel_size
    stride, pad = module.stride[0], int(module.padding[0])
    across = (x.shape[3] + 2 * pad - width) // stride + 1
    down = (x.shape[2] + 2 * pad - height) // stride + 1
    chosen = _some(len(x) * down * across, generator).to(x.device)
    image, at = chosen // (down * across), chosen % (down * across)
    top, left = at // across * stride, at % across * stride
    padded = nn.functional.pad(x, (pad,) * 4)
    parts = [padded[image, :, top + i, left + j] for i in range(height) for j in range(width)]
    return torch.stack(parts, dim=2).flatten(1)


def _some(count: int, generator: torch.Generator) -> Tensor:
    if count <= _CALL_SAMPLES:
        return torch.arange(count)
    return torch.randint(count, (_CALL_SAMPLES,), generator=generator)
