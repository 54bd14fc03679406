"""Choose what computes the costly parts: torch, or a runtime that is faster on the CPU; and in which number format."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torchvision.models.detection import KeypointRCNN

from skope.detector import int8_ranges, network_settings
from skope.detector.backends import bfloat16, eight_bits, network_parts
from skope.detector.backends.region_suppression import suppress_best_first, suppress_together
from skope.detector.backends.runtimes import RUNTIMES, Runtime, UnusableError
from skope.detector.backends.same_size_images import keep_anchors, resize_first
from skope.detector.device import has_bfloat16
from skope.errors import UserError
from skope.terminal.console import Console

_IN_TORCH = ("bfloat16", "float32")


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
    """Let a backend compute a model's costly parts from now on.

    Args:
        model: On `device`, in evaluation mode; changed in place.
        metadata: Of its checkpoint.
        device: Where the rest is computed.
        backend: `auto`, `torch`, or a key of `RUNTIMES`. `auto` is OpenVINO on a CPU where it is installed.
        precision: Number format of the products: `float32`, `bfloat16`, `int8`, or `auto`, the fastest that backend,
            processor and checkpoint have.
        one_size: Whether images have one size, or few, for each of which a runtime may prepare.
        console: Says when `auto` finds a runtime that is broken.

    Returns:
        Backend and number format in words.

    Raises:
        UserError: The backend is missing or broken, or has no such number format.
    """
    keep_anchors(model)
    if device.type == "cpu":
        suppress_best_first(model)
    name = (network_settings.FASTEST if device.type == "cpu" else "torch") if backend == "auto" else backend
    if name != "torch":
        if device.type != "cpu":
            raise UserError(f"--backend {backend}: computes on the CPU only; give --device cpu, or --backend torch")
        try:
            return _by_runtime(RUNTIMES[name](), model, metadata, precision, one_size=one_size)
        except UnusableError as error:
            if backend != "auto":
                raise
            if not error.missing:
                console.say(f"{error}; torch computes instead")
    number = _number_format(precision, None, ranged=False, device=device)
    if number == "bfloat16":
        bfloat16.convert(model)
    if device.type == "cuda":
        suppress_together(model)
    return number


def _by_runtime(
    runtime: Runtime, model: KeypointRCNN, metadata: Mapping[str, Any], precision: str, *, one_size: bool
) -> str:
    """Hand a model's parts over; it is as before where the runtime fails."""
    ranges = int8_ranges.read(model, metadata)
    number = _number_format(precision, runtime, ranged=ranges is not None, device=torch.device("cpu"))
    try:
        if number == "int8" and ranges is not None:
            eight_bits.convert(model, ranges)
        parts = network_parts.parts_of(model)
        runs = {
            name: runtime.compile(replace(part, steady=part.steady and one_size), number)
            for name, part in parts.items()
        }
    except UnusableError:
        eight_bits.revert(model)
        raise
    network_parts.hand_over(model, runs)
    resize_first(model)
    return f"{number} by {runtime.module} {runtime.version}"


def _number_format(precision: str, runtime: Runtime | None, *, ranged: bool, device: torch.device) -> str:
    formats = _IN_TORCH if runtime is None else runtime.formats
    if precision == "auto":
        good = {"int8": ranged, "bfloat16": has_bfloat16(device), "float32": True}
        return next(number for number in formats if good[number])
    if precision not in formats:
        name = "torch" if runtime is None else runtime.backend
        raise UserError(f"--precision {precision}: backend {name} has {', '.join(formats)}")
    if precision == "int8" and not ranged:
        raise UserError(
            "--precision int8: the checkpoint does not say how large its layers' inputs become; "
            "`skope train export RUN --to compact --data DATASET` notes that"
        )
    return precision
