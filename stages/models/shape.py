"""What can be known of objects before they move: surfaces, inertia, neighbourhoods. All of it turns with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.models.world import World, inertia, offsets

NEIGHBOURS = 12  # keypoints that make a normal
BLUR = (0.12, 0.4)  # radii of neighbourhoods, in sizes of the object
MOST = 16_384  # small matrices at a time: CUDA's solver fails on 65,536


@dataclass(frozen=True)
class Shape:
    """The objects of a world at rest."""

    world: World
    arm: Float[Tensor, "b o n 3"]  # keypoints about the centre of mass [m]
    normal: Float[Tensor, "b o n 3"]  # outwards, at most of length 1; short where out and in are not to be told apart
    spacing: Float[Tensor, "b o n"]  # distance to the nearest keypoints [m]
    size: Float[Tensor, "b o"]  # radius of gyration [m]
    inverse: Float[Tensor, "b o 3 3"]  # of the inertia tensor per unit of mass [1/m^2]
    blur: Float[Tensor, "b o s n n"]  # weights that average over the neighbourhoods of BLUR; perhaps 16-bit
    others: Int[Tensor, "o m"]  # for each object the rows of the others
    back: Int[Tensor, "o m"]  # others[others[i, k], back[i, k]] is i

    def __getitem__(self, rows: slice | Tensor) -> Shape:
        """Some of the scenes, still a batch."""
        each = ("world", "arm", "normal", "spacing", "size", "inverse", "blur")
        return replace(self, **{name: getattr(self, name)[rows] for name in each})


@torch.no_grad()
def shape_of(world: World) -> Shape:
    """Everything about the rest shape."""
    arm = offsets(world, world.points)
    size = (world.share * arm.square().sum(-1)).sum(-1).clamp_min(1e-8).sqrt()
    gap = _gaps(arm).masked_fill_(~(world.valid[:, :, None] & world.valid[..., None]), torch.inf)
    normal, spacing = _surface(arm, gap, size)
    reach = gap.new_tensor(BLUR)[:, None, None] * size[..., None, None, None]
    blur = torch.exp(-((gap[:, :, None] / reach) ** 2)) * world.share[:, :, None, None]
    blur = blur / blur.sum(-1, keepdim=True).clamp_min(1e-12)
    others, back = _others(world.valid.shape[1], arm.device)
    inverse = torch.linalg.inv(inertia(world.share, arm))
    return Shape(world, arm, normal, spacing, size, inverse, blur, others, back)


def _gaps(x: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n n"]:
    """Distances between the points of an object; exact for near ones, and fifty times faster than cdist on a GPU."""
    squared = x.new_zeros(*x.shape[:3], x.shape[2])
    for c in x.unbind(-1):
        squared += (c[..., :, None] - c[..., None, :]).square_()
    return squared.sqrt_()


def _surface(
    arm: Float[Tensor, "b o n 3"], gap: Float[Tensor, "b o n n"], size: Float[Tensor, "b o"]
) -> tuple[Float[Tensor, "b o n 3"], Float[Tensor, "b o n"]]:
    """Normals: the direction of least extent of the neighbours, away from the centre. And the spacing."""
    near, index = gap.topk(min(NEIGHBOURS, gap.shape[-1]), largest=False)
    there = near.isfinite()
    rows = index[..., None].expand(*index.shape, 3)
    cloud = torch.gather(arm[:, :, None].expand(*index.shape[:3], *arm.shape[2:]), 3, rows)
    weight = there.to(arm) / there.sum(-1, keepdim=True).clamp_min(1)
    cloud = (cloud - (weight[..., None] * cloud).sum(-2, keepdim=True)) * weight[..., None].sqrt()
    spread = (cloud.mT @ cloud).flatten(0, 2).split(MOST)
    normal = torch.cat([torch.linalg.eigh(s).eigenvectors[..., 0] for s in spread]).reshape(arm.shape)
    side = (normal * arm).sum(-1) / (0.1 * size[..., None])
    close = near[..., 1:5]
    spacing = close.masked_fill(~close.isfinite(), 0).sum(-1) / close.isfinite().sum(-1).clamp_min(1)
    return normal * side.tanh()[..., None] * there[..., :1], spacing


def _others(count: int, device: torch.device) -> tuple[Int[Tensor, "o m"], Int[Tensor, "o m"]]:
    row = torch.arange(count, device=device)[:, None]
    column = torch.arange(max(count - 1, 0), device=device)[None]
    others = column + (column >= row)
    return others, (row - (row > others).long()).expand_as(others)
