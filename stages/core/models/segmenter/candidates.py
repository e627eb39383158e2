"""Candidate objects: the nodes of a merge tree over the voxels that are not surface, and features of each node.

A network scores the candidates by these features. They are computed from sums over the voxels and links of a candidate,
so they are few and mean the same in simulated and real scenes. The idea is the score branch of PointGroup (Jiang et al.
2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, Num
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.models.segmenter.merge_tree import MergeTree, merge_tree
from stages.core.models.segmenter.network import PAIR_FEATURES, Level, Prediction, Segmenter
from stages.core.models.segmenter.voxels import VOXEL, VoxelGrid

TOGETHER = 2.0  # log odds above which voxels in the same cell of the next coarser grid are joined into one leaf
MAX_SURFACE = 0.5  # voxels with a smaller probability of the class surface may belong to an object
MIN_VOXELS = 6  # smallest number of voxels of a candidate
LINK_REACH, LINKS = 3.0, 8  # reach [voxels] and number of nearest voxels of links, which cross gaps of sparse Gaussians
NO_PARENT = -6.0  # feature of a root in place of the log odds of the merge into its parent
COLOUR, EMBEDDING = slice(21, 25), slice(25, 26 + PAIR_FEATURES)  # columns of the sums over voxels
# Constant added to a difference from a sibling before taking the logarithm, and the difference if there is no sibling.
ALIKE, UNLIKE = 0.05, 3.0
SMALL = 0.003  # constant added to distances before taking the logarithm [camera distance]


@dataclass(frozen=True)
class Candidates:
    """Nodes of a merge tree whose leaves are groups of up to eight voxels."""

    voxels: Int[Tensor, "m"]  # voxels of the grid that are in the tree
    leaf: Int[Tensor, "m"]  # leaf of the tree that each of these voxels is in
    tree: MergeTree
    features: Float[Tensor, "k f"]  # features of every node

    @property
    def sizes(self) -> Float[Tensor, "k"]:
        """Number of voxels of each node."""
        return self.features[:, 0].exp()

    @property
    def extents(self) -> Float[Tensor, "k"]:
        """Longest side of each node along the axes [camera distance]."""
        return self.features[:, 6].exp()

    def sums(self, values: Num[Tensor, "v d"]) -> np.ndarray:
        """Sum values given for the voxels of the grid over the voxels of each node: (nodes, d)."""
        leaves = torch.zeros(self.tree.count, values.shape[1]).double()
        return self.tree.sums(leaves.index_add_(0, self.leaf, values[self.voxels].double()).numpy())


@torch.no_grad()
def find_candidates(grid: VoxelGrid, levels: list[Level], found: Prediction, model: Segmenter) -> Candidates:
    """Build the merge tree of the voxels that may belong to objects, from the affinities of nearby voxels."""
    log_chance = found.logits.log_softmax(1)
    chance = log_chance.exp()
    voxels = torch.nonzero(chance[:, 0] < MAX_SURFACE)[:, 0]
    adjacent = adjacent_pairs(levels[0].neighbours, voxels)
    pairs = _unique_pairs(torch.cat([adjacent, nearby_pairs(grid.points, voxels)]), len(grid))
    odds = model.affinity(found, grid.points, pairs).double().cpu()
    number = torch.full((len(grid),), -1, device=voxels.device)
    number[voxels] = torch.arange(len(voxels), device=voxels.device)
    edges = number[pairs].cpu()
    leaf, count = _leaves(edges, odds, levels[0].parent[voxels].cpu())
    ends = leaf[edges]
    between = ends[:, 0] != ends[:, 1]
    tree = merge_tree(count, ends[between].numpy(), odds[between].numpy())

    both = torch.stack([odds, torch.ones_like(odds)], 1)[between]
    degree = torch.zeros(count, 2).double().index_add_(0, ends[between].T.flatten(), both.repeat(2, 1))
    occupied = (levels[0].neighbours[voxels] < len(grid)).sum(1) - 1
    surface = occupied - torch.bincount(adjacent.flatten(), None, len(grid))[voxels]
    offsets, points = found.offsets[voxels], grid.points[voxels]
    centres = points + offsets
    columns = [torch.ones_like(points[:, :1]), chance[voxels], points, points**2, centres, centres**2,
               offsets.norm(dim=1, keepdim=True), log_chance[voxels], surface[:, None],
               _with_square(grid.lab[voxels]), _with_square(found.embedding[voxels])]  # fmt: skip
    each = torch.cat(columns, 1).double().cpu()
    leaves = torch.zeros(count, each.shape[1]).double().index_add_(0, leaf, each)
    top = torch.full((count, 6), -torch.inf).double()
    corners = torch.cat([points, -points], 1).double().cpu()
    top.scatter_reduce_(0, leaf[:, None].expand_as(corners), corners, "amax")
    features = _features(tree, torch.cat([leaves, degree], 1).numpy(), top.numpy())
    return Candidates(voxels.cpu(), leaf, tree, torch.from_numpy(features).float())


def _unique_pairs(pairs: Int[Tensor, "e 2"], count: int) -> Int[Tensor, "u 2"]:
    """Remove duplicates from pairs of numbers below `count`; the smaller number of each pair comes first."""
    low, high = pairs.sort(1).values.unbind(1)
    key = (low * count + high).unique()
    return torch.stack([key // count, key % count], 1)


def _leaves(
    edges: Int[Tensor, "e 2"], odds: Float[Tensor, "e"], cell: Int[Tensor, "m"]
) -> tuple[Int[Tensor, "m"], int]:
    """Return the leaf of each voxel, and the number of leaves.

    A leaf consists of voxels in one cell of the coarser grid that are connected by log odds above TOGETHER.
    """
    i, j = edges[(odds > TOGETHER) & (cell[edges[:, 0]] == cell[edges[:, 1]])].T.numpy()
    graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(len(cell), len(cell)))
    count, leaf = connected_components(graph, directed=False)
    return torch.from_numpy(leaf).long(), int(count)


def adjacent_pairs(neighbours: Int[Tensor, "v 27"], voxels: Int[Tensor, "m"]) -> Int[Tensor, "e 2"]:
    """Return all pairs of adjacent voxels among `voxels`, each once."""
    count = len(neighbours)
    inside = torch.zeros(count + 1, dtype=torch.bool, device=voxels.device)
    inside[voxels] = True
    i, k = torch.nonzero(neighbours[:, :13] < count, as_tuple=True)
    pairs = torch.stack([i, neighbours[i, k]], 1)
    return pairs[inside[pairs].all(1)]


def nearby_pairs(points: Float[Tensor, "v 3"], voxels: Int[Tensor, "m"]) -> Int[Tensor, "e 2"]:
    """Return pairs of each of `voxels` with its LINKS nearest ones among them, if within LINK_REACH."""
    if not len(voxels):
        return torch.zeros(0, 2, dtype=torch.int64, device=voxels.device)
    distance, index = knn(points[voxels], points[voxels], min(LINKS + 1, len(voxels)))
    i, k = torch.nonzero(distance < LINK_REACH * VOXEL, as_tuple=True)
    pairs = torch.stack([voxels[i], voxels[index[i, k]]], 1)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _with_square(values: Float[Tensor, "m d"]) -> Float[Tensor, "m d+1"]:
    """Append the squared norm to the values; their spread follows from the means of both."""
    return torch.cat([values, (values**2).sum(1, keepdim=True)], 1)


def _contrasts(tree: MergeTree, mean: np.ndarray) -> list[np.ndarray]:
    """Spread of a quantity in each node, and log differences of its mean from the sibling and between the children.

    The last column of `mean` is the mean squared norm of the quantity. Parts of one object are often alike.
    """
    value, spread = mean[:, :-1], np.sqrt(np.maximum(mean[:, -1] - (mean[:, :-1] ** 2).sum(1), 0))
    a, b = tree.children.T
    between = np.concatenate([np.zeros(tree.count), np.linalg.norm(value[a] - value[b], axis=1)])
    parents = tree.parents()
    from_sibling = np.where(parents < 0, UNLIKE, between[parents])
    return [spread, np.log(from_sibling + ALIKE), np.log(between + ALIKE)]


def _features(tree: MergeTree, leaves: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Compute (nodes, network.CANDIDATE_FEATURES) features from sums of `leaves` and maxima of `corners`.

    For the columns of both see `find_candidates`.
    """
    sums, top = tree.sums(leaves), tree.maxima(corners)
    n, mean = sums[:, 0], sums / sums[:, :1]
    links = np.stack([tree.link_sum, tree.link_count], 1)
    inner = tree.sums_within(links)  # sum and number of the links within each node
    border = sums[:, -2:] - 2 * inner
    merged = np.concatenate([np.zeros(tree.count), links[:, 0] / np.maximum(links[:, 1], 1)])
    parents, sibling = tree.parents(), np.zeros(len(tree))
    sibling[tree.children[:, 0]], sibling[tree.children[:, 1]] = n[tree.children[:, 1]], n[tree.children[:, 0]]
    extent = top[:, :3] + top[:, 3:] + VOXEL
    sides = np.sort(extent, 1)
    radius = np.sqrt(np.maximum((mean[:, 7:10] - mean[:, 4:7] ** 2).sum(1), 1e-6))
    scatter = np.sqrt(np.maximum((mean[:, 13:16] - mean[:, 10:13] ** 2).sum(1), 0))  # spread of the predicted centres
    shift = np.linalg.norm(mean[:, 10:13] - mean[:, 4:7], axis=1)  # distance of their mean from the node's own centre
    columns = [
        np.log(n), mean[:, 1], mean[:, 2], mean[:, 3], *np.log(sides.T), np.log(extent[:, 2]),
        scatter / radius, shift / radius, mean[:, 16] / radius, np.log(scatter + SMALL), np.log(shift + SMALL),
        inner[:, 0] / np.maximum(inner[:, 1], 1), merged, np.where(parents < 0, NO_PARENT, merged[parents]),
        border[:, 0] / np.maximum(border[:, 1], 1), np.log1p(border[:, 1]) - np.log(n), np.log1p(border[:, 1]),
        np.log1p(sums[:, 20]) - np.log(n), np.log1p(sibling) - np.log(n), -top[:, 5], top[:, 2], *mean[:, 17:20].T,
        np.log(n * VOXEL**3 / extent.prod(1)),
        *_contrasts(tree, mean[:, COLOUR]), *_contrasts(tree, mean[:, EMBEDDING]),
    ]  # fmt: skip
    return np.stack(columns, 1)
