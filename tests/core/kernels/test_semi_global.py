"""Path costs of semi-global matching."""

import pytest
import torch

from stages.core.kernels.semi_global import path_costs, path_costs_reference


@pytest.mark.parametrize("shape", [(1, 3, 5), (40, 7, 33), (9, 2, 192), (5, 2, 300)], ids=str)
def test_path_costs_equal_the_reference(shape, device):
    costs = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    ours, reference = path_costs(costs.to(device), 0.03, 0.25).cpu(), path_costs_reference(costs, 0.03, 0.25)
    assert torch.equal(ours, reference)


def test_path_costs_do_not_depend_on_the_number_of_threads(with_threads):
    costs = torch.rand(5, 601, 150, generator=torch.Generator().manual_seed(0))
    reference = path_costs_reference(costs, 0.03, 0.25)
    assert all(torch.equal(with_threads(n, path_costs, costs, 0.03, 0.25), reference) for n in (1, 2, 3))


def test_path_cost_of_a_line_without_changes_is_the_sum_of_its_costs(device):
    """With penalties above any saving, the best path keeps its label; the two passes count each step twice."""
    costs = torch.zeros(6, 1, 4, device=device)
    costs[:, :, 1:] = 1.0
    total = path_costs(costs, 10.0, 10.0)
    assert (total[:, 0, 0] == 0).all() and (total[0, 0, 1:] == 1 + 6).all()
