"""Batched 3 x 3 algebra, compared with PyTorch's own functions."""

import torch
from torch.testing import assert_close

from stages.core.models.field.equivariant import _asinh, inner_products


def test_inner_products_contain_each_pair_once_in_row_order():
    x = torch.randn(2, 5, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = [torch.asinh((x[..., i, :] * x[..., j, :]).sum(-1)) for i in range(4) for j in range(i, 4)]
    assert_close(inner_products(x), torch.stack(expected, -1))


@torch.no_grad()
def test_asinh_without_gradients_is_accurate_in_single_precision():
    x = torch.logspace(-6, 6, 1001)
    x = torch.cat([-x, torch.zeros(1), x])
    assert_close(_asinh(x).double(), x.double().asinh(), rtol=1e-6, atol=2e-7)
