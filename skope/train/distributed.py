"""Distributed training under `torchrun`: rank of this process, and sums over all processes."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")

WAITING_LIMIT = timedelta(hours=2)
"""Maximum time that processes wait for each other. All wait while the process of rank 0 validates and writes."""


@dataclass(frozen=True)
class ProcessGroup:
    """Processes that train one model together; a single process, unless torchrun has started several."""

    rank: int = 0
    """Number of this process, from 0."""
    size: int = 1
    """Number of processes."""

    @property
    def first(self) -> bool:
        """Whether this process writes files and prints messages."""
        return self.rank == 0

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """Return this process's part of a batch; it may be empty."""
        return items[self.rank :: self.size]

    def sum_over_all(self, tensors: Sequence[Tensor]) -> None:
        """Replace float32 tensors by their sums over all processes, in one message."""
        if self.size == 1:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(flat)
        for tensor, total in zip(tensors, torch.split(flat, [tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(total.view_as(tensor))

    def average_statistics(self, model: torch.nn.Module) -> None:
        """Replace the running statistics by their means over all processes, which have seen different images."""
        statistics = [buffer for buffer in model.buffers() if buffer.dtype == torch.float32]
        self.sum_over_all(statistics)
        for buffer in statistics if self.size > 1 else ():
            buffer.div_(self.size)


@contextlib.contextmanager
def process_group(device: torch.device) -> Iterator[tuple[ProcessGroup, torch.device]]:
    """Join the processes in torchrun's environment, if any; yield the group and the device of this process."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield ProcessGroup(), device
        return
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=WAITING_LIMIT)
    try:
        yield ProcessGroup(dist.get_rank(), size), device
    finally:
        dist.destroy_process_group()
