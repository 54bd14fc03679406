"""Shared code of the benchmarks: alternating rounds, separate processes, the description of the machine, tables."""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

T = TypeVar("T")


def machine(device: str = "cpu") -> str:
    """Describe the machine, the GPU if there is one, and the version of torch."""
    import torch

    gpu = "" if device == "cpu" else f", {torch.cuda.get_device_name(device)}"
    cores = f"{os.cpu_count()}-core {platform.machine()}{gpu}"
    return f"{time.strftime('%Y-%m-%d')}, {cores}, {torch.get_num_threads()} threads, torch {torch.__version__}"


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Time a call; returns its seconds and its result."""
    begun = time.perf_counter()
    value = work()
    return time.perf_counter() - begun, value


def in_turn(ways: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """Run each way in `rounds` rounds and return its results.

    The ways alternate, so that other load affects all of them equally.
    """
    found: dict[str, list[T]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, work in ways.items():
            found[name].append(work())
    return found


def in_own_process(*words: str) -> Any:
    """Run this script again in another process with `words` appended; returns the JSON in its last line of output."""
    command = [sys.executable, *sys.argv, *words]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])


def print_head(names: Sequence[str]) -> None:
    """Print the head of a Markdown table."""
    print_row(names)
    print("|---" * len(names) + "|", flush=True)


def print_row(cells: Iterable[object]) -> None:
    """Print a row of a Markdown table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)
