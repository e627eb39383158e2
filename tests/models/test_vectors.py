"""Small pieces of algebra against PyTorch's own."""

import torch
from torch.testing import assert_close

from stages.models.vectors import symmetric_solve


def test_symmetric_systems_are_solved():
    rng = torch.Generator().manual_seed(0)
    root = torch.randn(2, 5, 3, 3, generator=rng, dtype=torch.float64)
    M, x, y = root @ root.mT + 0.1 * torch.eye(3), *torch.randn(2, 2, 5, 3, generator=rng, dtype=torch.float64)
    for found, given in zip(symmetric_solve(M, x, y), (x, y), strict=True):
        assert_close(found, torch.linalg.solve(M, given[..., None])[..., 0])
