"""Particle arrays of all scenes in the layout of the kernels: in persistent memory, sorted by grid cell."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm import transfers as kernels

NEVER = 2**31 - 1  # value of `lost` for a scene without lost particles
_TYPES = {
    "x": wp.vec3, "rest": wp.vec3, "v": wp.vec3, "C": wp.mat33, "F": wp.mat33, "stiffness": wp.vec3, "plastic": wp.vec3,
    "acceleration": wp.vec3, "base_node": wp.vec3i, "branch_modulus": wp.vec2, "branch_rate": wp.vec2,
    "branch_strain": wp.mat33,
}  # fmt: skip


class ParticleRows:
    """Particle tensors by name (`tensors`), all in the same row order, and the kernels' struct over the same memory.

    `sizes` is the number of particles of each scene.
    """

    def __init__(self, fields: dict[str, Tensor], sizes: Sequence[int], grid, device: str):
        p = sum(sizes)
        self.device, self.grid, self.scenes = device, grid, len(sizes)
        self.tensors = {name: t.to(device, copy=True).contiguous() for name, t in fields.items()}
        scene = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(list(sizes)))
        self.tensors |= {
            "acceleration": torch.zeros(p, 3, device=device),
            "scene": scene.int().to(device),
            "order": torch.arange(p, dtype=torch.int32, device=device),
            "base_node": torch.full((p, 3), -1, dtype=torch.int32, device=device),
        }
        self.lost = torch.full((len(sizes),), NEVER, dtype=torch.int32, device=device)
        self._keys = torch.zeros(p, dtype=torch.int32, device=device)
        self.struct = kernels.ParticleArrays()
        self.struct.count = p
        for name, t in self.tensors.items():
            if t.numel():  # the columns of Maxwell branches are empty if there are none
                setattr(self.struct, name, view(t, _TYPES.get(name)))
        self.struct.lost = view(self.lost)

    def __len__(self) -> int:
        return self.struct.count

    def __getitem__(self, name: str) -> Tensor:
        return self.tensors[name]

    def sort(self) -> None:
        """Sort by grid cell, so that neighbours in space are neighbours in memory. Does not wait for a GPU."""
        launch(kernels.sort_keys, len(self), [self.grid, self.struct, view(self._keys)], device=self.device)
        if self.device == "cpu":  # PyTorch's threads cost more than they save here, and stall on a busy machine
            order = self._keys.numpy().argsort(kind="stable")
            for t in self.tensors.values():
                t.numpy()[:] = t.numpy()[order]
            return
        order = self._keys.argsort(stable=True)
        for t in self.tensors.values():
            t.copy_(t[order])

    def put(self, name: str, value: Tensor) -> None:
        """Overwrite a field with rows in the original order."""
        self.tensors[name].copy_(value.to(self.device)[self.tensors["order"].long()])

    def get(self, name: str) -> Tensor:
        """Copy of a field in the original order."""
        t = self.tensors[name]
        return torch.empty_like(t).index_copy_(0, self.tensors["order"].long(), t)
