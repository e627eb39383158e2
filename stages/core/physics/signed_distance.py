"""Signed distance to the surface of a body on a grid, from points on the surface.

The surface is represented by surfels: discs through the points, normal to the direction of smallest variance of their
neighbourhood. The outward side of a disc is the one from which more rays escape; a disc with two open sides is part of
a sheet. Few rays pass through holes in the surface, so small holes do not open a side. The distance of a grid node is a
weighted mean of the distances to the nearest discs that face the same way, so flat faces stay flat and edges sharp.
Sources: Pfister et al. 2000, "Surfels"; Kolluri 2008, "Provably good moving least squares" (implicit form).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import BruteForce, KDTree, neighbour_index
from stages.core.geometry.symmetric_matrices import eigh

RESOLUTION = 36  # nodes of the grid along each axis
MARGIN = 4  # width of the grid around the body [cells]
NORMAL_NEIGHBOURS = 12  # surface points that determine a normal
BLENDED = 6  # nearest discs whose distances are averaged
MAX_SURFELS = 6_000  # maximum number of surface points used; more make no difference at this resolution
SAME_FACE = 0.5  # minimum cosine of the angle between the normals of discs that are averaged
OVERLAP = 2.0  # factor by which discs are enlarged, so that randomly spaced discs cover the surface without holes
SURFACE = 0.75  # distance to a disc up to which a node blocks rays [cells]
PROBE = 1.5  # distance from a disc at which the rays of either side start [cells]
FAR = 2.0  # distance from the surface above which rays decide whether a node is inside [cells]
FLAT = 1e-6  # height above a disc, relative to the distance from it, up to which a node lies in its plane
MIN_DIFFERENCE = 1e-6  # difference of the openness of a disc's two sides below which they are equal
OPEN = 0.06  # fraction of rays that escape above which a side is open
DIRECTIONS = [d for d in product((-1, 0, 1), repeat=3) if any(d)]  # of the rays [cells]


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distance at the nodes of a grid, negative inside; all lengths in the unit of the points."""

    values: Float[Tensor, "g g g"]
    low: Float[Tensor, "3"]  # position of the first node
    cell: Float[Tensor, "3"]  # distance between nodes along each axis

    def nodes(self) -> Float[Tensor, "g g g 3"]:
        """Positions of the nodes."""
        return _nodes(self.low, self.cell, len(self.values))


@dataclass(frozen=True)
class Surfels:
    """Discs that cover a surface."""

    centre: Float[Tensor, "m 3"]
    normal: Float[Tensor, "m 3"]  # unit, outward
    radius: Float[Tensor, "m"]
    half_thickness: Float[Tensor, "m"]  # 0 on the surface of a solid; positive on sheets, whose discs are two-sided


def distance_grid(points: Float[Tensor, "n 3"], sheet: float, resolution: int = RESOLUTION) -> DistanceGrid:
    """Signed distance to the surface through `points`, on their device; sheets get the thickness `sheet`."""
    if len(points) > MAX_SURFELS:
        points = points[np.random.default_rng(0).choice(len(points), MAX_SURFELS, replace=False)]
    middle = (points.amin(0) + points.amax(0)).double() / 2
    x = points.double() - middle
    extent = x.amax(0) - x.amin(0)
    side = extent.maximum((1e-3 * extent.max()).clamp_min(1e-9))
    cell = side / (resolution - 1 - 2 * MARGIN)
    low = x.amin(0) - MARGIN * cell
    nodes = _nodes(low, cell, resolution).reshape(-1, 3)
    tree = neighbour_index(x)
    surfels = _unoriented(x, tree)
    nearest = tree.query(nodes, min(BLENDED, len(x)))
    surface = _on_surface(surfels, nodes, nearest[1], cell).reshape((resolution,) * 3)
    surface[:, :, MARGIN] = True  # photos do not show the underside of a body, so it is closed at its lowest layer
    openness = _openness(surface)
    surfels = _oriented(surfels, tree, openness, low, cell, sheet)
    side = torch.where(openness.flatten() > OPEN, 1.0, -1.0).to(nodes)
    values = _distance(surfels, nodes, nearest, side)
    # at thin walls a disc can face the wrong side, so away from the surface the rays decide
    values = torch.where(values.abs() > FAR * cell.max(), side * values.abs(), values)
    return DistanceGrid(values.reshape((resolution,) * 3).float(), (low + middle).float(), cell.float())


