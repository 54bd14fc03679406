"""Choose the backend for the costly parts (torch or a faster runtime for CPUs) and its number format.

With int8, inputs are rounded to 256 steps over the range of their layer, weights to 255 steps over that of each output
channel, and sums are exact. The rounding is written as ONNX nodes that quantise and dequantise, which runtimes convert
to integer arithmetic.

For images of one size, anchors are computed once. Images are normalised after resizing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from skope.detector import int8_ranges, network_settings
from skope.detector.backends import bfloat16, network_parts
from skope.detector.backends.region_suppression import suppress_best_first, suppress_together
from skope.detector.backends.runtimes import RUNTIME_CLASSES, Runtime, UnusableError
from skope.detector.device import TORCH_FORMATS, choose_number_format
from skope.detector.int8_ranges import Ranges
from skope.errors import UserError
from skope.terminal.console import Console


def resize_first(model: KeypointRCNN) -> None:
    """Make a model resize images before it normalises them."""
    model.transform = ResizeFirst(model.transform)


def keep_anchors(model: KeypointRCNN) -> None:
    """Make a model keep the anchors for the most recent image size."""
    model.rpn.anchor_generator = KeptAnchors(model.rpn.anchor_generator)


class ResizeFirst(GeneralizedRCNNTransform):  # type: ignore[misc]  # torchvision has no types
    """torchvision's transform in reverse order, with the same result up to rounding: fewer pixels are normalised."""

    def __init__(self, transform: GeneralizedRCNNTransform) -> None:
        super().__init__(
            transform.min_size, transform.max_size, transform.image_mean, transform.image_std, transform.size_divisible
        )

    def normalize(self, image: Tensor) -> Tensor:
        """Return the image unchanged, because `resize` normalises it."""
        return image

    def resize(self, image: Tensor, target: Any = None) -> tuple[Tensor, Any]:
        """Return the image (3, h, w) for the network, from (3, H, W) with values from 0 to 1, and the target."""
        resized, moved = super().resize(image, target)
        return super().normalize(resized), moved


class KeptAnchors(nn.Module):
    """`AnchorGenerator` that computes the anchors again only if the size of the images changes."""

    def __init__(self, generator: AnchorGenerator) -> None:
        super().__init__()
        self._generator = generator
        self._kept: tuple[Any, list[Tensor]] = (None, [])

    def forward(self, images: ImageList, maps: list[Tensor]) -> list[Tensor]:
        """Return the (A, 4) anchors of each image on its feature maps."""
        first = maps[0]
        key = (
            images.tensors.shape,
            len(images.image_sizes),
            first.dtype,
            first.device,
            *(feature_map.shape[2:] for feature_map in maps),
        )
        if key != self._kept[0]:
            self._kept = (key, self._generator(images, maps))
        return self._kept[1]


@dataclass(frozen=True)
class Int8Steps:
    """Numbers of steps of int8."""

    inputs: int = 255
    """Number of steps of an input."""
    weights: int = 127
    """Number of steps of a weight to either side of 0."""
    least: float = 1e-12
    """Minimum step of a weight, for channels that contain only zeros."""


INT8_STEPS: Final = Int8Steps()


def convert(model: nn.Module, ranges: Ranges) -> None:
    """Replace layers that have ranges by rounding layers."""
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
        low, high = min(low, 0.0), max(high, 0.0)  # zeros of the padding must be exact
        self._step = max(high - low, INT8_STEPS.least) / INT8_STEPS.inputs
        self._zero = round(-low / self._step)
        largest = layer.weight.detach().flatten(1).abs().amax(1)
        self._steps = (largest / INT8_STEPS.weights).clamp(min=INT8_STEPS.least)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.fake_quantize_per_tensor_affine(x, self._step, self._zero, 0, INT8_STEPS.inputs)
        zeros = torch.zeros(len(self._steps), dtype=torch.int32)
        weight = torch.fake_quantize_per_channel_affine(
            self.layer.weight, self._steps, zeros, 0, -INT8_STEPS.weights - 1, INT8_STEPS.weights
        )
        if isinstance(self.layer, nn.Conv2d):
            layer = self.layer
            geometry = (layer.stride, layer.padding, layer.dilation, layer.groups)
            return nn.functional.conv2d(x, weight, layer.bias, *geometry)  # type: ignore[arg-type]
        return nn.functional.linear(x, weight, self.layer.bias)


def prepare(
    model: KeypointRCNN,
    metadata: Mapping[str, Any],
    device: torch.device,
    *,
    backend: str,
    precision: str,
    one_size: bool = True,
    console: Console,
) -> str:
    """Replace the costly parts of a model by a backend.

    Args:
        model: On `device`, in evaluation mode; changed in place.
        metadata: Metadata of the model's checkpoint.
        device: Device of the other parts.
        backend: `auto`, `torch`, or a key of `RUNTIME_CLASSES`. `auto` selects OpenVINO on a CPU if it is installed.
        precision: Number format of the products: `float32`, `bfloat16`, `int8`, or `auto` for the fastest one that
            backend, processor and checkpoint support.
        one_size: Whether all images have one of a few sizes, so that a runtime can prepare for them.
        console: Receives a warning if `auto` finds a broken runtime.

    Returns:
        Description of backend and number format.

    Raises:
        UserError: The backend is missing or broken, or does not support the number format.
    """
    keep_anchors(model)
    if device.type == "cpu":
        suppress_best_first(model)
    name = (network_settings.FASTEST_BACKEND if device.type == "cpu" else "torch") if backend == "auto" else backend
    if name != "torch":
        if device.type != "cpu":
            raise UserError(f"--backend {backend}: computes on the CPU only; give --device cpu, or --backend torch")
        try:
            return _by_runtime(RUNTIME_CLASSES[name](), model, metadata, precision, one_size=one_size)
        except UnusableError as error:
            if backend != "auto":
                raise
            if not error.missing:
                console.say(f"{error}; torch computes instead")
    number = choose_number_format(precision, "torch", TORCH_FORMATS, ranged=False, device=device)
    if number == "bfloat16":
        bfloat16.convert(model)
    if device.type == "cuda":
        suppress_together(model)
    return number


def _by_runtime(
    runtime: Runtime, model: KeypointRCNN, metadata: Mapping[str, Any], precision: str, *, one_size: bool
) -> str:
    """Make a runtime compute the parts of a model; the model stays unchanged if the runtime fails."""
    ranges = int8_ranges.read(model, metadata)
    number = choose_number_format(
        precision, runtime.backend, runtime.formats, ranged=ranges is not None, device=torch.device("cpu")
    )
    try:
        if number == "int8" and ranges is not None:
            convert(model, ranges)
        parts = network_parts.parts_of(model)
        runs = {
            name: runtime.compile(replace(part, steady=part.steady and one_size), number)
            for name, part in parts.items()
        }
    except UnusableError:
        revert(model)
        raise
    network_parts.hand_over(model, runs)
    resize_first(model)
    return f"{number} by {runtime.module} {runtime.version}"
