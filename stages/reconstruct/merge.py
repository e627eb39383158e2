"""Many Gaussians -> fewer that look alike: those of a cell become the one with their moments."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.rotations import covariance
from stages.core.models.pi3.splat import decompose
from stages.core.scene.gaussians import Gaussians

PRIMES = (73_856_093, 19_349_663, 83_492_791)  # Teschner et al. 2003, "Optimized spatial hashing"


def merge_gaussians(gaussians: Gaussians, footprint: Float[Tensor, "n"], target: int) -> Gaussians:
    """About `target` Gaussians or fewer.

    A cell's side grows with the size of a pixel, `footprint`, at the Gaussian, in steps of two, so what is near the
    cameras keeps its detail; how many pixels it spans is found by bisection. The merged Gaussian has the mean and
    covariance of the mixture it stands for, weighted by opacity and area, and the means of opacity and harmonics.
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
    """One Gaussian for each cell number, which run from 0."""
    count = int(cell.max()) + 1
    share = weight / weight.new_zeros(count).index_add_(0, cell, weight)[cell]

    def mean(values: Tensor) -> Tensor:
        weighted = values * share.reshape(-1, *[1] * (values.ndim - 1))
        return values.new_zeros(count, *values.shape[1:]).index_add_(0, cell, weighted)

    means = mean(g.means)
    apart = g.means - means[cell]
    scales, quats = decompose(mean(covariance(g.quats, g.scales) + apart[:, :, None] * apart[:, None]))
    return Gaussians(means, quats, scales, mean(g.opacities), mean(g.sh), torch.zeros(count, dtype=torch.int64))


def _cells(points: Float[Tensor, "n 3"], footprint: Float[Tensor, "n"], pixels: float) -> Int[Tensor, "n"]:
    """A number for the cell of each point; cells of the smallest footprint span so many pixels."""
    least = footprint.min().clamp_min(1e-12)
    level = (footprint / least).log2().floor()
    place = (points / (pixels * least * 2**level)[:, None]).floor().long()
    return sum(place[:, k] * prime for k, prime in enumerate(PRIMES)) * 64 + level.long()