def mass_properties(grid: DistanceGrid) -> tuple[float, Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """Volume, centre of mass, and inertia tensor about it per unit of mass, of the uniform body inside the surface.

    Each node is weighted by the fraction of its cell that is inside, as estimated from its distance. Second-order
    accurate in the cell size.
    """
    x = grid.nodes().reshape(-1, 3).double()
    width = grid.cell.double().prod() ** (1 / 3)
    weight = (0.5 - grid.values.reshape(-1).double() / width).clamp(0, 1)
    volume = float(weight.sum() * grid.cell.double().prod())
    weight = weight / weight.sum().clamp_min(1e-12)
    centre = weight @ x
    moment = (weight[:, None] * (x - centre)).T @ (x - centre)
    return volume, centre.float(), (moment.trace() * torch.eye(3).to(moment) - moment).float()


def _unoriented(points: Float[Tensor, "m 3"], tree: KDTree | BruteForce) -> Surfels:
    """Discs at the points, with normals of arbitrary sign."""
    distance, index = tree.query(points, min(NORMAL_NEIGHBOURS, len(points)))
    local = points[index] - points[index].mean(1, keepdim=True)
    _, axes = eigh(local.mT @ local)
    return Surfels(
        points, axes[:, :, 0].to(points), distance[:, min(4, distance.shape[1] - 1)], torch.zeros_like(distance[:, 0])
    )


def _on_surface(surfels: Surfels, nodes: Tensor, index: Int[Tensor, "g k"], cell: Tensor) -> Bool[Tensor, "g"]:
    """Mask of the nodes within SURFACE cells of one of their nearest discs."""
    offset, normal = nodes[:, None] - surfels.centre[index], surfels.normal[index]
    height = (offset * normal).sum(-1)
    beside = (offset.square().sum(-1) - height.square()).clamp_min(0).sqrt()
    reach = SURFACE * (surfels.normal * cell).norm(dim=-1)[index]
    return ((height.abs() < reach) & (beside < surfels.radius[index] + reach)).any(1)


def _openness(surface: Bool[Tensor, "g g g"]) -> Float[Tensor, "g g g"]:
    """Fraction of the rays from each node that leave the grid without meeting the surface."""
    out = torch.zeros(surface.shape, device=surface.device)
    for direction in DIRECTIONS:
        hit, reach = _shifted(surface, direction, 1), 1  # hit: the surface is among the next `reach` nodes of the ray
        while reach < len(surface):
            hit, reach = hit | _shifted(hit, direction, reach), 2 * reach
        out += ~hit
    return out / len(DIRECTIONS)


def _shifted(mask: Bool[Tensor, "g g g"], direction: tuple[int, int, int], steps: int) -> Bool[Tensor, "g g g"]:
    """The mask at the node `steps` further along a direction; False outside of the grid."""
    out, count = torch.zeros_like(mask), len(mask)
    here = tuple(slice(max(0, -d * steps), count - max(0, d * steps)) for d in direction)
    there = tuple(slice(max(0, d * steps), count - max(0, -d * steps)) for d in direction)
    out[here] = mask[there]
    return out


def _oriented(
    surfels: Surfels, tree: KDTree | BruteForce, openness: Float[Tensor, "g g g"], low: Tensor, cell: Tensor,
    sheet: float,
) -> Surfels:  # fmt: skip
    """The discs with outward normals, and with thickness `sheet` where both sides are open.

    The openness of a side is averaged over neighbouring discs. The origin is in the middle of the discs.
    """
    step = PROBE * (surfels.normal * cell).norm(dim=1, keepdim=True) * surfels.normal
    at = [((x - low) / cell).round().long().clamp(0, len(openness) - 1)
          for x in (surfels.centre + step, surfels.centre - step)]  # fmt: skip
    sides = [openness[tuple(i.unbind(1))].double() for i in at]
    _, index = tree.query(surfels.centre, min(NORMAL_NEIGHBOURS, len(surfels.centre)))
    same = (surfels.normal[index] @ surfels.normal[:, :, None])[..., 0]
    weight = (same.abs() - SAME_FACE).clamp_min(0)
    weight = weight / weight.sum(1, keepdim=True)
    ahead, behind = ((weight * torch.where(same > 0, sides[k][index], sides[1 - k][index])).sum(1) for k in (0, 1))
    # if both sides are equally open, outward is away from the middle, so that rounding does not decide
    equal = (ahead - behind).abs() < MIN_DIFFERENCE
    outward = torch.where(equal, (surfels.normal * surfels.centre).sum(1) > 0, ahead > behind)
    normal = torch.where(outward[:, None], surfels.normal, -surfels.normal)
    thickness = 0.5 * sheet * (torch.minimum(ahead, behind) > OPEN).to(normal)
    return Surfels(surfels.centre, normal, surfels.radius, thickness)


def _distance(
    surfels: Surfels, x: Float[Tensor, "g 3"], nearest: tuple[Float[Tensor, "g k"], Int[Tensor, "g k"]],
    side: Float[Tensor, "g"],
) -> Float[Tensor, "g"]:  # fmt: skip
    """Signed distance of positions to their nearest discs.

    The sign is that of the mean height above the discs, or in their plane, where rounding would decide, that of `side`.
    """
    near, index = nearest
    offset, normal = x[:, None] - surfels.centre[index], surfels.normal[index]
    height = (offset * normal).sum(-1)
    beside = (offset.square().sum(-1) - height.square()).clamp_min(0).sqrt()
    beyond = beside - OVERLAP * surfels.radius[index]
    sheet = surfels.half_thickness[index]
    length = torch.hypot(height, beyond.clamp_min(0))
    spread = surfels.radius[index[:, :1]].square().clamp_min(1e-24)
    weight = torch.exp((near[:, :1].square() - near.square()) / spread)
    along = (normal * normal[:, :1]).sum(-1)
    weight = weight * ((sheet > 0) | (along > SAME_FACE))
    solid = weight * (sheet == 0)
    above = (solid * height).sum(1)
    clear = above.abs() > FLAT * (solid * length).sum(1)
    sign = torch.where(clear, above.sign(), side)
    distance = torch.where(sheet > 0, length - sheet, sign[:, None] * length)
    return (weight * distance).sum(1) / weight.sum(1)


def _nodes(low: Tensor, cell: Tensor, resolution: int) -> Tensor:
    """Positions (g, g, g, 3) of the nodes of a grid."""
    lines = [low[a] + cell[a] * torch.arange(resolution).to(low) for a in range(3)]
    return torch.stack(torch.meshgrid(*lines, indexing="ij"), -1)
