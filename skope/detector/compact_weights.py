"""Compact weights in about a seventh of the bytes: integers of at most eight bits with a step per channel, deflated.

Weights of convolutions and linear layers are rounded to multiples of a step. The steps of a tensor's output channels
are proportional to their root mean squares, times a factor of the tensor. For a given number of bytes, the sum of the
relative errors of all tensors is smallest if that factor grows with the square root of the number of weights: an
integer costs log2(1 / factor) bits plus a constant (Gish and Pierce, 1968, on quantisation before entropy coding), and
its squared error is factor^2 / 12. Small and sensitive layers (the first convolution and the predictors) keep 16 bits.
Norms, biases and counts keep all of their bits.

Rounding follows GPTQ (Frantar, Ashkboos, Hoefler and Alistarh, 2023): weights that are not rounded yet compensate for
the errors of previous weights, so that the layer's outputs change least. This needs the mean of x x^T over the layer's
inputs x.
"""

import hashlib
import json
import math
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor


@dataclass(frozen=True)
class PackingLimits:
    """Size of packed weights, and search for their steps."""

    moment_damping: float = 0.01
    """Value added to the diagonal of the moments, as a share of its mean, because the moments come from a sample."""
    columns_at_once: int = 128
    """Number of columns whose rounding errors are passed on to all later columns together."""
    most_bytes: int = 33_500_000
    """Maximum size of the rounded weights of a detector, bytes."""
    largest_step: int = 127
    """Number of steps of a rounded weight to either side of 0."""
    finest: float = 2.0**-12
    """Minimum factor in the search for the step of the largest tensor."""
    coarsest: float = 4.0
    """Maximum factor in that search."""
    halvings: int = 12
    """Number of bisections in that search."""
    sampled: int = 16
    """The search examines one in this many weights."""
    most_weights: int = 1 << 28
    """Maximum number of weights in a file. A file that declares more is rejected before memory is allocated."""


PACKING_LIMITS: Final = PackingLimits()


class CompensatedRounding:
    """Rounds the weights of a layer, those of the largest inputs first."""

    def __init__(self, moments: Tensor) -> None:
        """Store the (N, N) float32 mean of x x^T over inputs x, on the device for the computation."""
        self.device = moments.device
        damped = moments.double()
        diagonal = damped.diagonal()
        diagonal += PACKING_LIMITS.moment_damping * diagonal.mean() + torch.finfo(torch.float32).tiny
        self._order = torch.argsort(diagonal, descending=True, stable=True)
        damped = damped[self._order][:, self._order]
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(damped))
        self._influence = torch.linalg.cholesky(inverse, upper=True).float()
        """(N, N) upper triangle; each row contains the effect of a column's error on later columns."""

    def __call__(self, weights: Tensor, nearest: Callable[[Tensor], Tensor]) -> Tensor:
        """Round (C, N) float32 weights; `nearest` rounds a column (C,) to storable values."""
        influence = self._influence
        left = weights.to(self.device)[:, self._order]
        rounded = torch.empty_like(left)
        for begin in range(0, len(influence), PACKING_LIMITS.columns_at_once):
            block = left[:, begin : begin + PACKING_LIMITS.columns_at_once]
            end = begin + block.shape[1]
            errors, near = torch.empty_like(block), influence[begin:end, begin:end]
            for i in range(end - begin):
                rounded[:, begin + i] = nearest(block[:, i])
                errors[:, i] = (block[:, i] - rounded[:, begin + i]) / near[i, i]
                block[:, i + 1 :] -= errors[:, i : i + 1] * near[i : i + 1, i + 1 :]
            left[:, end:] -= errors @ influence[begin:end, end:]
        out = torch.empty_like(rounded)
        out[:, self._order] = rounded
        return out.to(weights.device)


PACKING_WAYS: Final = ("integers", "half", "exact")
"""Ways to store a weight: rounded, as float16, or unchanged."""

DELICATE_NAMES: Final = (
    "backbone.body.conv1.",  # of a ResNet
    "backbone.body.0.",  # of a MobileNet
    "rpn.head.cls_logits.",
    "rpn.head.bbox_pred.",
    "roi_heads.box_predictor.",
    "roi_heads.keypoint_predictor.",
)
"""Prefixes of the names of weights that keep 16 bits."""
_STEPS_SUFFIX: Final = ".steps"

