"""Objects closed all around: what no camera saw is filled within their convex hull, and its surface covered."""

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
from stages.core.perception.support import Support, topples
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.refine.disc_gaussians import disc_gaussians, empty_like
from stages.refine.observed_space import ObservedSpace
from stages.refine.options import RefineOptions

LEAST = 16  # Gaussians; fewer have no shape to speak of
PAD = 3  # empty cells around the object


def no_completion(
    scene: Scene, number: int, sight: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """The completer that completes nothing."""
    return empty_like(scene.gaussians)


def complete(
    scene: Scene, number: int, sight: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """Flat Gaussians on the unseen sides and the bottom of an object, in the colours of what is seen next to them.

    The object's body is what lies in its convex hull (down to the plane it stands on), is not seen through by
    any camera and holds no other thing. Time and memory are bounded by the cells, (resolution + 6)^3 at most.
    """
    g = scene.gaussians
    own = g[(g.object_id == number) & (g.opacities > 0.05) & g.means.isfinite().all(1) & g.scales.isfinite().all(1)]
    grid = ObjectVoxels.around(own, support, options.resolution) if len(own) >= LEAST else None
    if grid is None:
        return empty_like(g)
    body = _body(grid, own, g, number, sight, support)
    points, normals = _open_surface(grid, body, own)
    if support is not None and len(points):  # nothing below the table
        points[:, 2] = torch.maximum(points[:, 2], support.surface(points))
    if not len(points):
        return empty_like(g)
    return disc_gaussians(points, normals, _diffused(points, own, grid.cell), grid.cell, number)


@dataclass(frozen=True)
class ObjectVoxels:
    """Cells over an object."""

    low: Float[Tensor, "3"]  # corner of the first cell
    cell: float
    shape: tuple[int, int, int]

    @staticmethod
    def around(own: Gaussians, support: Support | None, resolution: int) -> ObjectVoxels | None:
        """None where the object has no extent."""
        low, high = own.means.amin(0), own.means.amax(0)
        if support is not None:
            low = torch.cat([low[:2], torch.minimum(low[2], support.surface(own.means).amin())[None]])
        longest = float((high - low).max())
        if not 1e-9 < longest < 1e9:
            return None
        spacing = float(knn(own.means, own.means[:: max(1, len(own) // 5000)], 4)[0][:, -1].median())
        cell = min(max(longest / resolution, 1.2 * spacing), longest / 6)
        shape = ((high - low) / cell).ceil().long() + 1 + 2 * PAD
        return ObjectVoxels(low - PAD * cell, cell, tuple(shape.tolist()))

    def cells_of(self, points: Float[Tensor, "n 3"]) -> np.ndarray:
        """Whether each cell holds a point."""
        index = ((points - self.low) / self.cell).floor().long()
        index = index[((index >= 0) & (index < torch.tensor(self.shape))).all(1)]
        out = np.zeros(self.shape, bool)
        out[tuple(index.T.numpy())] = True
        return out

    def centres(self) -> Float[Tensor, "c 3"]:
        axes = [torch.arange(n) for n in self.shape]
        return self.low + (torch.cartesian_prod(*axes) + 0.5) * self.cell


def _spread(g: Gaussians, most: float) -> Float[Tensor, "m 3"]:
    """The means and the points one standard deviation along each axis, which is held to `most`."""
    axes = matrix(g.quats) * g.scales.clamp(max=most)[:, None, :]
    return torch.cat([g.means, *(g.means + sign * axes[:, :, a] for a in range(3) for sign in (-1, 1))])


def _body(
    grid: ObjectVoxels,
    own: Gaussians,
    everything: Gaussians,
    number: int,
    sight: ObservedSpace,
    support: Support | None,
) -> np.ndarray:
    """Cells that are the object, seen or not."""
    occupied = grid.cells_of(_spread(own, 2 * grid.cell))
    centres = grid.centres()
    inside = torch.from_numpy(_hull_test(_standing(own, support), centres, 0.5 * grid.cell))
    if support is not None:
        inside &= support.heights(centres) > 0
    other = (everything.object_id != number) & (everything.opacities > 0.1)
    if support is not None:
        other &= (support.heights(everything.means) > support.tolerance) | (everything.object_id > 0)
    taken = grid.cells_of(everything.means[other])
    others = everything[(everything.object_id != number) & (everything.object_id > 0)]
    inside &= _nearer_to(own, others, centres, inside)
    body = inside.numpy().reshape(grid.shape)
    if sight.views:
        cells = torch.nonzero(inside)[:, 0]
        seen_through = torch.zeros(len(centres), dtype=torch.bool)
        seen_through[cells] = sight.empty(centres[cells], 1.5 * grid.cell)
        body = body & ~seen_through.numpy().reshape(grid.shape)
    else:  # nobody says what is empty: only what the object encloses is filled
        body = ndimage.binary_fill_holes(ndimage.binary_closing(occupied | _foot(occupied, body), iterations=2))
    body = ndimage.binary_opening(body & ~taken, iterations=1) | occupied
    parts, _ = ndimage.label(body)
    return np.isin(parts, np.unique(parts[occupied]))


def _nearer_to(own: Gaussians, others: Gaussians, points: Tensor, asked: Tensor) -> Tensor:
    """Of the points `asked` for, those nearer to the object than to any other."""
    low, high = points.amin(0), points.amax(0)
    others = others[((others.means > low) & (others.means < high)).all(1)]
    out = asked.clone()
    if len(others) and bool(asked.any()):
        out[asked] = knn(own.means, points[asked], 1)[0][:, 0] <= knn(others.means, points[asked], 1)[0][:, 0]
    return out


def _standing(own: Gaussians, support: Support | None) -> np.ndarray:
    """The object's points, and below its lowest part the points on the plane that it stands on.

    One that would tip over as seen must be held by what nobody saw: then below all of it.
    """
    points = own.means
    if support is not None:
        h = support.heights(points)
        low = h < max(3 * support.tolerance, 0.15 * float(h.max()))
        if float(h.min()) < 3 * support.tolerance:
            foot = points if topples(points[:, :2], points[low, :2]) else points[low]
            points = torch.cat([points, torch.cat([foot[:, :2], support.surface(foot)[:, None]], 1)])
    return points.double().numpy()


def _hull_test(points: np.ndarray, queries: Float[Tensor, "c 3"], margin: float) -> np.ndarray:
    """Whether queries lie in the convex hull of points, or within `margin` of it; none do if it has no volume."""
    try:
        hull = ConvexHull(points[:: max(1, len(points) // 20_000)]).equations.astype(np.float32)
    except (QhullError, ValueError):
        return np.zeros(len(queries), bool)
    out = [(part @ hull[:, :3].T + hull[:, 3]).max(1) < margin for part in np.array_split(queries.numpy(), 64)]
    return np.concatenate(out)


def _foot(occupied: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Cells below the lowest quarter of an object, down to the plane."""
    z = np.flatnonzero(occupied.any((0, 1)))
    top = z[0] + max(1, (z[-1] - z[0]) // 4) if len(z) else 0
    under = np.flip(np.logical_or.accumulate(np.flip(occupied, 2), 2), 2)  # something is above
    under[:, :, top:] = False
    return under & inside


def _open_surface(grid: ObjectVoxels, body: np.ndarray, own: Gaussians) -> tuple[Tensor, Tensor]:
    """Points and outward normals on the body's surface where the object has no Gaussians yet."""
    soft = ndimage.gaussian_filter(body.astype(np.float32), 1.0)
    skin = body & ~ndimage.binary_erosion(body)
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


def _diffused(points: Float[Tensor, "m 3"], own: Gaussians, cell: float) -> Float[Tensor, "m 3"]:
    """Colours of the nearest seen Gaussians, spread smoothly over the new surface."""
    distance, index = knn(own.means, points, 16)
    weight = own.opacities[index] / (distance + 0.5 * cell).square()
    rgb = (own.sh[:, 0] * C0 + 0.5).clamp(0, 1)[index]
    rgb = (rgb * weight[..., None]).sum(1) / weight.sum(1, keepdim=True).clamp_min(1e-12)
    _, near = knn(points, points, 9)
    edge = distance[:, :1] < 2 * cell  # next to the seen surface: held, so that there is no seam
    for _ in range(20):
        rgb = torch.where(edge, rgb, rgb[near].mean(1))
    return rgb
