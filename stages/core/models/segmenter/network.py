"""A sparse 3D U-Net over voxels, which predicts classes, offsets to object centres, and embeddings for pair affinities.

A perceptron scores candidate objects. The classes are surface (tables, walls, floors, furniture), object, and clutter
(floaters, objects too small to recognise). Offsets are as in PointGroup (Jiang et al. 2020); convolutions are
restricted to occupied voxels, as in Graham et al. 2018.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from stages.core.models.segmenter.voxels import FEATURES, VOXEL, coarser, neighbour_table

CLASSES = ("surface", "object", "clutter")
OFFSET_UNIT = 0.1  # unit of predicted offsets [camera distance]
PAIR_FEATURES = 24  # length of the embedding
CANDIDATE_FEATURES = 33  # number of features of a candidate object, see candidates.py
BLOCK_VOXELS = 4096  # voxels that a convolution processes at a time on a CPU, which bounds its memory
SCORES = ("feature_", "candidate_head.")  # prefixes of the names of the weights that score candidates


@dataclass(frozen=True)
class Level:
    """Voxels of one resolution."""

    neighbours: Int[Tensor, "v 27"]  # see voxels.neighbour_table
    parent: Int[Tensor, "v"]  # voxel of the next coarser level that contains each voxel
    children: Int[Tensor, "w 8"]  # voxels within each voxel of the next coarser level; v where there is none

    @cached_property
    def blocks(self) -> list[NeighbourBlock]:
        """The existing neighbours, in blocks of BLOCK_VOXELS voxels."""
        return [NeighbourBlock.of(rows, len(self.neighbours)) for rows in self.neighbours.split(BLOCK_VOXELS)]


@dataclass(frozen=True)
class NeighbourBlock:
    """The m existing neighbours of b consecutive voxels; on surfaces these are about a third of 27 per voxel."""

    sources: tuple[Int[Tensor, "_"], ...]  # existing neighbours at each of the 27 offsets
    order: Int[Tensor, "m"]  # positions in the concatenated `sources`, grouped by voxel
    starts: Int[Tensor, "b"]  # start of each voxel's group in `order`

    @classmethod
    def of(cls, neighbours: Int[Tensor, "b 27"], count: int) -> NeighbourBlock:
        """Build from a table of neighbours, in which only indices below `count` exist."""
        exists = neighbours < count
        place = exists.mT.flatten().cumsum(0).view(27, -1).mT - 1
        sources, number = neighbours.mT[exists.mT].split(exists.sum(0).tolist()), exists.sum(1)
        return cls(sources, place[exists], number.cumsum(0) - number)

    def products(self, x: Float[Tensor, "v c"], weight: Float[Tensor, "27 c d"]) -> Float[Tensor, "b d"]:
        """Sum over the neighbours of each voxel of their features times the weights of their offsets."""
        each = x.new_empty(len(self.order), weight.shape[2])
        for rows, matrix, out in zip(self.sources, weight, each.split([len(s) for s in self.sources]), strict=True):
            torch.mm(x.index_select(0, rows), matrix, out=out)
        return nn.functional.embedding_bag(self.order, each, self.starts, mode="sum")


def pyramid(cells: Int[Tensor, "v 3"], levels: int) -> list[Level]:
    """Build the voxels at `levels` resolutions, finest first."""
    out = []
    for _ in range(levels):
        coarse, parent, children = coarser(cells)
        out.append(Level(neighbour_table(cells), parent, children))
        cells = coarse
    return out


class _SparseConvolution(torch.autograd.Function):
    """x[neighbours] @ weight for a symmetric table of neighbours; the gradient uses a gather instead of a scatter.

    On a GPU one product with zeros for missing neighbours is faster; on a CPU only existing neighbours are multiplied.
    Within `torch.autocast` products are in its precision; the result is in the precision of x.
    """

    @staticmethod
    def forward(ctx, x: Tensor, level: Level, weight: Tensor) -> Tensor:
        device, neighbours = x.device.type, level.neighbours
        ctx.dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else x.dtype
        ctx.save_for_backward(x, neighbours, weight)
        narrow, weight = x.to(ctx.dtype), weight.to(ctx.dtype)
        with torch.autocast(device, enabled=False):
            if device == "cpu":
                return torch.cat([block.products(narrow, weight) for block in level.blocks]).to(x.dtype)
            return (_gather(narrow, neighbours) @ weight.flatten(0, 1)).to(x.dtype)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, Tensor]:
        x, neighbours, weight = ctx.saved_tensors
        mirrored = weight.flip(0).transpose(1, 2)  # the neighbour at offset k has this voxel at offset -k
        narrow = grad.to(ctx.dtype)
        with torch.autocast(x.device.type, enabled=False):
            to_x = _gather(narrow, neighbours) @ mirrored.flatten(0, 1).to(ctx.dtype)
            to_weight = (_gather(x.to(ctx.dtype), neighbours).mT @ narrow).reshape(weight.shape)
        return to_x.to(x.dtype), None, to_weight.to(weight.dtype)


def _gather(x: Float[Tensor, "v c"], table: Int[Tensor, "w k"]) -> Float[Tensor, "w k*c"]:
    """Concatenate the features of k voxels per row, with zeros for missing voxels."""
    padded = torch.nn.functional.pad(x, (0, 0, 0, 1))
    return padded.index_select(0, table.flatten()).reshape(len(table), -1)


def _pooled(x: Float[Tensor, "v c"], children: Int[Tensor, "w 8"]) -> Float[Tensor, "w c"]:
    """Mean of the voxels within each coarser voxel."""
    count = (children < len(x)).sum(1, keepdim=True)
    return _gather(x, children).view(len(children), 8, -1).sum(1) / count


class Convolution(nn.Module):
    """A 3 x 3 x 3 convolution over occupied voxels."""

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__()
        scale = (2 / (10 * in_channels)) ** 0.5  # about 10 of the 27 voxels are occupied
        self.weight = nn.Parameter(scale * torch.randn(27, in_channels, out_channels))

    def forward(self, x: Float[Tensor, "v c"], level: Level) -> Float[Tensor, "v d"]:
        return _SparseConvolution.apply(x, level, self.weight)


class ResidualBlock(nn.Module):
    """Two convolutions with a residual connection."""

    def __init__(self, width: int):
        super().__init__()
        self.norms = nn.ModuleList([nn.LayerNorm(width), nn.LayerNorm(width)])
        self.convolutions = nn.ModuleList([Convolution(width, width), Convolution(width, width)])

    def forward(self, x: Float[Tensor, "v c"], level: Level) -> Float[Tensor, "v c"]:
        y = x
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            y = convolution(nn.functional.gelu(norm(y)), level)
        return x + y


@dataclass(frozen=True)
class Prediction:
    """Outputs of the network for each voxel."""

    logits: Float[Tensor, "v 3"]  # logits of CLASSES
    offsets: Float[Tensor, "v 3"]  # offset to the centre of the object [camera distance]
    embedding: Float[Tensor, "v e"]


class Segmenter(nn.Module):
    """The network, and the affinity of pairs of voxels. Attribute names are the keys of the shipped weights."""

    def __init__(self, widths: tuple[int, ...] = (32, 48, 64, 96), blocks: int = 1):
        super().__init__()
        self.config = {"widths": list(widths), "blocks": blocks}
        self.input_projection = nn.Linear(FEATURES, widths[0])
        self.input_convolution = Convolution(widths[0], widths[0])
        self.encoder = nn.ModuleList(nn.ModuleList(ResidualBlock(w) for _ in range(blocks)) for w in widths)
        self.downsample = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths, widths[1:], strict=False))
        self.upsample = nn.ModuleList(nn.Linear(b, a) for a, b in zip(widths, widths[1:], strict=False))
        self.decoder = nn.ModuleList(nn.ModuleList(ResidualBlock(w) for _ in range(blocks)) for w in widths[:-1])
        self.head_input = nn.Sequential(nn.LayerNorm(widths[0]), nn.Linear(widths[0], 64), nn.GELU())
        self.heads = nn.Linear(64, len(CLASSES) + 3 + PAIR_FEATURES)
        self.affinity_head = nn.Sequential(nn.Linear(2 * PAIR_FEATURES + 3, 32), nn.GELU(), nn.Linear(32, 1))
        self.register_buffer("feature_mean", torch.zeros(CANDIDATE_FEATURES))
        self.register_buffer("feature_scale", torch.ones(CANDIDATE_FEATURES))
        width = 48
        self.candidate_head = nn.Sequential(
            nn.Linear(CANDIDATE_FEATURES, width), nn.GELU(), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1)
        )

    def forward(self, features: Float[Tensor, "v f"], levels: list[Level]) -> Prediction:
        """Return predictions for the voxels of the finest level."""
        x = self.input_convolution(self.input_projection(features), levels[0])
        skips = []
        for depth, level in enumerate(levels):
            for block in self.encoder[depth]:
                x = block(x, level)
            if depth < len(levels) - 1:
                skips.append(x)
                x = self.downsample[depth](_pooled(x, level.children))
        for depth in reversed(range(len(levels) - 1)):
            x = skips[depth] + self.upsample[depth](x)[levels[depth].parent]
            for block in self.decoder[depth]:
                x = block(x, levels[depth])
        logits, offsets, embedding = self.heads(self.head_input(x)).split([len(CLASSES), 3, PAIR_FEATURES], 1)
        return Prediction(logits, offsets * OFFSET_UNIT, embedding)

    def affinity(
        self, found: Prediction, points: Float[Tensor, "v 3"], pairs: Int[Tensor, "e 2"]
    ) -> Float[Tensor, "e"]:
        """Log odds that the voxels of each pair belong to the same object; symmetric."""
        i, j = pairs.unbind(1)
        a, b = found.embedding[i], found.embedding[j]
        centres = points + found.offsets
        distance = (points[i] - points[j]).norm(dim=1, keepdim=True) / (5 * VOXEL)
        centre_distance = (centres[i] - centres[j]).norm(dim=1, keepdim=True) / (5 * VOXEL)
        offset_length = (found.offsets[i].norm(dim=1) + found.offsets[j].norm(dim=1))[:, None] / OFFSET_UNIT
        inputs = [(a - b).abs(), a * b, distance, centre_distance, offset_length]
        return self.affinity_head(torch.cat(inputs, 1))[:, 0]

    def score(self, features: Float[Tensor, "k f"]) -> Float[Tensor, "k"]:
        """Logit of the expected IoU of each candidate with the object that it fits best."""
        x = ((features - self.feature_mean) / self.feature_scale).clamp(-4, 4)
        return self.candidate_head(x)[:, 0]
