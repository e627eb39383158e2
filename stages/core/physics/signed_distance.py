"""Signed distance to the surface of a body on a grid, from points on its surface and particles inside it.

The surface is represented by surfels: discs through the points, normal to the least-varying direction of their
neighbourhood. A disc faces the side from which rays escape; one with two open sides is a part of a sheet. Holes in the
surface let only few rays pass. The distance of a grid node is a moving average of the distances to the nearest discs
that face the same way, so flat faces stay flat and edges sharp.
Sources: Pfister et al. 2000, "Surfels"; Kolluri 2008, "Provably good moving least squares" (implicit form).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

RESOLUTION = 36  # nodes of the grid along each axis
MARGIN = 4  # cells of the grid around the body
NEIGHBOURS = 12  # surface points that determine a normal
BLENDED = 6  # discs whose distances are averaged
MAX_SURFELS = 6_000  # surface points used; more make no difference at this resolution
SAME_FACE = 0.5  # smallest cosine of the angle between the normals of discs that are averaged
OVERLAP = 2.0  # discs are extended by this factor, so that they cover random points without holes
SURFACE = 0.75  # a node this close to a disc stops rays [cells]
PROBE = 1.5  # distance from a disc at which the rays of a side start [cells]
FAR = 2.0  # distance from the surface at which the rays from a node decide on its side [cells]
OPEN = 0.06  # fraction of the rays that escape from an open side, at least
DIRECTIONS = [d for d in product((-1, 0, 1), repeat=3) if any(d)]  # of the rays, in cells


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distance at the nodes of a grid, negative inside; all lengths in the unit of the points."""

    values: Float[Tensor, "g g g"]
    low: Float[Tensor, "3"]  # the first node
    cell: Float[Tensor, "3"]  # distance between nodes along each axis

    def nodes(self) -> Float[Tensor, "g g g 3"]:
        """Positions of the nodes."""
        return _nodes(self.low, self.cell, len(self.values))


@dataclass(frozen=True)
class Surfels:
    """Discs that cover a surface."""

    centre: np.ndarray  # (m, 3)
    normal: np.ndarray  # (m, 3), unit, outward
    radius: np.ndarray  # (m,)
    half_thickness: np.ndarray  # (m,); 0 on the surface of a solid, positive on sheets, which have two sides


def distance_grid(points: Float[Tensor, "n 3"], sheet: float, resolution: int = RESOLUTION) -> DistanceGrid:
    """Signed distance to the surface through `points`; sheets get the thickness `sheet`."""
    x = points.double().numpy()
    if len(x) > MAX_SURFELS:
        x = x[np.random.default_rng(0).choice(len(x), MAX_SURFELS, replace=False)]
    side = np.maximum(x.max(0) - x.min(0), max(1e-3 * float(np.ptp(x, axis=0).max()), 1e-9))
    cell = side / (resolution - 1 - 2 * MARGIN)
    low, cell = torch.from_numpy(x.min(0) - MARGIN * cell), torch.from_numpy(cell)
    nodes = _nodes(low, cell, resolution).reshape(-1, 3).numpy()
    surfels = _unoriented(x)
    nearest = _tree(x).query(nodes, _ranks(BLENDED, len(x)))
    surface = _on_surface(surfels, nodes, nearest[1], cell.numpy()).reshape((resolution,) * 3)
    surface[:, :, MARGIN] = True  # what a body stands on closes it: photos do not show its lower side
    openness = _openness(surface)
    surfels = _oriented(surfels, openness, low.numpy(), cell.numpy(), sheet)
    values = _distance(surfels, nodes, nearest)
    # the side of a single disc can be wrong where walls are thin; away from the surface rays decide
    far = np.abs(values) > FAR * float(cell.max())
    values = np.where(far, np.where(openness.ravel() > OPEN, 1, -1) * np.abs(values), values)
    values = torch.from_numpy(values).reshape((resolution,) * 3)
    return DistanceGrid(values.float(), low.float(), cell.float())


