"""Distinct cells, compared with `unique(dim=0)`."""

import pytest
import torch

from stages.core.geometry.cells import distinct_cells


@pytest.mark.parametrize("reach", [1, 5, 2**40])  # a row with the last reach does not fit into one integer
@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_as_unique_rows(reach, dimensions, device):
    cells = torch.randint(-reach, reach + 1, (400, dimensions), generator=torch.Generator().manual_seed(0)).to(device)
    cells = torch.cat([cells, cells[:50]])
    _, owner, count = cells.unique(dim=0, return_inverse=True, return_counts=True)
    found = distinct_cells(cells)
    assert torch.equal(found[0], owner) and torch.equal(found[1], count)


def test_no_cells(device):
    owner, count = distinct_cells(torch.zeros(0, 2, dtype=torch.int64, device=device))
    assert not len(owner) and not len(count)
