"""What the benchmarks share: rounds in turn, processes of their own, the machine's name, tables."""

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
    """The machine, the device if it is a GPU, and the version of torch."""
    import torch

    gpu = "" if device == "cpu" else f", {torch.cuda.get_device_name(device)}"
    cores = f"{os.cpu_count()}-core {platform.machine()}{gpu}"
    return f"{time.strftime('%Y-%m-%d')}, {cores}, {torch.get_num_threads()} threads, torch {torch.__version__}"


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Seconds that a call takes, and what it returns."""
    begun = time.perf_counter()
    value = work()
    return time.perf_counter() - begun, value


def in_turn(ways: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """The results of each way in `rounds` rounds. The ways alternate, so that other load falls on all of them."""
    found: dict[str, list[T]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, work in ways.items():
            found[name].append(work())
    return found


def in_own_process(*words: str) -> Any:
    """The JSON that this script prints as its last line, with `words` after its own, in another process."""
    command = [sys.executable, *sys.argv, *words]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])


def print_head(names: Sequence[str]) -> None:
    """The head of a Markdown table."""
    print_row(names)
    print("|---" * len(names) + "|", flush=True)


def print_row(cells: Iterable[object]) -> None:
    """A row of a Markdown table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)
