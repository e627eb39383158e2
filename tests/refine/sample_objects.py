"""Test objects for registration: an asymmetric object in four colours, and random similarities."""

import torch

from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.lab.assets.shapes import box, ellipsoid
from tests.segment.tabletop import coloured_gaussians


def asymmetric_object(spacing: float = 0.012) -> Gaussians:
    """A red slab with a green tower and a blue egg at two corners and a yellow bar across it; its size is about 1."""
    return concatenate([
        coloured_gaussians(box((0.9, 0.6, 0.2), spacing), (0.8, 0.1, 0.1), 1),
        coloured_gaussians(box((0.2, 0.2, 0.5), spacing).moved((0.3, 0.15, 0.35)), (0.1, 0.6, 0.2), 1),
        coloured_gaussians(ellipsoid((0.18, 0.14, 0.2), 2500).moved((-0.25, -0.1, 0.22)), (0.1, 0.2, 0.8), 1),
        coloured_gaussians(box((0.12, 0.7, 0.1), spacing).moved((0.02, 0.0, 0.13)), (0.9, 0.8, 0.1), 1),
    ])  # fmt: skip


def random_similarity(seed: int) -> Similarity:
    rng = torch.Generator().manual_seed(seed)
    turn = matrix(torch.randn(4, generator=rng))
    return Similarity(float(2 ** (2 * torch.rand(1, generator=rng) - 1)), turn, torch.randn(3, generator=rng))


def degrees_between(A, B) -> float:
    return float(torch.rad2deg((((A * B).sum() - 1) / 2).clamp(-1, 1).arccos()))
