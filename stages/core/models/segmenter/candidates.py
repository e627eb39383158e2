"""Candidate objects: the nodes of the merge tree of voxels that are not surface, and what is known of each.

A network scores the candidates by these features, which are sums over their voxels and links, so that they are few and
mean the same in simulated and in real scenes. The idea is the score branch of PointGroup (Jiang et al. 2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.models.segmenter.merge_tree import MergeTree, merge_tree
from stages.core.models.segmenter.network import Level, Prediction, Segmenter
from stages.core.models.segmenter.voxels import VOXEL, VoxelGrid

MAX_SURFACE = 0.5  # probability of surface, up to which a voxel may be of an object
MIN_VOXELS = 6  # of a candidate
LINK_REACH, LINKS = 3.0, 8  # voxels and nearest voxels, within which links cross gaps of sparse Gaussians
NO_PARENT = -6.0  # log odds of the merge above a root
SMALL = 0.003  # of logarithms of distances [camera distance]


@dataclass(frozen=True)
class Candidates:
    """Nodes of a merge tree over some voxels."""

    voxels: Int[Tensor, "m"]  # of the grid, the leaves of the tree
    tree: MergeTree
    features: Float[Tensor, "k f"]  # of every node

    @property
    def sizes(self) -> Float[Tensor, "k"]:
        """Voxels of each node."""
        return self.features[:, 0].exp()

    @property
    def extents(self) -> Float[Tensor, "k"]:
        """Longest side of each node along the axes [camera distance]."""
        return self.features[:, 6].exp()


@torch.no_grad()
def find_candidates(grid: VoxelGrid, levels: list[Level], found: Prediction, model: Segmenter) -> Candidates:
    """The merge tree of the voxels that may be of an object, by the affinities of those close to each other."""
    log_chance = found.logits.log_softmax(1)
    chance = log_chance.exp()
    voxels = torch.nonzero(chance[:, 0] < MAX_SURFACE)[:, 0]
    adjacent = adjacent_pairs(levels[0].neighbours, voxels)
    pairs = torch.cat([adjacent, nearby_pairs(grid.points, voxels)]).sort(1).values.unique(dim=0)
    odds = model.affinity(found, grid.points, pairs).double().numpy()
    number = torch.full((len(grid),), -1)
    number[voxels] = torch.arange(len(voxels))
    edges = number[pairs].numpy()
    tree = merge_tree(len(voxels), edges, odds)
    degree = np.stack([sum(np.bincount(end, w, len(voxels)) for end in edges.T) for w in (odds, np.ones(len(odds)))], 1)
    occupied = (levels[0].neighbours[voxels] < len(grid)).sum(1) - 1
    surface = occupied - torch.bincount(adjacent.flatten(), None, len(grid))[voxels]
    offsets, points = found.offsets[voxels], grid.points[voxels]
    centres = points + offsets
    columns = [torch.ones(len(voxels), 1), chance[voxels], points, points**2, centres, centres**2,
               offsets.norm(dim=1, keepdim=True), log_chance[voxels]]  # fmt: skip
    leaves = np.concatenate([torch.cat(columns, 1).double().numpy(), degree, surface[:, None].numpy()], 1)
    corners = torch.cat([points, -points], 1).double().numpy()
    return Candidates(voxels, tree, torch.from_numpy(_features(tree, leaves, corners)).float())


def adjacent_pairs(neighbours: Int[Tensor, "v 27"], voxels: Int[Tensor, "m"]) -> Int[Tensor, "e 2"]:
    """All pairs of adjacent voxels among `voxels`, each once."""
    count = len(neighbours)
    inside = torch.zeros(count + 1, dtype=torch.bool)
    inside[voxels] = True
    i, k = torch.nonzero(neighbours[:, :13] < count, as_tuple=True)
    pairs = torch.stack([i, neighbours[i, k]], 1)
    return pairs[inside[pairs].all(1)]


def nearby_pairs(points: Float[Tensor, "v 3"], voxels: Int[Tensor, "m"]) -> Int[Tensor, "e 2"]:
    """Pairs of voxels among `voxels` with their LINKS nearest within LINK_REACH."""
    if not len(voxels):
        return torch.zeros(0, 2, dtype=torch.int64)
    distance, index = knn(points[voxels], points[voxels], min(LINKS + 1, len(voxels)))
    i, k = torch.nonzero(distance < LINK_REACH * VOXEL, as_tuple=True)
    pairs = torch.stack([voxels[i], voxels[index[i, k]]], 1)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _features(tree: MergeTree, leaves: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(nodes, network.CANDIDATE_FEATURES) features from sums of `leaves` and maxima of `corners`, see above."""
    sums, top = tree.sums(leaves), tree.maxima(corners)
    n, mean = sums[:, 0], sums / sums[:, :1]
    links = np.stack([tree.link_sum, tree.link_count], 1)
    inner = np.concatenate([np.zeros((tree.count, 2)), links])  # sum and number of the links inside each node
    for node, (a, b) in enumerate(tree.children.tolist(), tree.count):
        inner[node] += inner[a] + inner[b]
    border = sums[:, 20:22] - 2 * inner
    merged = np.concatenate([np.zeros(tree.count), links[:, 0] / np.maximum(links[:, 1], 1)])
    parents, sibling = tree.parents(), np.zeros(len(tree))
    sibling[tree.children[:, 0]], sibling[tree.children[:, 1]] = n[tree.children[:, 1]], n[tree.children[:, 0]]
    extent = top[:, :3] + top[:, 3:] + VOXEL
    sides = np.sort(extent, 1)
    radius = np.sqrt(np.maximum((mean[:, 7:10] - mean[:, 4:7] ** 2).sum(1), 1e-6))
    scatter = np.sqrt(np.maximum((mean[:, 13:16] - mean[:, 10:13] ** 2).sum(1), 0))  # of the predicted centres
    shift = np.linalg.norm(mean[:, 10:13] - mean[:, 4:7], axis=1)  # of their mean from the node's own centre
    columns = [
        np.log(n), mean[:, 1], mean[:, 2], mean[:, 3], *np.log(sides.T), np.log(extent[:, 2]),
        scatter / radius, shift / radius, mean[:, 16] / radius, np.log(scatter + SMALL), np.log(shift + SMALL),
        inner[:, 0] / np.maximum(inner[:, 1], 1), merged, np.where(parents < 0, NO_PARENT, merged[parents]),
        border[:, 0] / np.maximum(border[:, 1], 1), np.log1p(border[:, 1]) - np.log(n), np.log1p(border[:, 1]),
        np.log1p(sums[:, 22]) - np.log(n), np.log1p(sibling) - np.log(n), -top[:, 5], top[:, 2], *mean[:, 17:20].T,
        np.log(n * VOXEL**3 / extent.prod(1)),
    ]  # fmt: skip
    return np.stack(columns, 1)
