"""Agglomerative clustering of a signed graph with average linkage."""

from __future__ import annotations

import heapq

import numpy as np


def agglomerate(count: int, pairs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Cluster number of each of `count` nodes, from 0.

    `pairs` (e, 2) are edges and `weights` (e,) their log odds of joining the same cluster. The two clusters with the
    largest mean weight between them merge, until no mean is positive, so the number of clusters is not given.

    Source: Bailoni et al. 2022, "GASP, a generalized framework for agglomerative clustering of signed graphs",
    with average linkage.
    """
    links: list[dict[int, tuple[float, int]] | None] = [{} for _ in range(count)]
    low, high = pairs.min(1), pairs.max(1)
    keys, at = np.unique(low * count + high, return_inverse=True)
    total, number = np.bincount(at, weights), np.bincount(at)
    for key, w, n in zip(keys.tolist(), total.tolist(), number.tolist(), strict=True):
        a, b = divmod(key, count)
        if a != b:
            links[a][b] = links[b][a] = (w, n)
    queue = [(-w / n, a, b) for a, row in enumerate(links) for b, (w, n) in row.items() if a < b and w > 0]
    heapq.heapify(queue)
    parent = list(range(count))
    while queue:
        value, a, b = heapq.heappop(queue)
        if links[a] is None or links[b] is None:
            continue
        found = links[a].get(b)
        if found is None or -found[0] / found[1] != value:  # changed since it was queued
            continue
        if len(links[a]) < len(links[b]):
            a, b = b, a
        parent[b] = a
        mine, theirs = links[a], links[b]
        links[b] = None
        del mine[b], theirs[a]
        for other, (w, n) in theirs.items():
            old = mine.get(other)
            new = (w, n) if old is None else (w + old[0], n + old[1])
            mine[other] = links[other][a] = new
            del links[other][b]
            if new[0] > 0:
                heapq.heappush(queue, (-new[0] / new[1], min(a, other), max(a, other)))
    return np.unique([_root(parent, i) for i in range(count)], return_inverse=True)[1]


def _root(parent: list[int], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
