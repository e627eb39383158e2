"""Several processes that train one model, as `torchrun` starts them: each takes a part of every batch.

All draw the same batch and keep their rows of it, so that the result does not depend on how many they are.
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
    """This process is number `rank` of `size`; number 0 validates and writes."""

    rank: int = 0
    size: int = 1
    device: str = "cpu"

    @property
    def leads(self) -> bool:
        return self.rank == 0

    def rows(self, batch: int) -> slice:
        """Its part of a batch."""
        each = batch // self.size
        return slice(self.rank * each, (self.rank + 1) * each)

    def mean(self, tensors: list[Tensor]) -> list[Tensor]:
        """Of what all have."""
        if self.size == 1:
            return tensors
        flat = torch.cat([x.flatten() for x in tensors])
        dist.all_reduce(flat)
        parts = (flat / self.size).split([x.numel() for x in tensors])
        return [part.view_as(x) for part, x in zip(parts, tensors, strict=True)]

    def agreed(self, value: float) -> float:
        """What number 0 says."""
        if self.size == 1:
            return value
        said = torch.tensor(value, dtype=torch.float64)  # not on the device, for which the host would have to wait
        dist.broadcast(said, 0)
        return said.item()


@contextmanager
def process_group(device: str, batch: int) -> Iterator[ProcessGroup]:
    """The processes that torchrun started; without it this one alone."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield ProcessGroup(device=device)
        return
    if batch % size:
        raise InputError(f"--batch {batch}: cannot be shared by {size} processes; take a multiple of {size}")
    if device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")
    try:
        yield ProcessGroup(dist.get_rank(), size, device)
    finally:
        dist.destroy_process_group()
