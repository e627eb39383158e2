"""3D Gaussians as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import rotate_sh
from stages.core.geometry.rotations import multiply, quaternion
from stages.core.geometry.similarity import Similarity

SURFACE_OPACITY = 0.1  # opacity above which Gaussians belong to a visible surface


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians with activations applied, in the world frame (z up)."""

    means: Float[Tensor, "n 3"]  # [m]
    quats: Float[Tensor, "n 4"]  # unit, w x y z
    scales: Float[Tensor, "n 3"]  # standard deviations along the local axes [m]
    opacities: Float[Tensor, "n"]
    sh: Float[Tensor, "n k 3"]  # k = (degree + 1)**2; colour = sh . basis + 0.5
    object_id: Int[Tensor, "n"]  # 0 is the background

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index) -> Gaussians:
        """The Gaussians selected by a mask, slice or index tensor."""
        return Gaussians(*(getattr(self, f.name)[index] for f in fields(self)))

    def to(self, device: str | torch.device) -> Gaussians:
        """The Gaussians on a device."""
        return Gaussians(*(getattr(self, f.name).to(device) for f in fields(self)))


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate Gaussians in order; lower SH degrees are padded with zeros to the highest."""
    k = max(part.sh.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.sh, (0, 0, 0, k - part.sh.shape[1])) for part in parts]
    joined = {f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Gaussians) if f.name != "sh"}
    return Gaussians(sh=torch.cat(padded), **joined)


def transformed(g: Gaussians, similarity: Similarity) -> Gaussians:
    """Apply a similarity transform to Gaussians, including their spherical harmonics."""
    R = similarity.rotation
    return replace(
        g, means=similarity(g.means), quats=multiply(quaternion(R).expand(len(g), 4), g.quats),
        scales=similarity.scale * g.scales, sh=rotate_sh(g.sh, R.expand(len(g), 3, 3)),
    )  # fmt: skip
