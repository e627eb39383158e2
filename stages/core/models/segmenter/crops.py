"""Dense crops around candidate objects, the input of the mask scorer."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.models.segmenter.candidates import Candidates
from stages.core.models.segmenter.mask_scorer import BATCH, CELLS, CHANNELS
from stages.core.models.segmenter.network import Prediction, Segmenter
from stages.core.models.segmenter.voxels import VOXEL, VoxelGrid

CONTEXT = 1.5  # side of a crop, in longest sides of the candidate
MOST = 300  # candidates of a scale that are looked at
ALIKE = 0.9  # least IoU of candidates of which one is looked at
EMBEDDING_UNIT = 4.0  # of differences of embeddings


@dataclass(frozen=True)
class _Table:
    """Tensors that move together."""

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None):
        """The same on a device, real numbers as `dtype`."""

        def moved(x: Tensor) -> Tensor:
            return x.to(device, dtype if x.is_floating_point() else None)

        return type(self)(*(moved(getattr(self, f.name)) for f in fields(self)))


@dataclass(frozen=True)
class Surroundings(_Table):
    """What crops show of each voxel."""

    points: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]
    offsets: Float[Tensor, "v 3"]  # to the predicted centre of the object
    given: Float[Tensor, "v 5"]  # probabilities of the classes, heights as the segmentation network takes them
    lab: Float[Tensor, "v 3"]
    embedding: Float[Tensor, "v e"]
    place: Int[Tensor, "v"]  # in the order of leaves of MergeTree.spans; -1: in no candidate

    def mirrored(self, x: int, y: int, swapped: bool) -> Surroundings:
        """Mirrored by signs of the two level axes, and with these exchanged."""
        return replace(
            self, **{n: _mirrored(getattr(self, n), x, y, swapped) for n in ("points", "normals", "offsets")}
        )


@dataclass(frozen=True)
class Boxes(_Table):
    """Where candidates are, their mean appearance, and what is known of them besides."""

    middle: Float[Tensor, "k 3"]
    side: Float[Tensor, "k"]  # longest, along the axes
    centre: Float[Tensor, "k 3"]  # mean of the predicted ones
    lab: Float[Tensor, "k 3"]
    embedding: Float[Tensor, "k e"]
    span: Int[Tensor, "k 2"]  # places of its leaves
    parent_span: Int[Tensor, "k 2"]
    known: Float[Tensor, "k f"]
    odds: Float[Tensor, "k"]  # present log odds of the IoU

    def __len__(self) -> int:
        return len(self.side)

    def __getitem__(self, rows) -> Boxes:
        return Boxes(*(getattr(self, f.name)[rows] for f in fields(self)))

    def mirrored(self, x: int, y: int, swapped: bool) -> Boxes:
        """As Surroundings.mirrored."""
        return replace(self, **{n: _mirrored(getattr(self, n), x, y, swapped) for n in ("middle", "centre")})


def _mirrored(values: Float[Tensor, "n 3"], x: int, y: int, swapped: bool) -> Float[Tensor, "n 3"]:
    signed = values * values.new_tensor([x, y, 1])
    return signed[:, [1, 0, 2]] if swapped else signed


def surroundings(grid: VoxelGrid, found: Prediction, candidates: Candidates) -> Surroundings:
    """What crops show of the voxels of a scene."""
    place = torch.full((len(grid),), -1)
    place[candidates.voxels] = torch.from_numpy(candidates.tree.spans()[:, 0])[candidates.leaf]
    given = torch.cat([found.logits.softmax(1), grid.features[:, -2:]], 1)
    return Surroundings(grid.points, grid.features[:, 3:6], found.offsets, given, grid.lab, found.embedding,
                        place.to(grid.points.device))  # fmt: skip


def boxes(candidates: Candidates, seen: Surroundings, nodes: Int[Tensor, "k"], model: Segmenter, scale: float) -> Boxes:
    """The candidates `nodes` of the scene enlarged by `scale`."""
    rows, voxels, tree = nodes.numpy(), candidates.voxels, candidates.tree
    corners = torch.full((tree.count, 6), -torch.inf).double()
    points = seen.points.cpu()[voxels]
    outer = torch.cat([points, -points], 1).double()
    corners.scatter_reduce_(0, candidates.leaf[:, None].expand_as(outer), outer, "amax")
    high, low = torch.from_numpy(tree.maxima(corners.numpy())[rows]).float().split(3, 1)
    values = torch.cat([seen.points + seen.offsets, seen.lab, seen.embedding], 1).cpu()
    sums = torch.from_numpy(candidates.sums(torch.cat([values, torch.ones(len(values), 1)], 1))[rows])
    centre, lab, embedding = (sums[:, :-1] / sums[:, -1:]).float().split([3, 3, values.shape[1] - 6], 1)
    spans, parents = torch.from_numpy(tree.spans()), torch.from_numpy(tree.parents())[nodes]
    features = candidates.features[nodes].to(model.feature_mean.device)
    odds = model.score(features)[:, None]
    known = torch.cat([model.normalised(features), odds, torch.full_like(odds, math.log(scale))], 1).cpu()
    parent_span = spans[torch.where(parents < 0, nodes, parents)]
    out = Boxes((high - low) / 2, (high + low).amax(1) + VOXEL, centre, lab, embedding, spans[nodes], parent_span,
                known, known[:, -2])  # fmt: skip
    return out.to(seen.points.device)


def crops(seen: Surroundings, of: Boxes) -> Float[Tensor, "k c d d d"]:
    """Dense crops, means over the voxels in each cell: occupied, candidate, rest of its parent;

    differences of colour and of the embedding from the candidate's mean, normals, predicted centres about their mean
    [half sides], probabilities of the classes, heights; zero where no voxel is. A cell is at least a voxel.
    """
    cell = (CONTEXT * of.side / CELLS).clamp_min(VOXEL)
    half = cell * CELLS / 2
    inside = ((seen.points - of.middle[:, None]).abs() < half[:, None, None]).all(2)
    which, voxel = torch.nonzero(inside, as_tuple=True)
    at = ((seen.points[voxel] - of.middle[which] + half[which, None]) / cell[which, None]).long().clamp(0, CELLS - 1)
    row = which * CELLS**3 + (at[:, 0] * CELLS + at[:, 1]) * CELLS + at[:, 2]
    place, span, parent = seen.place[voxel], of.span[which], of.parent_span[which]
    own = (place >= span[:, 0]) & (place < span[:, 1])
    sibling = (place >= parent[:, 0]) & (place < parent[:, 1]) & ~own
    to_centre = (seen.points[voxel] + seen.offsets[voxel] - of.centre[which]) / half[which, None]
    unlike = (seen.embedding[voxel] - of.embedding[which]).norm(dim=1, keepdim=True) / EMBEDDING_UNIT
    colour = seen.lab[voxel] - of.lab[which]
    columns = [torch.ones_like(unlike), own[:, None], sibling[:, None], seen.normals[voxel], to_centre.clamp(-2, 2),
               seen.given[voxel], colour, unlike]  # fmt: skip
    values = torch.cat([c.to(seen.points.dtype) for c in columns], 1).float()
    dense = values.new_zeros(len(of) * CELLS**3, CHANNELS).index_add_(0, row, values)
    count = dense[:, :1].clone()
    dense = dense / count.clamp_min(1)
    return dense.view(len(of), CELLS, CELLS, CELLS, CHANNELS).permute(0, 4, 1, 2, 3)


@torch.no_grad()
def corrected(seen: Surroundings, of: Boxes, model: Segmenter) -> Float[Tensor, "k"]:
    """Log odds of the IoU of candidates by the mask scorer."""
    parts = [of[k : k + BATCH] for k in range(0, len(of), BATCH)]
    odds = [model.mask_scorer(crops(seen, part), part.known, part.odds) for part in parts]
    return torch.cat([of.odds[:0], *odds]).cpu()


def plausible(candidates: Candidates, ious: Float[Tensor, "k"], usable: Bool[Tensor, "k"]) -> Int[Tensor, "m"]:
    """At most MOST of the usable candidates: those with the largest present scores among unlike ones.

    Merges of an object with a few voxels at a time give hundreds of nodes that are nearly the same. Of those of a path
    with more than ALIKE of the voxels of the uppermost one, the one with the largest score stands for all.
    """
    sizes, parents, able = candidates.sizes.numpy(), candidates.tree.parents(), usable.numpy()
    head = np.arange(len(sizes))  # uppermost of the alike ones
    above = np.full(len(sizes), -1)  # head of the nearest usable node that holds this one, itself included
    for node in range(len(sizes) - 1, -1, -1):
        near = above[parents[node]] if parents[node] >= 0 else -1
        if able[node] and near >= 0 and sizes[node] > ALIKE * sizes[near]:
            head[node] = near
        above[node] = head[node] if able[node] else near
    rows = np.nonzero(able)[0]
    rows = rows[np.argsort(-ious.numpy()[rows], kind="stable")]
    first = np.unique(head[rows], return_index=True)[1]
    return torch.from_numpy(rows[np.sort(first)][:MOST])
