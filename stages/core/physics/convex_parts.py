"""Convex parts of an object, for rigid-body collision, and its volume, centre of mass and inertia.

A round object is a ball (`ball_fit.py`). Of the others, one that fills its convex hull is one part, and the filled
voxels of the rest are divided by planes (`convex_cuts.py`). The hulls are then those of the points of the surface
(`solid_surface.py`) at each part's voxels, with their faces moved to the mean level of the surface under them. Lengths
are in the unit of the Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor

from stages.core.kernels.threads import parallel_map
from stages.core.physics.ball_fit import DENT, Ball, fitted_ball
from stages.core.physics.convex_cuts import EXTREMES, divide, extreme_rows
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.solid_surface import solid_surface
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

FACING = 0.5  # least cosine between the normal of a surface and that of the face of a hull over it
CONVEX = 0.9  # fraction of its hull that a convex object fills: voxels are accurate to about 5 %
MAX_VERTICES = 200  # of a part: a cylinder or egg is round to 1 %
CORNERS = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3)


Moments = tuple[float, Float[Tensor, "3"], Float[Tensor, "3 3"]]  # volume, centre, inertia about it at density 1


@dataclass(frozen=True)
class Solid:
    """The filled body of an object."""

    voxels: np.ndarray  # (m, 3), centres
    depth: np.ndarray  # (m,), below the surface
    h: float  # edge of a voxel
    surface: np.ndarray  # (n, 3), points on it
    normals: np.ndarray  # (n, 3), outwards
    seen: np.ndarray  # (k, 3), centres of its Gaussians
    moments: Moments


@dataclass(frozen=True)
class ConvexParts:
    """Convex parts of an object and the properties of its filled body at density 1."""

    hulls: tuple[Float[Tensor, "_ 3"], ...]  # vertices
    volume: float
    com: Float[Tensor, "3"]
    inertia: Float[Tensor, "3 3"]  # about the centre of mass [unit^5]
    ball: Ball | None = None  # that a round object is; `hulls` are then its points in EXTREMES


@cached_in_scene
def convex_parts(scene: Scene, seed: int = 0, bottom: float = -np.inf) -> list[ConvexParts]:
    """Divide each object into convex parts, in the order of scene.objects.

    What lies below the height `bottom` is cut off. Raises InputError for an object without
    any usable Gaussian.
    """
    solids, out = _solids(scene, seed, bottom), []
    # on one thread: small arrays, during which Python holds its lock
    for row, (solid, ball) in enumerate(zip(solids, balls(scene, seed, bottom), strict=True)):
        out.append(_parts(solid, _around(solids, row, solid.h), seed) if ball is None else _ball_parts(ball))
    return out


@cached_in_scene
def balls(scene: Scene, seed: int = 0, bottom: float = -np.inf) -> list[Ball | None]:
    """The balls among the objects, in the order of scene.objects; arguments and errors as those of `convex_parts`."""
    solids, out = _solids(scene, seed, bottom), []
    for row, solid in enumerate(solids):
        ball = fitted_ball(solid.surface, bottom, all_seen=scene.cameras is None)
        clear = ball is not None and ball.clear_of(_around(solids, row, DENT * ball.radius))
        out.append(ball if clear else None)
    return out


@cached_in_scene
def convex_hulls(scene: Scene, seed: int = 0, bottom: float = -np.inf) -> list[ConvexHull | None]:
    """The hulls of the objects that fill them, in the order of scene.objects; arguments as those of `convex_parts`.

    Of the points in EXTREMES: hulls of all points of round objects have a face for every few Gaussians.
    """
    return [_filled_hull(solid, _extreme(solid.seen)) for solid in _solids(scene, seed, bottom)]


@cached_in_scene
def _solids(scene: Scene, seed: int, bottom: float) -> list[Solid]:
    return parallel_map(lambda id: _solid(scene, id, seed, bottom), [o.id for o in scene.objects])


def _solid(scene: Scene, object_id: int, seed: int, bottom: float) -> Solid:
    body = solid_surface(scene, object_id, seed)
    voxels, depth, inside, share = body.body_voxels()
    kept = voxels[:, 2] > min(bottom, float(voxels[inside, 2].max()) - body.h)
    inside = inside[kept]
    seen, surface = (np.column_stack([p[:, :2], p[:, 2].clip(min=bottom)]) for p in (body.seen, body.points))
    voxels, depth = voxels[kept], depth[kept]
    moments = _voxel_moments(voxels, share[kept], body.h)
    return Solid(voxels[inside], depth[inside], body.h, surface, body.normals, seen if len(seen) else voxels, moments)


def _around(solids: list[Solid], row: int, margin: float) -> np.ndarray:
    """Centres (n, 3) of the voxels of the other solids up to a margin outside the bounds of one of them, and not in or
    next to it.
    """
    own = solids[row]
    low, high = own.voxels.min(0) - margin, own.voxels.max(0) + margin
    near = [s.voxels[((s.voxels > low) & (s.voxels < high)).all(1)] for k, s in enumerate(solids) if k != row]
    others = np.concatenate([np.empty((0, 3)), *near])
    return others[cKDTree(own.voxels).query(others, distance_upper_bound=own.h)[0] == np.inf]


def _ball_parts(ball: Ball) -> ConvexParts:
    volume, centre = 4 / 3 * np.pi * ball.radius**3, torch.from_numpy(ball.centre).float()
    hull = centre + ball.radius * torch.from_numpy(EXTREMES)
    return ConvexParts((hull,), volume, centre, 0.4 * volume * ball.radius**2 * torch.eye(3), ball)


def _parts(solid: Solid, others: np.ndarray, seed: int) -> ConvexParts:
    whole = _filled_hull(solid, solid.seen)
    if whole is not None:
        return ConvexParts((_vertices(whole, seed),), *_solid_moments(whole))
    hulls = _hulls(solid, divide(solid.voxels / solid.h, others / solid.h))
    return ConvexParts(tuple(_vertices(hull, seed) for hull in hulls), *solid.moments)


def _filled_hull(solid: Solid, points: np.ndarray) -> ConvexHull | None:
    """The convex hull of its points, if it fills that."""
    hull = _hull(points)
    return hull if hull is not None and hull.volume * CONVEX < solid.moments[0] else None


def _voxel_moments(voxels: np.ndarray, share: np.ndarray, h: float) -> Moments:
    """Those of voxels (m, 3) of edge h of which a share (m,) is filled."""
    x, w = torch.from_numpy(voxels), torch.from_numpy(share / share.sum())
    com = w @ x
    r = x - com
    volume = float(share.sum()) * h**3
    second = (w[:, None] * r).mT @ r + h**2 / 12 * torch.eye(3, dtype=torch.float64)
    return volume, com.float(), (volume * (second.trace() * torch.eye(3, dtype=torch.float64) - second)).float()


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


def _solid_moments(hull: ConvexHull) -> Moments:
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
    sample, voxel = _close(surface / h, voxels / h)
    bare = np.ones(len(voxels), bool)
    bare[voxel] = False
    at = np.zeros((part.max() + 1, len(surface)), bool)
    at[part[voxel], sample] = True
    deep = solid.depth > h * 3**0.5 / 2  # corners of the voxel are inside
    hulls = []
    for k, near in enumerate(at):
        own = surface[near]
        mine = part == k
        inner = _corners(_extreme(voxels[deep & mine]), h), voxels[bare & mine]
        hull = _hull(_extreme(np.concatenate([own, *inner])))
        if hull is None:
            hulls.append(ConvexHull(_corners(voxels[part == k], h)))
        else:
            hulls.append(_balanced(hull, own, solid.normals[near], h) if len(own) else hull)
    return hulls


def _close(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points (n, 3) and of unit voxels at cells (m, 3) that are less than 1 from each other."""
    low = cells.min(0) - 1
    index = np.rint(cells - low).astype(np.int64)
    row = np.full(index.max(0) + 2, -1)
    row[tuple(index.T)] = np.arange(len(cells))
    x = points - low
    first = np.floor(x).astype(np.int64).clip(0, np.array(row.shape) - 2)
    pairs = []
    for corner in np.ndindex(2, 2, 2):
        at = first + corner
        voxel = row[tuple(at.T)]
        near = np.flatnonzero((voxel >= 0) & (((x - at) ** 2).sum(1) < 1))
        pairs.append((near, voxel[near]))
    point, voxel = (np.concatenate(each) for each in zip(*pairs, strict=True))
    return point, voxel


