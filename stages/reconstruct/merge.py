"""Reduction of Gaussians: all Gaussians in a voxel are merged into one with the same moments."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.rotations import covariance
from stages.core.models.pi3.splat import decompose
from stages.core.scene.gaussians import Gaussians

PRIMES = (73_856_093, 19_349_663, 83_492_791)  # Teschner et al. 2003, "Optimized spatial hashing"


def merge_gaussians(gaussians: Gaussians, footprint: Float[Tensor, "n"], target: int) -> Gaussians:
    """Reduce Gaussians to about `target` or fewer.

    The voxel size is proportional to the width of a pixel at the Gaussian, `footprint` [scene units], rounded to a
    power of two, so that detail near the cameras is kept; the factor of proportionality is found by bisection. A merged
    Gaussian has the mean and covariance of the mixture, weighted by opacity and area, and the weighted means of opacity
    and harmonics.
    Source: Kerbl et al. 2024, "A hierarchical 3D Gaussian representation", sec. 4.1.
    """
    if len(gaussians) <= target:
        return gaussians
    low, high = 0.5, 128.0
    for _ in range(9):
        middle = (low * high) ** 0.5
        count = len(_cells(gaussians.means, footprint, middle).unique())
        low, high = (middle, high) if count > target else (low, middle)
    _, cell = _cells(gaussians.means, footprint, high).unique(return_inverse=True)
    largest = gaussians.scales.sort(1, descending=True).values
    return _joined(gaussians, cell, gaussians.opacities * largest[:, 0] * largest[:, 1] + 1e-20)


def _joined(g: Gaussians, cell: Int[Tensor, "n"], weight: Float[Tensor, "n"]) -> Gaussians:
    """Merge the Gaussians of each cell 0, 1, ... into one."""
    count = int(cell.max()) + 1
    fraction = weight / weight.new_zeros(count).index_add_(0, cell, weight)[cell]

    def mean(values: Tensor) -> Tensor:
        weighted = values * fraction.reshape(-1, *[1] * (values.ndim - 1))
        return values.new_zeros(count, *values.shape[1:]).index_add_(0, cell, weighted)

    means = mean(g.means)
    offset = g.means - means[cell]
    scales, quats = decompose(mean(covariance(g.quats, g.scales) + offset[:, :, None] * offset[:, None]))
    return Gaussians(means, quats, scales, mean(g.opacities), mean(g.sh), torch.zeros(count, dtype=torch.int64))


def _cells(points: Float[Tensor, "n 3"], footprint: Float[Tensor, "n"], pixels: float) -> Int[Tensor, "n"]:
    """Hash of the voxel of each point; the side of a voxel is `pixels` footprints, rounded down by up to half."""
    smallest = footprint.min().clamp_min(1e-12)
    level = (footprint / smallest).log2().floor()
    index = (points / (pixels * smallest * 2**level)[:, None]).floor().long()
    return sum(index[:, k] * prime for k, prime in enumerate(PRIMES)) * 64 + level.long()
