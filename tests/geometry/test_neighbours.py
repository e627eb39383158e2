import torch

from stages.geometry.neighbours import knn, spacing


def test_knn_equals_brute_force():
    rng = torch.Generator().manual_seed(0)
    points, queries = torch.rand(100, 3, generator=rng), torch.rand(20, 3, generator=rng)
    distance, index = knn(points, queries, 5)
    expected = torch.cdist(queries, points).topk(5, largest=False)
    torch.testing.assert_close(distance, expected.values)
    assert torch.equal(index, expected.indices)


def test_too_few_points_repeat_the_last():
    distance, index = knn(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.zeros(1, 3), 4)
    assert index.tolist() == [[0, 1, 1, 1]]
    assert distance.tolist() == [[0, 1, 1, 1]]


def test_spacing_of_a_line():
    line = torch.arange(5.0)[:, None] * torch.tensor([[0.1, 0, 0]])
    torch.testing.assert_close(spacing(line, 1), torch.full((5,), 0.1))