def mass_properties(grid: DistanceGrid) -> tuple[float, Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """Volume, centre of mass, and inertia tensor about it per unit of mass, of the uniform body inside the surface.

    A node counts by the part of a ball of its cell's size that is inside; second order in the size of a cell.
    """
    x = grid.nodes().reshape(-1, 3).double()
    width = grid.cell.double().prod() ** (1 / 3)
    weight = (0.5 - grid.values.reshape(-1).double() / width).clamp(0, 1)
    volume = float(weight.sum() * grid.cell.double().prod())
    weight = weight / weight.sum().clamp_min(1e-12)
    centre = weight @ x
    moment = (weight[:, None] * (x - centre)).T @ (x - centre)
    return volume, centre.float(), (moment.trace() * torch.eye(3, dtype=moment.dtype) - moment).float()


def _unoriented(points: np.ndarray) -> Surfels:
    """Discs at the points, with normals of either sign."""
    distance, index = _tree(points).query(points, _ranks(NEIGHBOURS, len(points)))
    local = points[index] - points[index].mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    radius = distance[:, min(4, distance.shape[1] - 1)]
    return Surfels(points, axes[:, :, 0], radius, np.zeros(len(points)))


def _on_surface(surfels: Surfels, nodes: np.ndarray, index: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Mask of the nodes within SURFACE cells of one of their nearest discs."""
    offset, normal = nodes[:, None] - surfels.centre[index], surfels.normal[index]
    height = (offset * normal).sum(-1)
    beside = np.sqrt(np.maximum((offset**2).sum(-1) - height**2, 0))
    reach = SURFACE * np.sqrt(((normal * cell) ** 2).sum(-1))
    return ((np.abs(height) < reach) & (beside < surfels.radius[index] + reach)).any(1)


def _openness(surface: np.ndarray) -> np.ndarray:
    """Fraction (g, g, g) of the rays from each node that leave the grid without meeting the surface."""
    count = len(surface)
    out = np.zeros(surface.shape, np.float32)
    for direction in DIRECTIONS:
        axis = next(a for a in range(3) if direction[a])
        free, escapes = np.moveaxis(~surface, axis, 0), np.ones(surface.shape, bool)
        shift = [direction[a] for a in range(3) if a != axis]
        order = range(count - 2, -1, -1) if direction[axis] > 0 else range(1, count)
        for k in order:
            ahead = np.pad(free[k + direction[axis]] & escapes[k + direction[axis]], 1, constant_values=True)
            escapes[k] = ahead[1 + shift[0] :, 1 + shift[1] :][:count, :count]
        out += np.moveaxis(escapes, 0, axis)
    return out / len(DIRECTIONS)


def _oriented(surfels: Surfels, openness: np.ndarray, low: np.ndarray, cell: np.ndarray, sheet: float) -> Surfels:
    """The discs with outward normals, and of thickness `sheet` where both sides are open; neighbours vote."""
    step = PROBE * np.sqrt(((surfels.normal * cell) ** 2).sum(1, keepdims=True)) * surfels.normal
    sides = []
    for x in (surfels.centre + step, surfels.centre - step):
        at = np.rint((x - low) / cell).astype(int).clip(0, len(openness) - 1)
        sides.append(openness[tuple(at.T)])
    _, index = _tree(surfels.centre).query(surfels.centre, _ranks(NEIGHBOURS, len(surfels.centre)))
    same = np.einsum("nki,ni->nk", surfels.normal[index], surfels.normal)
    weight = np.maximum(np.abs(same) - SAME_FACE, 0)
    weight /= weight.sum(1, keepdims=True)
    ahead, behind = (
        (weight * np.where(same > 0, sides[k][index], sides[1 - k][index])).sum(1) for k in (0, 1)
    )  # fmt: skip
    normal = np.where((ahead < behind)[:, None], -surfels.normal, surfels.normal)
    thickness = np.where(np.minimum(ahead, behind) > OPEN, 0.5 * sheet, 0.0)
    return Surfels(surfels.centre, normal, surfels.radius, thickness)


def _tree(points: np.ndarray):
    from scipy.spatial import cKDTree  # noqa: PLC0415 -- slow to import, and only simulations need it

    return cKDTree(points)


def _ranks(count: int, available: int) -> list[int]:
    """Neighbours to query, nearest first; a list keeps their axis where there is only one."""
    return list(range(1, min(count, available) + 1))


def _distance(surfels: Surfels, x: np.ndarray, nearest: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Signed distance of positions (m, 3) to their nearest discs."""
    near, index = nearest
    offset, normal = x[:, None] - surfels.centre[index], surfels.normal[index]
    height = np.einsum("nki,nki->nk", offset, normal)
    beyond = np.sqrt(np.maximum((offset**2).sum(-1) - height**2, 0)) - OVERLAP * surfels.radius[index]
    sheet = surfels.half_thickness[index]
    length = np.hypot(height, np.maximum(beyond, 0))
    distance = np.where(sheet > 0, length - sheet, np.copysign(length, height))
    weight = np.exp(-(near**2 - near[:, :1] ** 2) / np.maximum(surfels.radius[index[:, :1]], 1e-12) ** 2)
    along = np.einsum("nki,ni->nk", normal, normal[:, 0])
    weight = weight * np.where(sheet > 0, 1.0, along > SAME_FACE)
    return (weight * distance).sum(1) / weight.sum(1)


def _nodes(low: Tensor, cell: Tensor, resolution: int) -> Tensor:
    """Positions (g, g, g, 3) of the nodes of a grid."""
    lines = [low[a] + cell[a] * torch.arange(resolution, dtype=low.dtype) for a in range(3)]
    return torch.stack(torch.meshgrid(*lines, indexing="ij"), -1)
