"""Completion in the convex hull: fills the unseen part of an object's hull and covers its surface with discs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.perception.observed_space import ObservedSpace
from stages.core.perception.support import Support, topples
from stages.core.scene.gaussians import SURFACE_OPACITY, Gaussians
from stages.core.scene.scene import Scene
from stages.refine.disc_gaussians import disc_gaussians, empty_like
from stages.refine.options import RefineOptions

MIN_GAUSSIANS = 16  # fewest Gaussians of an object that is completed
PADDING = 3  # empty cells on each side of the object
MAX_HULL_POINTS = 20_000  # about the most points of which a convex hull is computed


def no_completion(
    scene: Scene, number: int, observed: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """The completer "none": adds nothing."""
    return empty_like(scene.gaussians)


def complete(
    scene: Scene, number: int, observed: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """The completer "close": discs on the unseen sides of an object, with colours of the adjacent seen surface.

    The object's volume is its convex hull, extended down to the plane on which it stands, without observed free space
    and other objects. Time and memory are bounded by the number of cells, at most (resolution + 6)^3.
    """
    g = scene.gaussians
    own = g[(g.object_id == number) & (g.opacities > 0.05) & g.means.isfinite().all(1) & g.scales.isfinite().all(1)]
    grid = ObjectVoxels.around(own, support, options.resolution) if len(own) >= MIN_GAUSSIANS else None
    if grid is None:
        return empty_like(g)
    volume = _volume(grid, own, g, number, observed, support)
    points, normals = _open_surface(grid, volume, own)
    if support is not None and len(points):  # not below the table
        points[:, 2] = torch.maximum(points[:, 2], support.surface(points))
    if not len(points):
        return empty_like(g)
    return disc_gaussians(points, normals, _diffused_colours(points, own, grid.cell), grid.cell, number)


@dataclass(frozen=True)
class ObjectVoxels:
    """A voxel grid around an object."""

    low: Float[Tensor, "3"]  # lower corner of the first cell [scene units]
    cell: float  # side of a cell [scene units]
    shape: tuple[int, int, int]

    @staticmethod
    def around(own: Gaussians, support: Support | None, resolution: int) -> ObjectVoxels | None:
        """A grid with at most `resolution` cells along the object's longest side; None if the object has no extent."""
        low, high = own.means.amin(0), own.means.amax(0)
        if support is not None:
            low = torch.cat([low[:2], torch.minimum(low[2], support.surface(own.means).amin())[None]])
        longest = float((high - low).max())
        if not 1e-9 < longest < 1e9:
            return None
        spacing = float(knn(own.means, own.means[:: max(1, len(own) // 5000)], 4)[0][:, -1].median())
        cell = min(max(longest / resolution, 1.2 * spacing), longest / 6)
        shape = ((high - low) / cell).ceil().long() + 1 + 2 * PADDING
        return ObjectVoxels(low - PADDING * cell, cell, tuple(shape.tolist()))

    def occupancy(self, points: Float[Tensor, "n 3"]) -> np.ndarray:
        """Mask of the cells that contain a point."""
        index = ((points - self.low) / self.cell).floor().long()
        index = index[((index >= 0) & (index < torch.tensor(self.shape))).all(1)]
        out = np.zeros(self.shape, bool)
        out[tuple(index.T.numpy())] = True
        return out

    def centres(self) -> Float[Tensor, "c 3"]:
        """Centres of all cells, row-major."""
        axes = [torch.arange(n) for n in self.shape]
        return self.low + (torch.cartesian_prod(*axes) + 0.5) * self.cell


def _sigma_points(g: Gaussians, max_sigma: float) -> Float[Tensor, "m 3"]:
    """The means, and points one standard deviation (at most `max_sigma`) away in both directions of each axis."""
    axes = matrix(g.quats) * g.scales.clamp(max=max_sigma)[:, None, :]
    return torch.cat([g.means, *(g.means + sign * axes[:, :, a] for a in range(3) for sign in (-1, 1))])


def _volume(
    grid: ObjectVoxels,
    own: Gaussians,
    everything: Gaussians,
    number: int,
    observed: ObservedSpace,
    support: Support | None,
) -> np.ndarray:
    """Mask of the cells of the object's volume, seen and unseen."""
    occupied = grid.occupancy(_sigma_points(own, 2 * grid.cell))
    centres = grid.centres()
    inside = torch.from_numpy(_in_hull(_grounded_points(own, support), centres, 0.5 * grid.cell))
    if support is not None:
        inside &= support.heights(centres) > 0
    other = (everything.object_id != number) & (everything.opacities > SURFACE_OPACITY)
    if support is not None:
        other &= (support.heights(everything.means) > support.tolerance) | (everything.object_id > 0)
    taken = grid.occupancy(everything.means[other])
    others = everything[(everything.object_id != number) & (everything.object_id > 0)]
    inside &= _nearer_to(own, others, centres, inside)
    volume = inside.numpy().reshape(grid.shape)
    if observed.views:
        cells = torch.nonzero(inside)[:, 0]
        seen_through = torch.zeros(len(centres), dtype=torch.bool)
        seen_through[cells] = observed.is_free(centres[cells], 1.5 * grid.cell)
        volume = volume & ~seen_through.numpy().reshape(grid.shape)
    else:  # free space is unknown: fill only the volume that the object encloses
        volume = ndimage.binary_fill_holes(
            ndimage.binary_closing(occupied | _cells_below(occupied, volume), iterations=2)
        )
    volume = ndimage.binary_opening(volume & ~taken, iterations=1) | occupied
    parts, _ = ndimage.label(volume)
    return np.isin(parts, np.unique(parts[occupied]))


def _nearer_to(own: Gaussians, others: Gaussians, points: Tensor, asked: Tensor) -> Tensor:
    """Mask of the points in the mask `asked` that are nearer to the object than to any other object."""
    low, high = points.amin(0), points.amax(0)
    others = others[((others.means > low) & (others.means < high)).all(1)]
    out = asked.clone()
    if len(others) and bool(asked.any()):
        out[asked] = knn(own.means, points[asked], 1)[0][:, 0] <= knn(others.means, points[asked], 1)[0][:, 0]
    return out


def _grounded_points(own: Gaussians, support: Support | None) -> np.ndarray:
    """The object's points, and the projection of its lowest part onto the plane on which it stands.

    If the seen part alone would topple, the unseen part must support it; then all points are projected.
    """
    points = own.means
    if support is not None:
        h = support.heights(points)
        low = h < max(3 * support.tolerance, 0.15 * float(h.max()))
        if float(h.min()) < 3 * support.tolerance:
            foot = points if topples(points[:, :2], points[low, :2]) else points[low]
            points = torch.cat([points, torch.cat([foot[:, :2], support.surface(foot)[:, None]], 1)])
    return points.double().numpy()


def _in_hull(points: np.ndarray, queries: Float[Tensor, "c 3"], margin: float) -> np.ndarray:
    """Mask of the queries inside the convex hull of points or within `margin` of it; all False for a flat hull."""
    try:
        hull = ConvexHull(points[:: max(1, len(points) // MAX_HULL_POINTS)]).equations.astype(np.float32)
    except (QhullError, ValueError):
        return np.zeros(len(queries), bool)
    out = [(part @ hull[:, :3].T + hull[:, 3]).max(1) < margin for part in np.array_split(queries.numpy(), 64)]
    return np.concatenate(out)


def _cells_below(occupied: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Mask of the cells below occupied cells in the lowest quarter of an object, down to the plane."""
    z = np.flatnonzero(occupied.any((0, 1)))
    top = z[0] + max(1, (z[-1] - z[0]) // 4) if len(z) else 0
    under = np.flip(np.logical_or.accumulate(np.flip(occupied, 2), 2), 2)  # below an occupied cell
    under[:, :, top:] = False
    return under & inside


def _open_surface(grid: ObjectVoxels, volume: np.ndarray, own: Gaussians) -> tuple[Tensor, Tensor]:
    """Points and outward normals on the surface of the volume where the object has no Gaussians."""
    soft = ndimage.gaussian_filter(volume.astype(np.float32), 1.0)
    skin = volume & ~ndimage.binary_erosion(volume)
    index = torch.from_numpy(np.argwhere(skin))
    if not len(index):
        return torch.zeros(0, 3), torch.zeros(0, 3)
    slope = torch.stack([torch.from_numpy(s)[skin] for s in np.gradient(soft)], 1)
    steep = slope.norm(dim=1).clamp_min(1e-3)
    normals = -slope / steep[:, None]
    out = ((torch.from_numpy(soft[skin]) - 0.5) / steep).clamp(-0.7, 0.7)
    points = grid.low + (index + 0.5 + out[:, None] * normals) * grid.cell
    bare = knn(own.means, points, 1)[0][:, 0] > 1.3 * grid.cell
    return points[bare], normals[bare]


def _diffused_colours(points: Float[Tensor, "m 3"], own: Gaussians, cell: float) -> Float[Tensor, "m 3"]:
    """Colours of the nearest seen Gaussians, diffused over the new surface."""
    distance, index = knn(own.means, points, 16)
    weight = own.opacities[index] / (distance + 0.5 * cell).square()
    rgb = (own.sh[:, 0] * C0 + 0.5).clamp(0, 1)[index]
    rgb = (rgb * weight[..., None]).sum(1) / weight.sum(1, keepdim=True).clamp_min(1e-12)
    _, near = knn(points, points, 9)
    edge = distance[:, :1] < 2 * cell  # adjacent to the seen surface: kept fixed, so that there is no seam
    for _ in range(20):
        rgb = torch.where(edge, rgb, rgb[near].mean(1))
    return rgb
