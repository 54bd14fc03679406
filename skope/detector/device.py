"""Device for torch, from a `--device` flag, and the number formats that it supports."""

import os
import re
from typing import Final

import torch

from skope.errors import UserError

TORCH_FORMATS: Final = ("bfloat16", "float32")
"""Number formats of torch, fastest first."""
_WITHOUT_BFLOAT16: Final = ("SSE41", "AVX", "AVX2", "AVX2_VNNI", "AVX512_CORE", "AVX512_CORE_VNNI")


def has_bfloat16(device: torch.device) -> bool:
    """Return whether the processor has instructions for bfloat16. Without them, bfloat16 is slower than float32.

    On a CPU, only instructions that the library for products may use count: ONEDNN_MAX_CPU_ISA limits them.
    """
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    able = torch.cpu.get_capabilities()
    allowed = os.environ.get("ONEDNN_MAX_CPU_ISA", "ALL").upper() not in _WITHOUT_BFLOAT16
    return allowed and bool(able.get("amx_bf16") or able.get("avx512_bf16"))


def choose_device(name: str) -> torch.device:
    """Return the device of a `--device` flag; `auto` selects a GPU if there is one."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise UserError(f"device: {name!r} is not one of auto, cpu, cuda, cuda:N")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"device: {name} is not there (torch sees {torch.cuda.device_count()} GPUs)")
    return device


def choose_number_format(
    precision: str, backend: str, formats: tuple[str, ...], *, ranged: bool, device: torch.device
) -> str:
    """Return the number format of a `--precision` option.

    Args:
        precision: One of `PRECISION_CHOICES`; `auto` selects the fastest one that is possible.
        backend: Name of the library that computes, for errors.
        formats: Number formats of the library, fastest first.
        ranged: Whether the checkpoint has the ranges of values that int8 needs.
        device: Device of the computation.

    Raises:
        UserError: The library or the checkpoint does not support the number format.
    """
    if precision == "auto":
        good = {"int8": ranged, "bfloat16": has_bfloat16(device), "float32": True}
        return next(number for number in formats if good[number])
    if precision not in formats:
        raise UserError(f"--precision {precision}: backend {backend} has {', '.join(formats)}")
    if precision == "int8" and not ranged:
        raise UserError(
            "--precision int8: the checkpoint does not say how large its layers' inputs become; "
            "`skope train export RUN --to compact --data DATASET` notes that"
        )
    return precision
