"""Batched 3 x 3 algebra against PyTorch's own functions."""

import torch
from torch.testing import assert_close

from stages.core.models.field.equivariant import _asinh, inner_products, symmetric_solve


def test_symmetric_solve_equals_linalg_solve():
    rng = torch.Generator().manual_seed(0)
    root = torch.randn(2, 5, 3, 3, generator=rng, dtype=torch.float64)
    M, x, y = root @ root.mT + 0.1 * torch.eye(3), *torch.randn(2, 2, 5, 3, generator=rng, dtype=torch.float64)
    for solution, b in zip(symmetric_solve(M, x, y), (x, y), strict=True):
        assert_close(solution, torch.linalg.solve(M, b[..., None])[..., 0])


def test_inner_products_contain_each_pair_once_in_row_order():
    x = torch.randn(2, 5, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = [torch.asinh((x[..., i, :] * x[..., j, :]).sum(-1)) for i in range(4) for j in range(i, 4)]
    assert_close(inner_products(x), torch.stack(expected, -1))


@torch.no_grad()
def test_asinh_without_gradients_is_accurate_in_single_precision():
    x = torch.logspace(-6, 6, 1001)
    x = torch.cat([-x, torch.zeros(1), x])
    assert_close(_asinh(x).double(), x.double().asinh(), rtol=1e-6, atol=2e-7)
