"""Convex parts of an object, for rigid-body collision, and its volume, centre of mass and inertia.

An object that fills its convex hull is one part. The filled voxels of others are cut by planes, one part at a time: the
part whose hull has most empty space, along the plane after which the hulls of both sides together are smallest. Space
of other objects counts OTHERS times, so that parts of different objects overlap at the start only where the objects do.
The hulls are then those of each part's voxel centres and of the surface points at them. Lengths are in the unit of the
Gaussians.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor

from stages.core.physics.keypoints import farthest_points
from stages.core.physics.particles import filled_voxels, inliers, usable
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

VOXELS_ALONG = 48  # voxels along the longest side of an object
CONVEX = 0.9  # fraction of its hull that a convex object fills: voxels are accurate to about 5 %
MAX_PARTS = 24  # of an object
EMPTY, PART_EMPTY = 0.05, 0.1  # share of empty space in the hulls, of all parts together or of one, that is accepted
OTHERS = 10  # weight of the space in a hull that belongs to other objects, relative to empty space
MIN_VOXELS = 30  # of a part that is divided
CUTS = 7  # planes tried along each of six axes: those of the world, and the principal ones of the part
DIRECTIONS = 64  # in which a hull is measured; the hull of a ball in these has 91 % of its volume
MAX_VERTICES = 200  # of a part: a ball is round to 1 %
CORNERS = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3)


@dataclass(frozen=True)
class Solid:
    """The filled body of an object."""

    voxels: np.ndarray  # (m, 3), centres
    h: float  # edge of a voxel
    surface: np.ndarray  # (n, 3), points on it


@dataclass(frozen=True)
class ConvexParts:
    """Convex parts of an object and the properties of its filled body at density 1."""

    hulls: tuple[Float[Tensor, "_ 3"], ...]  # vertices
    volume: float
    com: Float[Tensor, "3"]
    inertia: Float[Tensor, "3 3"]  # about the centre of mass [unit^5]


@cached_in_scene
def convex_parts(scene: Scene, seed: int = 0, bottom: float = -np.inf) -> list[ConvexParts]:
    """Divide each object into convex parts, in the order of scene.objects.

    What lies below the height `bottom` is cut off. Raises InputError for an object without
    any usable Gaussian.
    """
    ids = [o.id for o in scene.objects]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        solids = list(pool.map(lambda id: _solid(scene, id, seed, bottom), ids))
        return list(pool.map(lambda row: _parts(solids[row], _around(solids, row), seed), range(len(solids))))


def _solid(scene: Scene, object_id: int, seed: int, bottom: float) -> Solid:
    voxels, h = filled_voxels(scene, object_id, VOXELS_ALONG, seed)
    voxels = voxels[voxels[:, 2] > min(bottom, float(voxels[:, 2].max()) - h)].double().numpy()
    g = scene.gaussians.to("cpu")[(scene.gaussians.object_id == object_id).cpu()]
    surface = g.means[usable(g)]
    surface = surface[inliers(surface)].double().numpy() if len(surface) else voxels.copy()
    surface[:, 2] = surface[:, 2].clip(min=bottom)
    return Solid(voxels, h, surface)


def _around(solids: list[Solid], row: int) -> np.ndarray:
    """Centres (n, 3) of the voxels of the other solids within the bounds of one of them and not in or next to it."""
    own = solids[row]
    low, high = own.voxels.min(0) - own.h, own.voxels.max(0) + own.h
    near = [s.voxels[((s.voxels > low) & (s.voxels < high)).all(1)] for k, s in enumerate(solids) if k != row]
    others = np.concatenate([np.empty((0, 3)), *near])
    return others[cKDTree(own.voxels).query(others, distance_upper_bound=own.h)[0] == np.inf]


def _parts(solid: Solid, others: np.ndarray, seed: int) -> ConvexParts:
    volume = len(solid.voxels) * solid.h**3
    whole = _hull(solid.surface)
    if whole is not None and whole.volume * CONVEX < volume:
        volume, com, inertia = _solid_moments(whole)
        return ConvexParts((_vertices(whole, seed),), volume, com, inertia)
    hulls = _hulls(solid, divide(solid.voxels / solid.h, others / solid.h))
    x = torch.from_numpy(solid.voxels)
    com = x.mean(0)
    r = x - com
    eye = torch.eye(3, dtype=torch.float64)
    inertia = volume * ((r.square().sum(1).mean() + solid.h**2 / 6) * eye - r.mT @ r / len(r))
    return ConvexParts(tuple(_vertices(hull, seed) for hull in hulls), volume, com.float(), inertia.float())


def _hull(points: np.ndarray) -> ConvexHull | None:
    """The convex hull; None where the points span no volume."""
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):
        return None


def _vertices(hull: ConvexHull, seed: int) -> Float[Tensor, "v 3"]:
    """At most MAX_VERTICES vertices of a hull, spread evenly."""
    corners = torch.from_numpy(hull.points[hull.vertices]).float()
    return corners[farthest_points(corners, MAX_VERTICES, seed)]


def _solid_moments(hull: ConvexHull) -> tuple[float, Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """Volume, centre of mass and inertia about it of a hull, by the tetrahedra from its middle to its triangles."""
    middle = hull.points[hull.vertices].mean(0)
    t = hull.points[hull.simplices] - middle  # (m, 3, 3): corners of each triangle
    volume = np.abs(np.linalg.det(t)) / 6
    total = volume.sum()
    com = (volume[:, None] * t.sum(1)).sum(0) / (4 * total)
    # integral of x x^T over a tetrahedron with one corner at the origin: V / 20 (sum of corners' x x^T + s s^T)
    s = t.sum(1)
    second = np.einsum("n,nci,ncj->ij", volume, t, t) + np.einsum("n,ni,nj->ij", volume, s, s)
    second = second / 20 - total * np.outer(com, com)
    inertia = np.trace(second) * np.eye(3) - second
    return float(total), torch.from_numpy(middle + com).float(), torch.from_numpy(inertia).float()


def _hulls(solid: Solid, part: np.ndarray) -> list[ConvexHull]:
    """The hull of each part: of the points of the surface at its voxels, and of its voxels that are away from these."""
    voxels, h, surface = solid.voxels, solid.h, solid.surface
    near = cKDTree(voxels).query(surface, 8, distance_upper_bound=h)[1]
    of = np.append(part, -1)[near]
    hulls = []
    for k in range(part.max() + 1):
        points = np.concatenate([surface[(of == k).any(1)], voxels[part == k]])
        hulls.append(_hull(points) or ConvexHull(_corners(voxels[part == k], h)))
    return hulls


def _corners(voxels: np.ndarray, h: float) -> np.ndarray:
    """Corners (8 m, 3) of voxels (m, 3) of edge h."""
    return (voxels[:, None] + h * CORNERS).reshape(-1, 3)


def divide(cells: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The part, from 0, of each of the unit voxels at cells (m, 3) of a body; `others` (n, 3) are points outside it."""
    part = np.zeros(len(cells), np.int64)
    cost = {0: _hull_cost(cells, others) - len(cells)}  # volume of a part's hull that the part does not fill
    while len(cost) < MAX_PARTS and sum(cost.values()) > EMPTY * len(cells):
        worst = max(cost, key=lambda k: cost[k])
        rows = np.flatnonzero(part == worst)
        if cost[worst] <= PART_EMPTY * len(rows):
            break
        side = _best_cut(cells[rows], others) if len(rows) >= MIN_VOXELS else None
        if side is None:
            cost[worst] = 0.0
            continue
        part[rows[side]] = other = len(cost)
        for k in (worst, other):
            own = cells[part == k]
            cost[k] = _hull_cost(own, others) - len(own)
    return part


