"""Objects as nodes of a tree of merges: the tree, what is known of its nodes, and the best choice among them.

Voxels merge by average linkage until nothing is connected; every node of the tree is a candidate. Candidates have
scores, and the disjoint ones with the largest sum of scores are found by dynamic programming.

Sources: Bailoni et al. 2022, "GASP, a generalized framework for agglomerative clustering of signed graphs"; Liu et al.
2014, "A modular hierarchical approach to 3D electron microscopy image segmentation".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from stages.core.kernels.average_linkage import average_linkage


@dataclass(frozen=True)
class MergeTree:
    """Leaves 0 ... count - 1; merge k makes node count + k of two earlier nodes."""

    count: int
    children: np.ndarray  # (m, 2)
    link_sum: np.ndarray  # (m,) sum of the weights between the two
    link_count: np.ndarray  # (m,) number of edges between them

    def __len__(self) -> int:
        return self.count + len(self.children)

    def parents(self) -> np.ndarray:
        """(nodes,) the node that each is merged into; -1 for roots."""
        out = np.full(len(self), -1)
        out[self.children] = np.arange(self.count, len(self))[:, None]
        return out

    @cached_property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The leaves (count,) in an order in which those of each node are consecutive; first and last + 1 of each."""
        children, size = self.children.tolist(), [1] * self.count
        for a, b in children:
            size.append(size[a] + size[b])
        sizes, roots = np.array(size, dtype=np.int64), self.parents() < 0
        start = np.zeros(len(self), np.int64)
        start[roots] = np.cumsum(sizes[roots]) - sizes[roots]
        first = start.tolist()
        for node in range(len(self) - 1, self.count - 1, -1):
            a, b = children[node - self.count]
            first[a], first[b] = first[node], first[node] + size[a]
        start = np.array(first, dtype=np.int64)
        return start[: self.count].argsort(), start, start + sizes

    def sums(self, leaves: np.ndarray) -> np.ndarray:
        """(nodes, d) sums over the leaves of each node, of values (count, d), in float64."""
        order, first, last = self._ranges
        return _between(leaves[order], first, last)

    def sums_within(self, merges: np.ndarray) -> np.ndarray:
        """(nodes, d) sums over the merges inside each node, itself included, of values (m, d), in float64."""
        _, first, last = self._ranges
        at = np.zeros((self.count, merges.shape[1]))
        at[first[self.children[:, 1]]] = merges  # between the leaves of the two
        return _between(at, first + 1, last)

    def maxima(self, leaves: np.ndarray) -> np.ndarray:
        """(nodes, d) largest values of the leaves of each node, of (count, d)."""
        order, first, last = self._ranges
        out, window, width = np.empty((len(self), leaves.shape[1])), leaves[order], 1  # maxima of `width` from each on
        while len(window):
            fit = (last - first >= width) & (last - first < 2 * width)
            out[fit] = np.maximum(window[first[fit]], window[last[fit] - width])
            window, width = np.maximum(window[:-width], window[width:]), 2 * width
        return out

    def best(self, scores: np.ndarray) -> np.ndarray:
        """The disjoint nodes with the largest sum of positive `scores` (nodes,)."""
        scores, children = scores.tolist(), self.children.tolist()
        value = [max(score, 0.0) for score in scores[: self.count]]
        for score, (a, b) in zip(scores[self.count :], children, strict=True):
            value.append(max(score, value[a] + value[b]))
        chosen, stack = [], np.nonzero(self.parents() < 0)[0].tolist()
        while stack:
            node = stack.pop()
            if value[node] <= 0:
                continue
            if scores[node] >= value[node]:
                chosen.append(node)
            else:
                stack.extend(children[node - self.count])
        return np.array(sorted(chosen), dtype=np.int64)

    def labels(self, nodes: np.ndarray) -> np.ndarray:
        """(count,) the place in `nodes`, which are disjoint, of the one that holds each leaf; -1 for none."""
        order, first, last = self._ranges
        out = np.full(self.count, -1)
        for place, node in enumerate(nodes):
            out[order[first[node] : last[node]]] = place
        return out


def _between(values: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """(k, d) sums of values (n, d) from `first` up to before `last`."""
    total = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=total[1:])
    out = total[last]
    out -= total[first]
    return out


def merge_tree(count: int, pairs: np.ndarray, weights: np.ndarray) -> MergeTree:
    """The tree of `count` leaves joined by edges `pairs` (e, 2) with log odds `weights` (e,) of belonging together.

    The two nodes with the largest mean weight between them merge first; parts without an edge between them stay apart.
    """
    low, high = pairs.min(1), pairs.max(1)
    keys, at = np.unique(low * count + high, return_inverse=True)
    ends = np.stack(np.divmod(keys, max(count, 1)), 1)
    apart = ends[:, 0] != ends[:, 1]
    edges = (x[apart] for x in (ends, np.bincount(at, weights), np.bincount(at)))
    return MergeTree(count, *(x.numpy() for x in average_linkage(count, *map(torch.from_numpy, edges))))
