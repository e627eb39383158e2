"""Convex parts of an object, for rigid-body collision, and its volume, centre of mass and inertia.

An object that fills its convex hull is one part. Others are divided by CoACD, from the surface of their filled voxels;
the vertices of the parts are then moved from the voxels onto the points of the surface. Lengths are in the unit of the
Gaussians.
Source: Wei et al. 2022, "Approximate convex decomposition for 3D meshes with collision-aware concavity".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor

from stages.core.physics.keypoints import farthest_points
from stages.core.physics.particles import filled_voxels, inliers, usable
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

VOXELS_ALONG = 32  # voxels along the longest side of an object
CONVEX = 0.9  # fraction of its hull that a convex object fills: voxels are accurate to about 5 %
MAX_CONCAVITY = 0.1  # of a part, relative to the size of the object; a voxel is 0.03
SMOOTHING = 10, (0.5, -0.53)  # rounds and factors of Taubin 1995, "A signal processing approach to fair surface design"
# tree search shorter than by default, which takes minutes; vertices are replaced by those of the surface
SEARCH = {"mcts_iterations": 30, "mcts_nodes": 10, "mcts_max_depth": 2, "resolution": 500, "max_ch_vertex": 64}
MAX_VERTICES = 200  # of a part: a ball is round to 1 %


@dataclass(frozen=True)
class ConvexParts:
    """Convex parts of an object and the properties of its filled body at density 1."""

    hulls: tuple[Float[Tensor, "_ 3"], ...]  # vertices
    volume: float
    com: Float[Tensor, "3"]
    inertia: Float[Tensor, "3 3"]  # about the centre of mass [unit^5]


@cached_in_scene
def convex_parts(scene: Scene, object_id: int, seed: int = 0) -> ConvexParts:
    """Divide an object into convex parts.

    Raises InputError for an object without any usable Gaussian.
    """
    voxels, h = filled_voxels(scene, object_id, VOXELS_ALONG, seed)
    g = scene.gaussians.to("cpu")[(scene.gaussians.object_id == object_id).cpu()]
    surface = g.means[usable(g)]
    surface = (surface[inliers(surface)] if len(surface) else voxels).double().numpy()
    volume = len(voxels) * h**3
    whole = _hull(surface)
    if whole is not None and whole.volume * CONVEX < volume:
        volume, com, inertia = _solid_moments(whole)
        return ConvexParts((_vertices(whole, seed),), volume, com, inertia)
    parts = [_on_surface(part, surface, h) for part in _decompose(voxels, h, seed)]
    x = voxels.double()
    com = x.mean(0)
    r = x - com
    eye = torch.eye(3, dtype=torch.float64)
    inertia = volume * ((r.square().sum(1).mean() + h**2 / 6) * eye - r.mT @ r / len(r))
    return ConvexParts(tuple(_vertices(part, seed) for part in parts), volume, com.float(), inertia.float())


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


def _on_surface(part: np.ndarray, surface: np.ndarray, h: float) -> ConvexHull:
    """Hull of a part with the points of the surface near it in place of those of its vertices that are near them."""
    hull = ConvexHull(part)
    outside = (surface @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
    near = surface[outside < h]
    if not len(near):
        return hull
    away = cKDTree(near).query(part)[0] > 2 * h
    moved = _hull(np.concatenate([near, part[away]]))
    return moved if moved is not None and moved.volume > hull.volume / 2 else hull


def _decompose(voxels: Float[Tensor, "m 3"], h: float, seed: int) -> list[np.ndarray]:
    """Vertices (v, 3) of convex parts of the body of these voxels."""
    import coacd  # noqa: PLC0415 -- only hollow and branched objects need it

    coacd.set_log_level("off")
    vertices, triangles = voxel_surface(torch.floor(voxels / h).long())
    parts = coacd.run_coacd(
        coacd.Mesh(h * _smooth(vertices, triangles), triangles.numpy()), threshold=MAX_CONCAVITY, seed=seed,
        preprocess_mode="off", **SEARCH,
    )  # fmt: skip
    return [np.asarray(v) for v, _ in parts]


def _smooth(vertices: Int[Tensor, "v 3"], triangles: Int[Tensor, "t 3"]) -> np.ndarray:
    """The vertices without the steps of the voxels, in which CoACD would see concavities."""
    x, t, count = vertices.double().numpy(), triangles.numpy(), len(vertices)
    edges = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    joined = coo_matrix((np.ones(len(edges)), edges.T), (count, count)).tocsr()
    joined = ((joined + joined.T) > 0).astype(float)
    degree = np.asarray(joined.sum(1)).reshape(-1, 1)
    rounds, factors = SMOOTHING
    for factor in rounds * factors:
        x = x + factor * ((joined @ x) / degree - x)
    return x


def voxel_surface(cells: Int[Tensor, "m 3"]) -> tuple[Int[Tensor, "v 3"], Int[Tensor, "t 3"]]:
    """Corners and triangles, counter-clockwise from outside, of the surface of the unit voxels at these cells."""
    low = cells.amin(0) - 1
    shape = (cells.amax(0) - low + 2).tolist()
    full = torch.zeros(shape, dtype=torch.bool)
    full[tuple((cells - low).T)] = True
    quads = []
    for axis in range(3):
        u, v = torch.eye(3, dtype=torch.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        for side in (1, 0):  # faces towards larger and smaller coordinates
            at = (full & ~full.roll(1 - 2 * side, axis)).nonzero()
            corner = at + side * torch.eye(3, dtype=torch.int64)[axis]
            ring = torch.stack([corner, corner + u, corner + u + v, corner + v], 1)
            quads.append(ring if side else ring.flip(1))
    corners, index = torch.cat(quads).reshape(-1, 3).unique(dim=0, return_inverse=True)
    a, b, c, d = index.reshape(-1, 4).T
    return corners + low, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)]).int()
