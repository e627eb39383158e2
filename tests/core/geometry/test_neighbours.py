from math import inf

import pytest
import torch

from stages.core.geometry.neighbours import BruteForce, KDTree, knn, neighbour_index, spacing
from tests.conftest import DEVICES


@pytest.fixture(scope="module")
def cloud():
    """Random points in six dimensions, and a batch of queries around them."""
    rng = torch.Generator().manual_seed(0)
    return torch.rand(3000, 6, generator=rng) - 0.5, 1.2 * torch.rand(7, 50, 6, generator=rng) - 0.6


@pytest.mark.parametrize("k", [1, 32])
def test_brute_force_equals_the_tree(cloud, k, monkeypatch):
    monkeypatch.setattr(BruteForce, "MAX_ENTRIES", 100_000)  # forces several chunks
    points, queries = cloud
    (distance, found), (expected, index) = (search(points).query(queries, k) for search in (BruteForce, KDTree))
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-5)
    assert torch.equal(found, index)
    torch.testing.assert_close((queries[..., None, :] - points[found]).norm(dim=3), distance)


def test_brute_force_keeps_the_precision_of_the_queries(cloud):
    points, queries = cloud[0], cloud[1].double()
    (distance, _), (expected, _) = (search(points).query(queries) for search in (BruteForce, KDTree))
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("search", [KDTree, BruteForce])
def test_distance_beyond_the_limit_is_infinite(search):
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    distance, index = search(line).query(torch.tensor([[0.1, 0, 0], [9, 0, 0]]), 4, within=1.5)
    torch.testing.assert_close(distance, torch.tensor([[0.1, 0.9, inf, inf], [inf] * 4]))
    assert index[0, :2].tolist() == [0, 1] and bool((index < 3).all())


def test_tree_for_points_on_the_cpu(cloud):
    assert isinstance(neighbour_index(cloud[0]), KDTree)


@pytest.mark.gpu
@pytest.mark.skipif("cuda" not in DEVICES, reason="no NVIDIA GPU")
def test_brute_force_for_points_on_a_gpu(cloud):
    points, queries = (x.cuda() for x in cloud)
    found = neighbour_index(points)
    assert isinstance(found, BruteForce)
    distance, index = found.query(queries, 5)
    expected = KDTree(cloud[0]).query(cloud[1], 5)
    torch.testing.assert_close(distance.cpu(), expected[0], rtol=0, atol=1e-5)
    assert torch.equal(index.cpu(), expected[1])


def test_knn_equals_brute_force():
    rng = torch.Generator().manual_seed(0)
    points, queries = torch.rand(100, 3, generator=rng), torch.rand(20, 3, generator=rng)
    distance, index = knn(points, queries, 5)
    expected = torch.cdist(queries, points).topk(5, largest=False)
    torch.testing.assert_close(distance, expected.values)
    assert torch.equal(index, expected.indices)


def test_fewer_points_than_k_repeat_the_last():
    distance, index = knn(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.zeros(1, 3), 4)
    assert index.tolist() == [[0, 1, 1, 1]]
    assert distance.tolist() == [[0, 1, 1, 1]]


def test_spacing_of_a_line():
    line = torch.arange(5.0)[:, None] * torch.tensor([[0.1, 0, 0]])
    torch.testing.assert_close(spacing(line, 1), torch.full((5,), 0.1))


def test_spacing_is_the_root_mean_square_of_three_distances():
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 0, 0], [100, 0, 0]])
    torch.testing.assert_close(spacing(line)[0], torch.tensor(7.0).sqrt())  # the neighbours are at distances 1, 2 and 4


def test_a_tree_of_no_points_is_refused():
    with pytest.raises(ValueError, match="at least one point"):
        KDTree(torch.zeros(0, 3))


@pytest.mark.parametrize("search", [KDTree, BruteForce])
def test_a_single_point_is_the_nearest(search):
    distance, index = search(torch.tensor([[3.0, 4, 0]])).query(torch.zeros(2, 3), 2)
    torch.testing.assert_close(distance, torch.tensor([[5.0, inf]] * 2))
    assert index[:, 0].tolist() == [0, 0]
