"""Data-parallel training by several processes started by `torchrun`, each of which computes a part of every batch.

All processes draw the same batch and keep only their rows, so that the result does not depend on their number.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

from stages.core.errors import InputError


@dataclass(frozen=True)
class ProcessGroup:
    """This process is number `rank` of `size`; rank 0 validates and writes files."""

    rank: int = 0
    size: int = 1
    device: str = "cpu"

    @property
    def is_main(self) -> bool:
        """Whether this process validates and writes files."""
        return self.rank == 0

    def rows(self, batch: int) -> slice:
        """The rows of a batch that this process computes."""
        each = batch // self.size
        return slice(self.rank * each, (self.rank + 1) * each)

    def mean(self, tensors: list[Tensor]) -> list[Tensor]:
        """Mean of each tensor over all processes (all-reduce)."""
        if self.size == 1:
            return tensors
        flat = torch.cat([x.flatten() for x in tensors])
        dist.all_reduce(flat)
        parts = (flat / self.size).split([x.numel() for x in tensors])
        return [part.view_as(x) for part, x in zip(parts, tensors, strict=True)]

    def broadcast(self, value: float) -> float:
        """The value of rank 0, in all processes."""
        if self.size == 1:
            return value
        sent = torch.tensor(value, dtype=torch.float64)  # on the CPU, so that the host need not wait for the GPU
        dist.broadcast(sent, 0)
        return sent.item()


@contextmanager
def process_group(device: str, batch: int = 0) -> Iterator[ProcessGroup]:
    """The process group started by torchrun; without torchrun, this process alone.

    Raises InputError if the batch cannot be divided evenly among the processes.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield ProcessGroup(device=device)
        return
    if batch % size:
        raise InputError(f"--batch {batch}: cannot be divided among {size} processes; give a multiple of {size}")
    if device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")
    try:
        yield ProcessGroup(dist.get_rank(), size, device)
    finally:
        dist.destroy_process_group()
