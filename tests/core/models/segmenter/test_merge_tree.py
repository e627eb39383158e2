"""Merge trees by average linkage, and the selection of nodes."""

import itertools

import numpy as np
import pytest

from stages.core.models.segmenter.merge_tree import MergeTree, merge_tree


def random_graph(rng: np.random.Generator, count: int, edges: int) -> tuple[np.ndarray, np.ndarray]:
    pairs = rng.integers(0, count, (edges, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return pairs, rng.normal(0.3, 1.0, len(pairs))


def leaves_of(tree: MergeTree) -> list[frozenset[int]]:
    sets = [frozenset([i]) for i in range(tree.count)]
    for a, b in tree.children.tolist():
        sets.append(sets[a] | sets[b])
    return sets


def brute_force(count: int, pairs: np.ndarray, weights: np.ndarray) -> set[frozenset[int]]:
    """All nodes of the tree, by recomputing all means after each merge."""
    groups = [frozenset([i]) for i in range(count)]
    nodes = set(groups)
    while True:
        means = {}
        for a, b in itertools.combinations(groups, 2):
            between = [w for (i, j), w in zip(pairs.tolist(), weights, strict=True)
                       if (i in a and j in b) or (i in b and j in a)]  # fmt: skip
            if between:
                means[a, b] = np.mean(between)
        if not means:
            return nodes
        a, b = max(means, key=means.get)
        groups = [g for g in groups if g not in (a, b)] + [a | b]
        nodes.add(a | b)


@pytest.mark.parametrize("seed", range(8))
def test_random_graphs_merge_as_by_brute_force(seed):
    pairs, weights = random_graph(np.random.default_rng(seed), 9, 22)
    assert set(leaves_of(merge_tree(9, pairs, weights))) == brute_force(9, pairs, weights)


def test_parts_without_an_edge_between_them_stay_apart():
    tree = merge_tree(5, np.array([[0, 1], [3, 4]]), np.array([1.0, -2.0]))
    assert sorted(len(s) for s, p in zip(leaves_of(tree), tree.parents(), strict=True) if p < 0) == [1, 2, 2]
    nothing = np.zeros((0, 2), np.int64), np.zeros(0)
    empty = merge_tree(3, *nothing)
    assert len(empty) == 3 and empty.sums(np.ones((3, 2))).shape == (3, 2)
    assert merge_tree(0, *nothing).maxima(np.ones((0, 2))).shape == (0, 2)


def test_sums_and_maxima_are_those_of_the_leaves():
    rng = np.random.default_rng(3)
    tree = merge_tree(20, *random_graph(rng, 20, 60))
    values, merges = rng.normal(size=(20, 2)), rng.normal(size=(len(tree.children), 2))
    for node, leaves in enumerate(leaves_of(tree)):
        inside = [i for i, s in enumerate(leaves_of(tree)[20:]) if s <= leaves]
        np.testing.assert_allclose(tree.sums_within(merges)[node], merges[inside].sum(0), atol=1e-12)
        np.testing.assert_allclose(tree.sums(values)[node], values[list(leaves)].sum(0))
        np.testing.assert_allclose(tree.maxima(values)[node], values[list(leaves)].max(0))


@pytest.mark.parametrize("seed", range(10))
def test_the_chosen_nodes_are_the_best_of_all_disjoint_ones(seed):
    rng = np.random.default_rng(seed)
    tree = merge_tree(7, *random_graph(rng, 7, 12))
    scores, sets = rng.normal(size=len(tree)), leaves_of(tree)
    chosen = tree.best(scores)
    assert all(a.isdisjoint(b) for a, b in itertools.combinations([sets[i] for i in chosen], 2))
    best = 0.0
    for k in range(1, 8):
        for some in itertools.combinations(np.nonzero(scores > 0)[0].tolist(), k):
            if all(sets[a].isdisjoint(sets[b]) for a, b in itertools.combinations(some, 2)):
                best = max(best, scores[list(some)].sum())
    assert scores[chosen].sum() == pytest.approx(best)
    labels = tree.labels(chosen)
    for place, node in enumerate(chosen):
        assert set(np.nonzero(labels == place)[0]) == sets[node]
