"""Device for torch, from a `--device` flag, and its support for bfloat16."""

import os
import re
from typing import Final

import torch

from skope.errors import UserError

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
