"""Merge trees of voxels: sums and maxima over nodes, and the best set of disjoint nodes.

Voxels are merged by average linkage until no links remain; every node of the tree is a candidate object. The disjoint
candidates with the largest sum of scores are found by dynamic programming.

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
    """Tree with the leaves 0 ... count - 1, in which merge k joins two earlier nodes into node count + k."""

    count: int
    children: np.ndarray  # (m, 2) nodes joined by each merge
    link_sum: np.ndarray  # (m,) sum of the weights of the edges between the two nodes
    link_count: np.ndarray  # (m,) number of edges between the two nodes

    def __len__(self) -> int:
        return self.count + len(self.children)

    def parents(self) -> np.ndarray:
        """Return the parent of each node, (nodes,); -1 for roots."""
        out = np.full(len(self), -1)
        out[self.children] = np.arange(self.count, len(self))[:, None]
        return out

    @cached_property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The leaves (count,) in an order that makes each node's leaves contiguous, and the range of each node.

        Ranges are given by the position of the first leaf and one past the last leaf.
        """
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
        """Sum values (count, d) of the leaves over each node: (nodes, d), in float64."""
        order, first, last = self._ranges
        return _between(leaves[order], first, last)

    def sums_within(self, merges: np.ndarray) -> np.ndarray:
        """Sum values (m, d) of merges over the merges within each node, its own included: (nodes, d), in float64."""
        _, first, last = self._ranges
        at = np.zeros((self.count, merges.shape[1]))
        at[first[self.children[:, 1]]] = merges  # placed at the boundary between the leaves of both children
        return _between(at, first + 1, last)

    def maxima(self, leaves: np.ndarray) -> np.ndarray:
        """Maximum of values (count, d) of the leaves over each node: (nodes, d)."""
        order, first, last = self._ranges
        # sparse table: `window` holds the maxima of `width` consecutive leaves
        out, window, width = np.empty((len(self), leaves.shape[1])), leaves[order], 1
        while len(window):
            fit = (last - first >= width) & (last - first < 2 * width)
            out[fit] = np.maximum(window[first[fit]], window[last[fit] - width])
            window, width = np.maximum(window[:-width], window[width:]), 2 * width
        return out

    def best(self, scores: np.ndarray) -> np.ndarray:
        """Return the disjoint nodes with the largest sum of positive `scores` (nodes,)."""
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
        """Return for each leaf (count,) the position in `nodes`, which are disjoint, of the node that contains it.

        -1 for leaves that are in none of them.
        """
        order, first, last = self._ranges
        out = np.full(self.count, -1)
        for place, node in enumerate(nodes):
            out[order[first[node] : last[node]]] = place
        return out


def _between(values: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Sum values (n, d) over the ranges from `first` to `last` - 1: (k, d)."""
    total = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=total[1:])
    out = total[last]
    out -= total[first]
    return out


def merge_tree(count: int, pairs: np.ndarray, weights: np.ndarray) -> MergeTree:
    """Build the tree of `count` leaves with edges `pairs` (e, 2); `weights` (e,) are log odds of belonging together.

    The two nodes with the largest mean weight between them are merged first; parts without an edge stay separate.
    """
    low, high = pairs.min(1), pairs.max(1)
    keys, at = np.unique(low * count + high, return_inverse=True)
    ends = np.stack(np.divmod(keys, max(count, 1)), 1)
    apart = ends[:, 0] != ends[:, 1]
    edges = (x[apart] for x in (ends, np.bincount(at, weights), np.bincount(at)))
    return MergeTree(count, *(x.numpy() for x in average_linkage(count, *map(torch.from_numpy, edges))))
