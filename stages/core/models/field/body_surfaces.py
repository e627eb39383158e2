"""Surfaces of the bodies of a scene for contacts: signed distances on grids, and keypoints that stand for the surface.

A body's grid is in its frame, undeformed.
Source: point contacts in signed distances: Xu, Zhao and Barbic 2014, "Implicit multibody penalty-based distributed
contact".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NEIGHBOURS = 6  # samples, with itself, whose normals decide whether one is on a face
FACE_COSINE = 0.97  # least length of the mean of their normals, .71 at a cube's edges and .58 at its corners
CORNERS = torch.tensor(list(product((0, 1), repeat=3)))  # of a cell


@dataclass(frozen=True)
class BodyGrid:
    """Depths of one body below its surface at the nodes of a grid in its frame [m]."""

    depth: Float[Tensor, "x y z"]
    smooth: Float[Tensor, "x y z"]  # the same blurred, for directions
    keypoint: Int[Tensor, "x y z"]  # nearest one
    low: Float[Tensor, "3"]  # the first node
    spacing: float
    samples: Int[Tensor, "k"]  # keypoints that stand for the surface
    ball: tuple[Float[Tensor, "3"], float] | None = None  # its centre and radius, if the body is one


@dataclass(frozen=True)
class BodySurfaces:
    """The grids of all bodies one after the other, and their samples, padded."""

    depth: Float[Tensor, "g"]
    smooth: Float[Tensor, "g"]
    keypoint: Int[Tensor, "g"]
    first: Int[Tensor, "o"]  # row of each body's first node
    shape: Int[Tensor, "o 3"]
    low: Float[Tensor, "o 3"]
    spacing: Float[Tensor, "o"]
    samples: Int[Tensor, "o k"]  # keypoints; -1 where padded
    normals: Float[Tensor, "o k 3"]  # outwards, in the body's frame
    flat: Bool[Tensor, "o k"]  # on a face
    centre: Float[Tensor, "o 3"]  # of a ball
    radius: Float[Tensor, "o"]  # of a ball; 0 for other bodies
    overlap: Float[Tensor, "o o"]  # of each body with another at the start, which is no contact [m]

    @classmethod
    def of(cls, grids: Sequence[BodyGrid], arm: Float[Tensor, "o n 3"]) -> BodySurfaces:
        """The surfaces of bodies whose keypoints are at `arm` in their frames; without overlaps."""
        most = max(len(g.samples) for g in grids)
        samples = torch.full((len(grids), most), -1)
        for row, g in enumerate(grids):
            samples[row, : len(g.samples)] = g.samples
        sizes = torch.tensor([g.depth.numel() for g in grids])
        flat = {n: torch.cat([getattr(g, n).flatten() for g in grids]) for n in ("depth", "smooth", "keypoint")}
        out = cls(
            **flat, first=sizes.cumsum(0) - sizes, shape=torch.tensor([g.depth.shape for g in grids]),
            low=torch.stack([g.low for g in grids]), spacing=torch.tensor([g.spacing for g in grids]).to(arm),
            samples=samples, normals=arm.new_zeros(len(grids), most, 3),
            flat=torch.zeros_like(samples, dtype=torch.bool),
            centre=torch.stack([arm.new_zeros(3) if g.ball is None else g.ball[0] for g in grids]),
            radius=arm.new_tensor([0.0 if g.ball is None else g.ball[1] for g in grids]),
            overlap=arm.new_zeros(len(grids), len(grids)),
        )  # fmt: skip
        body = torch.arange(len(grids))[:, None].expand_as(samples)
        at = arm[body, samples.clamp_min(0)]
        normals = -out.look_up(body.flatten(), at.flatten(0, 1))[1].view_as(at)
        return replace(out, normals=normals, flat=_flat(at, normals, samples >= 0))

    def to(self, device: torch.device | str) -> BodySurfaces:
        """A copy on another device."""
        return replace(self, **{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def nearest_keypoint(self, body: Int[Tensor, "r"], x: Float[Tensor, "r 3"]) -> Int[Tensor, "r"]:
        """The keypoint near points x in the frames of bodies [m]."""
        node = ((x - self.low[body]) / self.spacing[body, None]).round().long().clamp_min(0)
        return self.keypoint[self._row(body, node.minimum(self.shape[body] - 1))]

    def look_up(
        self, body: Int[Tensor, "r"], x: Float[Tensor, "r 3"]
    ) -> tuple[Float[Tensor, "r"], Float[Tensor, "r 3"]]:
        """Depths of points x [m], in the frames of bodies, below their surfaces, and directions of steepest increase.

        Depths are negative outside; beyond the grid they are upper bounds.
        """
        h, shape = self.spacing[body, None], self.shape[body]
        place = (x - self.low[body]) / h
        within = place.clamp_min(0).minimum((shape - 1).to(x))
        cell = within.long().minimum(shape - 2)
        f = within - cell
        corner = CORNERS.to(cell.device)
        row = self._row(body[:, None], cell[:, None] + corner)
        side = torch.where(corner.bool(), f[:, None], 1 - f[:, None])  # r 8 3
        depth = (self.depth[row] * side.prod(-1)).sum(-1)
        # the body is in the box of its grid, so the angle at the nearest point of the box is at least a right one
        beyond = ((place - within) * h).square().sum(-1)
        depth = torch.where(beyond > 0, -(beyond + depth.clamp_max(0).square()).sqrt(), depth)
        sign = (2 * corner - 1).to(x)
        others = torch.stack(
            [side[..., 1] * side[..., 2], side[..., 0] * side[..., 2], side[..., 0] * side[..., 1]], -1
        )
        slope = (self.smooth[row][..., None] * sign * others).sum(1)
        return depth, slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-12)

    def _row(self, body: Tensor, node: Tensor) -> Tensor:
        shape = self.shape[body]
        return self.first[body] + (node[..., 0] * shape[..., 1] + node[..., 1]) * shape[..., 2] + node[..., 2]


def _flat(
    at: Float[Tensor, "o k 3"], normals: Float[Tensor, "o k 3"], real: Bool[Tensor, "o k"]
) -> Bool[Tensor, "o k"]:
    """Which samples are on a face, by the normals around them."""
    distance = torch.cdist(at, at).masked_fill(~real[:, None], torch.inf)
    near = distance.topk(min(NEIGHBOURS, at.shape[1]), largest=False).indices
    body = torch.arange(len(at))[:, None, None]
    return normals[body, near].mean(2).norm(dim=-1) > FACE_COSINE
