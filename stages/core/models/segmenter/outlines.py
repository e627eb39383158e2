"""Outlines of objects at sub-voxel resolution, by a graph cut between each object and its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.models.segmenter.voxels import VOXEL, ScenePoints, VoxelGrid

AROUND = 6  # number of nearest voxels whose labels a surfel may take
NEIGHBOURS = 6  # number of nearest surfels that the smoothness term connects a surfel to
FLOOR = 0.02  # constant added to the probability of a label, so that its cost stays finite
SMOOTHNESS = 2.0  # cost of a cut between neighbours of equal appearance [nats]
COLOUR_SIGMA, TURN_SIGMA = 8.0, 0.5  # standard deviations for the similarity of neighbours [CIELAB], [1 - cosine]
PRECISION = 1000  # integer capacities per nat


@dataclass(frozen=True)
class _Neighbourhood:
    """Surfels whose label may change, and their neighbours."""

    rows: Int[Tensor, "m"]
    neighbours: Int[Tensor, "m k"]
    similarity: Float[Tensor, "m k"]

    def select(self, which: Int[Tensor, "s"]) -> _Neighbourhood:
        return _Neighbourhood(self.rows[which], self.neighbours[which], self.similarity[which])


def cut_outlines(
    surfels: ScenePoints, grid: VoxelGrid, labels: Int[Tensor, "v"], chance: Float[Tensor, "v 3"]
) -> Int[Tensor, "n"]:
    """Return the object of each surfel, 0 for none, from the labels and class probabilities of voxels.

    A surfel takes one of the labels of its nearest voxels. There is one expansion move per object, with a smoothness
    cost that is lower across edges of colour and orientation. Source: Boykov, Veksler and Zabih 2001, "Fast approximate
    energy minimization via graph cuts".
    """
    distance, index = knn(grid.points, surfels.points, min(AROUND, len(grid)))
    weight = torch.exp(-0.5 * (distance / (0.6 * VOXEL)) ** 2) + 1e-6
    weight = weight / weight.sum(1, keepdim=True)
    around, sure = labels[index], torch.where(labels > 0, chance[:, 1], 1 - chance[:, 1])[index]
    nothing = (weight * torch.where(around > 0, 1 - sure, sure)).sum(1)
    out = labels[grid.owner].clone()
    border = torch.nonzero((around != around[:, :1]).any(1))[:, 0]
    if not len(border):
        return out
    neighbours = knn(surfels.points, surfels.points[border], NEIGHBOURS + 1)[1][:, 1:]
    neighbourhood = _Neighbourhood(border, neighbours, _similarity(surfels, border, neighbours))
    for label in around[border].unique().tolist():
        if label == 0:
            continue
        rows = torch.nonzero((around[border] == label).any(1))[:, 0]
        if not len(rows):
            continue
        at = border[rows]
        to_label = (weight[at] * (around[at] == label) * sure[at]).sum(1)
        now = out[at]
        same = around[at] == now[:, None]
        to_other = torch.where(now == 0, nothing[at], (weight[at] * same * sure[at]).sum(1))
        to_other = torch.where(now == label, nothing[at], to_other)
        other = torch.where(now == label, 0, now)
        taken = _expansion(label, other, to_label, to_other, out, neighbourhood.select(rows))
        out[at] = torch.where(taken, label, other)
    return out


def _similarity(surfels: ScenePoints, at: Int[Tensor, "m"], neighbours: Int[Tensor, "m k"]) -> Float[Tensor, "m k"]:
    """Similarity of surfels and their neighbours: about 1 for equal colour and orientation, less for others."""
    colour = (surfels.lab[at][:, None] - surfels.lab[neighbours]).norm(dim=2) / COLOUR_SIGMA
    turn = (1 - (surfels.normals[at][:, None] * surfels.normals[neighbours]).sum(2).abs()) / TURN_SIGMA
    return torch.exp(-0.5 * (colour**2 + turn**2)) + 0.05


def _expansion(
    label: int, other: Int[Tensor, "m"], to_label: Float[Tensor, "m"], to_other: Float[Tensor, "m"],
    labels: Int[Tensor, "n"], neighbourhood: _Neighbourhood,
) -> Bool[Tensor, "m"]:  # fmt: skip
    """Return which surfels of the neighbourhood take `label` rather than `other`, by the minimum cut of one move.

    `to_label` and `to_other` are the probabilities of the two labels; `labels` are the current labels of all surfels.
    """
    m = len(neighbourhood.rows)
    number = torch.full((len(labels),), -1)
    number[neighbourhood.rows] = torch.arange(m)
    inner = number[neighbourhood.neighbours]
    cost_label = -(to_label + FLOOR).log()
    cost_other = -(to_other + FLOOR).log()
    cut = SMOOTHNESS * neighbourhood.similarity
    outside = inner < 0
    fixed = labels[neighbourhood.neighbours]
    cost_label = cost_label + (cut * (outside & (fixed != label))).sum(1)
    cost_other = cost_other + (cut * (outside & (fixed != other[:, None]))).sum(1)
    low = torch.minimum(cost_label, cost_other)
    source, sink = m, m + 1
    i = torch.arange(m)[:, None].expand_as(inner)[~outside]
    j, w = inner[~outside], cut[~outside] / 2  # halved, because most pairs are listed from both ends
    heads = torch.cat([torch.full((m,), source), torch.arange(m), i, j]).numpy()
    tails = torch.cat([torch.arange(m), torch.full((m,), sink), j, i]).numpy()
    capacity = torch.cat([cost_other - low, cost_label - low, w, w])
    graph = coo_matrix(((PRECISION * capacity).round().int().numpy(), (heads, tails)), shape=(m + 2, m + 2)).tocsr()
    graph.sum_duplicates()
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = np.zeros(m + 2, bool)
    reached[breadth_first_order(residual, source, return_predecessors=False)] = True
    return torch.from_numpy(reached[:m])
