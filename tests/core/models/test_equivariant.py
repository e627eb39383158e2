"""Small pieces of algebra against PyTorch's own."""

import torch
from torch.testing import assert_close

from stages.core.models.field.equivariant import inner_products, symmetric_solve


def test_symmetric_systems_are_solved():
    rng = torch.Generator().manual_seed(0)
    root = torch.randn(2, 5, 3, 3, generator=rng, dtype=torch.float64)
    M, x, y = root @ root.mT + 0.1 * torch.eye(3), *torch.randn(2, 2, 5, 3, generator=rng, dtype=torch.float64)
    for found, given in zip(symmetric_solve(M, x, y), (x, y), strict=True):
        assert_close(found, torch.linalg.solve(M, given[..., None])[..., 0])


def test_products_are_those_of_each_pair_once_row_by_row():
    x = torch.randn(2, 5, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = [torch.asinh((x[..., i, :] * x[..., j, :]).sum(-1)) for i in range(4) for j in range(i, 4)]
    assert_close(inner_products(x), torch.stack(wanted, -1))