def _extreme(points: np.ndarray) -> np.ndarray:
    """The points that are extreme in one of EXTREMES."""
    return points[extreme_rows(points)] if len(points) > len(EXTREMES) else points


def _balanced(hull: ConvexHull, surface: np.ndarray, normals: np.ndarray, h: float) -> ConvexHull:
    """The hull with each face moved inwards to the mean depth of the surface under it, by at most h.

    A convex part bridges the hollows of a surface. So it is as often above as below it, and its squared error is least.
    """
    normal, offset = hull.equations[:, :3], hull.equations[:, 3]
    depth = -(surface @ normal.T + offset)
    depth[normals @ normal.T < FACING] = np.inf
    face, depth = depth.argmin(1), depth.min(1)
    face, depth = face[depth < np.inf], depth[depth < np.inf]
    count = np.bincount(face, minlength=len(normal))
    shift = np.bincount(face, depth, len(normal)) / count.clip(1)
    shift = shift.clip(0, h)
    # each vertex moves so that its faces do: least squares, weighted by their area
    t = hull.points[hull.simplices]
    area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)
    M, r = np.zeros((len(hull.points), 3, 3)), np.zeros((len(hull.points), 3))
    for corner in hull.simplices.T:
        np.add.at(M, corner, area[:, None, None] * normal[:, :, None] * normal[:, None, :])
        np.add.at(r, corner, (area * shift)[:, None] * normal)
    M, r = M[hull.vertices], r[hull.vertices]
    M += 0.01 * np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    moved = hull.points[hull.vertices] - np.linalg.solve(M, r[..., None])[..., 0]
    return _hull(moved.clip(hull.min_bound, hull.max_bound)) or hull  # nothing below a floor


def _corners(voxels: np.ndarray, h: float) -> np.ndarray:
    """Corners (8 m, 3) of voxels (m, 3) of edge h."""
    return (voxels[:, None] + h * CORNERS).reshape(-1, 3)
