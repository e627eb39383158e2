"""Flat Gaussians that cover a reconstructed surface."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.geometry.rotations import quaternion
from stages.core.scene.gaussians import Gaussians

DISC_SIGMA, DISC_THICKNESS = 0.65, 0.12  # standard deviations in and across the disc [spacing]: no holes, small overlap


def disc_gaussians(
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    rgb: Float[Tensor, "m 3"],
    spacing: float,
    object_id: int,
    opacity: float = 0.97,
) -> Gaussians:
    """Opaque discs orthogonal to the normals, one per point, for points about `spacing` [scene units] apart."""
    count = len(points)
    normals = torch.nn.functional.normalize(normals, dim=1)
    helper = torch.eye(3)[normals.abs().argmin(1)] if count else torch.zeros(0, 3)
    u = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=1)
    R = torch.stack([u, torch.linalg.cross(normals, u), normals], -1)
    scales = spacing * torch.tensor([DISC_SIGMA, DISC_SIGMA, DISC_THICKNESS])
    return Gaussians(
        points.float(), quaternion(R) if count else torch.zeros(0, 4), scales.repeat(count, 1).float(),
        torch.full((count,), opacity), rgb_to_sh(rgb.clamp(0, 1)).float(),
        torch.full((count,), object_id, dtype=torch.int64),
    )  # fmt: skip


def empty_like(g: Gaussians) -> Gaussians:
    """An empty set of Gaussians with the fields and harmonics degree of `g`."""
    return g[torch.zeros(len(g), dtype=torch.bool)]