def _hull_cost(cells: np.ndarray, others: np.ndarray) -> float:
    """Volume of the hull of a body of voxels, which lies about half way between those of their centres and corners,
    where the space of others counts OTHERS times.
    """
    extreme = cells[(cells @ SPREAD.T).argmax(0)]
    return _volume(extreme, 0.5) + OTHERS * _inside(extreme, others @ SPREAD.T)


def _inside(extreme: np.ndarray, along: np.ndarray) -> int:
    """How many points, given (n, d) along SPREAD, are inside the hull of the extreme voxels by half a voxel or more."""
    return int((along < (extreme * SPREAD).sum(1) - 0.5).all(1).sum())


def _volume(extreme: np.ndarray, edge: float = 1.0) -> float:
    """Volume of the hull of voxels of some edge of which these are the extreme ones in each direction of SPREAD."""
    hull = _hull(extreme + edge / 2 * np.sign(SPREAD))
    return 0.0 if hull is None else hull.volume


def _best_cut(cells: np.ndarray, others: np.ndarray) -> np.ndarray | None:
    """The side (m,) of each voxel of the plane after which the hulls of both sides are smallest; None without any."""
    smallest, best = np.inf, None
    along = cells @ SPREAD.T
    outside = others @ SPREAD.T
    outside = outside[(outside < along.max(0)).all(1)]
    for axis in np.concatenate([np.eye(3), np.linalg.eigh(np.cov(cells.T))[1].T]):
        x = cells @ axis
        slab = np.searchsorted(np.linspace(x.min(), x.max(), CUTS + 2)[1:-1], x)
        slabs = [np.flatnonzero(slab == k) for k in range(CUTS + 1)]
        extreme = [rows[along[rows].argmax(0)] if len(rows) else None for rows in slabs]
        below, above = _accumulated(along, extreme), _accumulated(along, extreme[::-1])[::-1]
        for k in range(CUTS):
            if below[k] is not None and above[k + 1] is not None:
                volume = sum(_volume(e) + OTHERS * _inside(e, outside) for e in (cells[below[k]], cells[above[k + 1]]))
                if volume < smallest:
                    smallest, best = volume, slab <= k
    return best


def _accumulated(along: np.ndarray, extreme: list[np.ndarray | None]) -> list[np.ndarray | None]:
    """The extreme voxels in each direction of the first slab, of the first two, and so on."""
    out, now = [], None
    for rows in extreme:
        if now is None or rows is None:
            now = rows if now is None else now
        else:
            direction = np.arange(along.shape[1])
            now = np.where(along[rows, direction] > along[now, direction], rows, now)
        out.append(now)
    return out


def _fibonacci(count: int) -> np.ndarray:
    """Unit vectors (count, 3), spread evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


SPREAD = _fibonacci(DIRECTIONS)
