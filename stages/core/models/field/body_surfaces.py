"""Surfaces of the bodies of a scene for contact: signed distance grids and surface samples.

The grid of a body is in its body frame and of the undeformed shape.
Source: point contacts in signed distance fields, Xu, Zhao and Barbic 2014, "Implicit multibody penalty-based
distributed contact".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

CORNERS = torch.tensor(list(product((0, 1), repeat=3)))  # corners of a grid cell


@dataclass(frozen=True)
class BodyGrid:
    """Depth grid of one body in its frame, with surface samples [m].

    `samples` are k of the p surface points for which `flatness` and `faces` are given.
    """

    depth: Float[Tensor, "x y z"]  # depth below the surface at the nodes, negative outside
    smooth: Float[Tensor, "x y z"]  # blurred depth, whose gradient gives directions
    keypoint: Int[Tensor, "x y z"]  # keypoint nearest to each node
    low: Float[Tensor, "3"]  # position of the first node
    spacing: float  # distance between nodes
    samples: Float[Tensor, "k 3"]  # points on the surface
    normals: Float[Tensor, "k 3"]  # outward normals at the samples
    near: Int[Tensor, "k"]  # keypoint nearest to each sample
    point: Int[Tensor, "k"]  # index of each sample among the p points
    flatness: Float[Tensor, "p"]  # of the surface at each point: 1 in a plane, 0 at an edge
    faces: Float[Tensor, "p 3 3"]  # normals of up to three faces that meet at each point; unused rows are 0
    nearest: Int[Tensor, "x y z"]  # point nearest to each node; -1 far from the surface
    ball: tuple[Float[Tensor, "3"], float] | None = None  # centre and radius, if the body is a ball
    # centre, axis, radius and half the height, if the body is a solid cylinder
    cylinder: tuple[Float[Tensor, "3"], Float[Tensor, "3"], float, float] | None = None
    hull: Float[Tensor, "f 4"] = torch.zeros(0, 4)  # normals and offsets of the faces, if the body is convex


@dataclass(frozen=True)
class BodySurfaces:
    """BodyGrid of all bodies: nodes, points and faces concatenated, samples padded to k."""

    depth: Float[Tensor, "g"]
    smooth: Float[Tensor, "g"]
    keypoint: Int[Tensor, "g"]
    first: Int[Tensor, "o"]  # row of each body's first node
    shape: Int[Tensor, "o 3"]  # nodes along each axis
    low: Float[Tensor, "o 3"]
    spacing: Float[Tensor, "o"]
    near: Int[Tensor, "o k"]  # keypoint nearest to each sample; -1 where padded
    samples: Float[Tensor, "o k 3"]  # points on the surface in the body's frame [m]
    normals: Float[Tensor, "o k 3"]  # outward normals at the samples
    point: Int[Tensor, "o k"]  # index of each sample among the p points
    flatness: Float[Tensor, "p"]  # of the surface at each point: 1 in a plane, 0 at an edge
    faces: Float[Tensor, "p 3 3"]  # normals of up to three faces that meet at each point; unused rows are 0
    nearest: Int[Tensor, "g"]  # point nearest to each node; -1 far from the surface
    centre: Float[Tensor, "o 3"]  # centre of a ball or a solid cylinder
    radius: Float[Tensor, "o"]  # radius of a ball; 0 for other bodies
    axis: Float[Tensor, "o 3"]  # axis of a solid cylinder
    side: Float[Tensor, "o"]  # radius of a solid cylinder; 0 for other bodies
    half: Float[Tensor, "o"]  # half the height of a solid cylinder
    hull: Float[Tensor, "h 4"]  # normals and offsets of the faces of convex bodies [1, m]
    hull_first: Int[Tensor, "o"]  # row of each body's first face
    hull_faces: Int[Tensor, "o"]  # number of faces of each body; 0 if it is not convex
    reach: Float[Tensor, "o"]  # largest distance of a sample from the centre of mass [m]
    overlap: Float[Tensor, "o o"]  # initial penetration depth of each pair of bodies, which gaps disregard [m]

    @classmethod
    def of(cls, grids: Sequence[BodyGrid]) -> BodySurfaces:
        """Combine the grids of all bodies, with zero `overlap`."""
        sizes = torch.tensor([g.depth.numel() for g in grids])
        flat = {n: torch.cat([getattr(g, n).flatten() for g in grids]) for n in ("depth", "smooth", "keypoint")}
        at, normals, near, point = (
            pad_sequence([getattr(g, n) for g in grids], batch_first=True, padding_value=padding)
            for n, padding in (("samples", 0.0), ("normals", 0.0), ("near", -1), ("point", 0))
        )
        points = torch.tensor([len(g.faces) for g in grids])
        first = points.cumsum(0) - points
        nearest = [torch.where(g.nearest < 0, -1, first[i] + g.nearest).flatten() for i, g in enumerate(grids)]
        none = at.new_zeros(3), 0.0
        hulls = torch.tensor([len(g.hull) for g in grids])
        balls = [none if g.ball is None else g.ball for g in grids]
        no_tube = at.new_zeros(3), at.new_zeros(3), 0.0, 0.0
        cylinders = [no_tube if g.cylinder is None else g.cylinder for g in grids]
        return cls(
            **flat, first=sizes.cumsum(0) - sizes, shape=torch.tensor([g.depth.shape for g in grids]),
            low=torch.stack([g.low for g in grids]), spacing=at.new_tensor([g.spacing for g in grids]),
            near=near, samples=at, normals=normals, point=first[:, None] + point,
            flatness=torch.cat([g.flatness for g in grids]), faces=torch.cat([g.faces for g in grids]),
            nearest=torch.cat(nearest),
            centre=torch.stack([ball[0] + tube[0] for ball, tube in zip(balls, cylinders, strict=True)]),
            radius=at.new_tensor([radius for _, radius in balls]),
            axis=torch.stack([axis for _, axis, _, _ in cylinders]),
            side=at.new_tensor([radius for _, _, radius, _ in cylinders]),
            half=at.new_tensor([half for _, _, _, half in cylinders]),
            hull=torch.cat([g.hull for g in grids]), hull_first=hulls.cumsum(0) - hulls, hull_faces=hulls,
            reach=at.norm(dim=-1).amax(-1), overlap=at.new_zeros(len(grids), len(grids)),
        )  # fmt: skip

    def to(self, device: torch.device | str) -> BodySurfaces:
        """Return a copy on another device."""
        return replace(self, **{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def look_up(
        self, body: Int[Tensor, "r"], x: Float[Tensor, "r 3"]
    ) -> tuple[Float[Tensor, "r"], Float[Tensor, "r 3"]]:
        """Return depths [m] of points x below the surfaces of bodies, and the directions of their steepest increase.

        Points are in the frames of the bodies [m]. Depths are negative outside; beyond the grid they are upper bounds.
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
        # The body lies within the box of its grid, so the angle at the nearest point of the box is at least a right
        # angle, and Pythagoras gives an upper bound of the (negative) depth.
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