StateDict = Mapping[str, Tensor]
PackedHeader = Mapping[str, Any]


class DamagedError(ValueError):
    """Error for damaged packed weights, with a short reason."""


# -------------------------------------------------------------------------------------------------------------- packing


def pack(
    state: StateDict, most_bytes: int = PACKING_LIMITS.most_bytes, *, moments: StateDict | None = None
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the tensors to store for a state dict, and how each weight is stored.

    Args:
        state: float32 tensors (and whole numbers, which are stored unchanged) by name.
        most_bytes: Maximum size of all rounded weights. Other weights add about a megabyte.
        moments: (N, N) mean of x x^T over the inputs x of a weight's layer, by weight, in the order of
            `weight.flatten(1)`. These weights are rounded as in `skope.detector.compact_weights`, others to the nearest
            value.

    Returns:
        Tensors by name, and for each name {"kept": one of `PACKING_WAYS`, "shape": [...]}. Integers are stored as
        deflated bytes under the weight's own name, their steps as `NAME.steps`, (channels,) float32.
    """
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
    kept = {name: {"kept": _way(name, tensor), "shape": list(tensor.shape)} for name, tensor in state.items()}
    rounded = {name: tensor.float() for name, tensor in state.items() if kept[name]["kept"] == "integers"}
    out = {name: tensor for name, tensor in state.items() if kept[name]["kept"] == "exact"}
    out |= {name: tensor.half() for name, tensor in state.items() if kept[name]["kept"] == "half"}
    for name, (data, steps) in _deflated(rounded, most_bytes, moments or {}).items():
        out[name], out[name + _STEPS_SUFFIX] = torch.frombuffer(bytearray(data), dtype=torch.uint8), steps
    return out, kept


def _way(name: str, tensor: Tensor) -> str:
    if tensor.ndim < 2 or not tensor.is_floating_point():
        return "exact"
    return "half" if name.startswith(DELICATE_NAMES) else "integers"


class _Weight:
    """Weight of C channels, with the values from which its steps are computed."""

    def __init__(self, tensor: Tensor, relative: float, moments: Tensor | None) -> None:
        self._tensor = tensor
        self._rounding = None if moments is None else CompensatedRounding(moments)
        self._sample = tensor.flatten(1)[:, :: PACKING_LIMITS.sampled].contiguous()
        self._mean_square = relative * tensor.flatten(1).square().mean(1).sqrt()
        self._finest = tensor.flatten(1).abs().amax(1) / PACKING_LIMITS.largest_step

    def steps(self, factor: float) -> Tensor:
        """Return (C,) a step per channel, large enough that no integer exceeds `PACKING_LIMITS.largest_step`."""
        return torch.maximum(factor * self._mean_square, self._finest)

    def integers(self, factor: float) -> Tensor:
        """Return the weights as multiples of the steps: int8 in the shape of the weights."""
        steps = self.steps(factor)
        if self._rounding is None:
            return _integers(self._tensor, steps)

        on_device = steps.to(self._rounding.device)
        rounded = self._rounding(self._tensor.flatten(1), lambda column: _integers(column, on_device) * on_device)
        return _integers(rounded.view(self._tensor.shape), steps)

    def bits(self, factor: float) -> float:
        """Return the entropy of all integers, estimated from a sample."""
        counts = torch.bincount(
            _integers(self._sample, self.steps(factor)).flatten().int() + PACKING_LIMITS.largest_step
        ).double()
        shares = counts[counts > 0] / counts.sum()
        return float(-(shares * shares.log2()).sum()) * self._tensor.numel()


def _integers(tensor: Tensor, steps: Tensor) -> Tensor:
    """Return int8 values in the tensor's shape; zeros for a channel of zeros."""
    inverse = torch.where(steps > 0, 1 / steps, 0).view(-1, *[1] * (tensor.ndim - 1))
    return (tensor * inverse).round().clamp(-PACKING_LIMITS.largest_step, PACKING_LIMITS.largest_step).to(torch.int8)


def _deflated(weights: StateDict, most_bytes: int, moments: StateDict) -> dict[str, tuple[bytes, Tensor]]:
    """Return deflated integers and steps of each weight, with the finest factor that fits into `most_bytes`."""
    count = sum(tensor.numel() for tensor in weights.values())
    largest = max(tensor.numel() for tensor in weights.values())
    prepared = {
        name: _Weight(tensor, math.sqrt(tensor.numel() / largest), moments.get(name))
        for name, tensor in weights.items()
    }
    factor = _finest_factor(prepared.values(), most_bytes)
    while True:
        out = {name: (_deflate(weight.integers(factor)), weight.steps(factor)) for name, weight in prepared.items()}
        excess = sum(len(data) for data, _ in out.values()) - most_bytes
        if excess <= 0 or factor >= PACKING_LIMITS.coarsest:
            return out
        # Deflate needs slightly more than the entropy; doubling the factor saves one bit per weight.
        factor *= 2.0 ** (8 * excess / count + 0.002)


def _finest_factor(weights: Iterable[_Weight], most_bytes: int) -> float:
    """Return the smallest factor of the largest tensor for which all integers fit into `most_bytes`, by entropy."""
    low, high = math.log2(PACKING_LIMITS.finest), math.log2(PACKING_LIMITS.coarsest)
    for _ in range(PACKING_LIMITS.halvings):
        middle = (low + high) / 2
        bits = sum(weight.bits(2.0**middle) for weight in weights)
        low, high = (middle, high) if bits > 8 * most_bytes else (low, middle)
    return float(2.0**high)


def _deflate(integers: Tensor) -> bytes:
    # Weights have no repeated sequences: only frequencies of integers and runs of zeros can be compressed.
    packer = zlib.compressobj(9, strategy=zlib.Z_RLE)
    return packer.compress(integers.numpy().tobytes()) + packer.flush()


# ------------------------------------------------------------------------------------------------------------ unpacking


def unpack(stored: StateDict, kept: PackedHeader) -> dict[str, Tensor]:
    """Return the rounded float32 state dict; raise a DamagedError if tensors and description do not match."""
    if not isinstance(kept, dict) or not all(_is_way(way) for way in kept.values()):
        raise DamagedError("the header says in a damaged way how the weights are kept")
    steps = {name + _STEPS_SUFFIX for name, way in kept.items() if way["kept"] == "integers"}
    if set(stored) != set(kept) | steps:
        raise DamagedError("the tensors are not those that the header lists")
    out = {}
    for name, way in kept.items():
        if way["kept"] == "integers":
            out[name] = _inflated(name, stored[name], stored[name + _STEPS_SUFFIX], way["shape"])
        else:
            out[name] = stored[name].float() if way["kept"] == "half" else stored[name]
    return out


def _is_way(way: Any) -> bool:
    if not isinstance(way, dict) or way.keys() != {"kept", "shape"} or way["kept"] not in PACKING_WAYS:
        return False
    return isinstance(way["shape"], list) and all(type(size) is int and size > 0 for size in way["shape"])


def _inflated(name: str, data: Tensor, steps: Tensor, shape: list[int]) -> Tensor:
    size = math.prod(shape)
    if not shape or size > PACKING_LIMITS.most_weights or steps.shape != (shape[0],):
        raise DamagedError(f"tensor {name}: shape {shape} is impossible")
    stream = zlib.decompressobj()
    try:
        integers = stream.decompress(data.numpy().tobytes(), size + 1)
    except zlib.error as error:
        raise DamagedError(f"tensor {name}: cannot be unpacked ({error})") from None
    if len(integers) != size or not stream.eof:
        raise DamagedError(f"tensor {name}: expected {size} weights, got another number")
    rounded = torch.frombuffer(bytearray(integers), dtype=torch.int8).view(shape[0], -1)
    return (rounded * steps[:, None]).view(shape)


def digest(stored: StateDict, header: Mapping[str, Any]) -> str:
    """Return the SHA-256, in hexadecimal, of a file's header (JSON values) and tensors."""
    hashed = hashlib.sha256(json.dumps(header, sort_keys=True, allow_nan=False).encode())
    for name in sorted(stored):
        hashed.update(f"{name} {stored[name].dtype} {list(stored[name].shape)}".encode())
        hashed.update(stored[name].contiguous().numpy().tobytes())
    return hashed.hexdigest()
