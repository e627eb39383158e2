"""Agglomeration with average linkage."""

import numpy as np

from stages.core.models.segmenter.clustering import agglomerate


def brute_force(count: int, pairs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The same by recomputing all means after each merge."""
    labels = np.arange(count)
    while True:
        best, chosen = 0.0, None
        a, b = labels[pairs].T
        for x, y in {(min(i, j), max(i, j)) for i, j in zip(a, b, strict=True) if i != j}:
            mean = weights[((a == x) & (b == y)) | ((a == y) & (b == x))].mean()
            if mean > best:
                best, chosen = mean, (x, y)
        if chosen is None:
            return labels
        labels[labels == chosen[1]] = chosen[0]


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two labellings group the nodes alike."""
    return len(np.unique(np.stack([a, b]), axis=1).T) == len(np.unique(a)) == len(np.unique(b))


def test_random_graphs_are_clustered_as_by_brute_force():
    rng = np.random.default_rng(0)
    for _ in range(20):
        pairs = rng.integers(0, 12, (40, 2))
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        weights = rng.normal(0.3, 1.0, len(pairs))
        assert same_partition(agglomerate(12, pairs, weights), brute_force(12, pairs, weights))


def test_a_few_false_edges_do_not_join_two_cliques():
    left = np.array([(i, j) for i in range(5) for j in range(i)])
    across = np.array([(i, j + 5) for i in range(5) for j in range(5)])
    pairs = np.concatenate([left, left + 5, across])
    weights = np.concatenate([np.ones(20), np.full(21, -0.5), np.full(4, 0.9)])
    labels = agglomerate(10, pairs, weights)
    assert same_partition(labels, np.repeat([0, 1], 5))


def test_nodes_without_edges_stay_alone():
    assert len(np.unique(agglomerate(4, np.array([[0, 1]]), np.array([1.0])))) == 3
    assert len(agglomerate(3, np.zeros((0, 2), np.int64), np.zeros(0))) == 3
