"""Agglomerative clustering by average linkage."""

import pytest
import torch

from stages.core.kernels.average_linkage import average_linkage, average_linkage_reference


@pytest.mark.parametrize("clusters, edges", [(2, 1), (40, 60), (300, 2500), (50, 1225)], ids=str)
def test_merges_equal_the_reference(clusters, edges):
    """Equal in order and bitwise, with many tied weights, isolated clusters and hubs."""
    rng = torch.Generator().manual_seed(edges)
    pairs = torch.combinations(torch.arange(clusters))
    ends = pairs[torch.randperm(len(pairs), generator=rng)[:edges]]
    numbers = torch.randint(1, 4, (edges,), generator=rng)
    equal = torch.randint(-3, 4, (edges,), generator=rng).double()
    for sums in (equal, torch.randn(edges, generator=rng, dtype=torch.float64)):
        ours = average_linkage(clusters, ends, sums, numbers)
        expected = average_linkage_reference(clusters, ends, sums, numbers)
        assert len(expected[0]) and all(torch.equal(a, b) for a, b in zip(ours, expected, strict=True))


def test_its_arguments_stay_as_they_are_and_may_be_empty():
    ends, sums, numbers = torch.tensor([[0, 1], [1, 2], [0, 2]]), torch.ones(3).double(), torch.ones(3).int()
    given = [x.clone() for x in (ends.int(), sums, numbers)]
    children, between, count = average_linkage(3, *given)
    assert children.tolist() == [[0, 1], [3, 2]] and between.tolist() == [1, 2] and count.tolist() == [1, 2]
    assert all(torch.equal(a, b) for a, b in zip(given, (ends.int(), sums, numbers), strict=True))
    for clusters in (0, 3):
        assert [len(x) for x in average_linkage(clusters, *(x[:0] for x in given))] == [0, 0, 0]
