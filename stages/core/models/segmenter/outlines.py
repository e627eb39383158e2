"""Outlines of objects finer than a voxel: a graph cut between each object and what surrounds it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.models.segmenter.voxels import VOXEL, ScenePoints, VoxelGrid

AROUND = 6  # voxels whose labels a surfel may take
NEIGHBOURS = 6  # surfels that the smoothness term connects
FLOOR = 0.02  # of a label's probability
SMOOTHNESS = 2.0  # cost of a cut between equal neighbours [nats]
COLOUR_SIGMA, TURN_SIGMA = 8.0, 0.5  # of the similarity of neighbours [CIELAB], [1 - cosine]
PRECISION = 1000  # capacities are whole numbers


def cut_outlines(
    surfels: ScenePoints, grid: VoxelGrid, labels: Int[Tensor, "v"], chance: Float[Tensor, "v 3"]
) -> Int[Tensor, "n"]:
    """Object of each surfel, 0 for none, from those of voxels and the probabilities of their classes.

    A surfel takes one of the labels of the nearest voxels; one expansion move for each object, with a cost of unequal
    neighbours that is lower across edges of colour and orientation. Source: Boykov, Veksler and Zabih 2001, "Fast
    approximate energy minimization via graph cuts".
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
    links = knn(surfels.points, surfels.points[border], NEIGHBOURS + 1)[1][:, 1:]
    alike = _similarity(surfels, border, links)
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
        to_now = torch.where(now == 0, nothing[at], (weight[at] * same * sure[at]).sum(1))
        to_now = torch.where(now == label, nothing[at], to_now)
        other = torch.where(now == label, 0, now)
        taken = _expansion(label, other, to_label, to_now, out, at, links[rows], alike[rows])
        out[at] = torch.where(taken, label, other)
    return out


def _similarity(surfels: ScenePoints, at: Int[Tensor, "m"], links: Int[Tensor, "m k"]) -> Float[Tensor, "m k"]:
    """1 for neighbours of equal colour and orientation, less for others."""
    colour = (surfels.lab[at][:, None] - surfels.lab[links]).norm(dim=2) / COLOUR_SIGMA
    turn = (1 - (surfels.normals[at][:, None] * surfels.normals[links]).sum(2).abs()) / TURN_SIGMA
    return torch.exp(-0.5 * (colour**2 + turn**2)) + 0.05


def _expansion(
    label: int, other: Tensor, to_label: Tensor, to_now: Tensor, ids: Tensor, at: Tensor, links: Tensor, alike: Tensor
) -> Tensor:
    """Which surfels take the label: the minimum cut of the graph of an expansion move."""
    m = len(at)
    number = torch.full((len(ids),), -1)
    number[at] = torch.arange(m)
    inner = number[links]
    cost_label = -(to_label + FLOOR).log()
    cost_other = -(to_now + FLOOR).log()
    cut = SMOOTHNESS * alike
    outside = inner < 0
    fixed = ids[links]
    cost_label = cost_label + (cut * (outside & (fixed != label))).sum(1)
    cost_other = cost_other + (cut * (outside & (fixed != other[:, None]))).sum(1)
    low = torch.minimum(cost_label, cost_other)
    source, sink = m, m + 1
    i = torch.arange(m)[:, None].expand_as(inner)[~outside]
    j, w = inner[~outside], cut[~outside] / 2  # each pair is listed from both ends, mostly
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
