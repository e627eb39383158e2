"""The surface of an object's filled body, finer than its voxels.

Samples are the object's Gaussians within a voxel of the surface of the voxels, with normals from the smoothed voxels,
and faces of voxels where there are none, as at undersides. The signed distance is the mean of those to the tangent
planes of the nearest samples, where its projection on the nearest one's is near that sample. Source: Hoppe et al. 1992,
"Surface reconstruction from unorganized points".
"""

from __future__ import annotations

import copy
from functools import cached_property

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from stages.core.physics.morphology import surrounded
from stages.core.physics.particles import filled_voxels, inliers, usable_means
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

VOXELS_ALONG = 48  # voxels along the longest side of an object
MOST_ALONG = 96  # of one that is larger than the others, so that it is as accurate as these where it touches them
BARE = 3.0  # distance to the samples beyond which faces of voxels are added [voxels], which are a third of the spacing
NEAREST = 8  # samples that give a distance, of which those count
SAME_FACE = 0.8  # whose normals have at least this cosine to that of the nearest one
NEIGHBOURS = 16  # samples to which a tangent plane is fitted, of which those on the same face count
MIN_ON_FACE = 6  # samples on the same face below which the normal is kept
STEPS = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])


class SolidSurface:
    """Voxels, samples and signed distance of an object's body, in scene units."""

    def __init__(self, voxels: np.ndarray, h: float, points: np.ndarray):
        """`voxels` (m, 3) are centres of edge h; `points` (n, 3) are about on the surface."""
        self.voxels, self.h, self.seen = voxels, h, points
        cells = np.floor(voxels / h).astype(np.int64)
        self._low = cells.min(0) - 2
        full = np.zeros(cells.max(0) - self._low + 3, bool)
        full[tuple((cells - self._low).T)] = True
        self._full = full
        inside, outside = (ndimage.distance_transform_edt(part) - 0.5 for part in (full, ~full))
        self._depth = h * np.where(full, inside, -outside)  # to the faces of the voxels
        near = points[np.abs(self._coarse_depth(points)) <= h]
        smooth = ndimage.gaussian_filter(full.astype(np.float32), 1.0)
        normals = -np.stack([self._at(slope, near) for slope in np.gradient(smooth)], 1)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        near, normals = near[length[:, 0] > 1e-3], (normals / length.clip(1e-3))[length[:, 0] > 1e-3]
        open_ = np.stack([~full[tuple((cells - self._low + step).T)] for step in STEPS], 1)
        row, side = np.nonzero(open_)
        faces, outward = voxels[row] + h / 2 * STEPS[side], STEPS[side].astype(float)
        if len(near):
            bare = cKDTree(near).query(faces, distance_upper_bound=BARE * h)[0] == np.inf
            faces, outward = faces[bare], outward[bare]
        self.points, self.normals = np.concatenate([near, faces]), np.concatenate([normals, outward])
        self._tree = cKDTree(self.points)
        apart = self._tree.query(self.points[:: -(-len(self.points) // 2000)], 2)[0][:, 1]
        self.spacing = max(h, float(np.median(apart)))  # of samples, within which a tangent plane is known to continue

    @cached_property
    def fitted(self) -> SolidSurface:
        """The same with the planes that fit the neighbours of each sample on the same face.

        At a flat face of exact samples the normals are then .2 degrees off, instead of 4 with the normals of voxels.
        """
        out = copy.copy(self)
        vars(out).pop("_depth_grid", None)  # of the other samples
        row = np.minimum(self._tree.query(self.points, NEIGHBOURS)[1], len(self.points) - 1)
        weight = ((self.normals[row] * self.normals[:, None]).sum(-1) > SAME_FACE).astype(float)
        middle = (weight[..., None] * self.points[row]).sum(1) / weight.sum(1, keepdims=True)
        arm = (self.points[row] - middle[:, None]) * weight[..., None]
        normals = np.linalg.eigh(np.einsum("nka,nkb->nab", arm, arm))[1][:, :, 0]
        normals *= np.where((normals * self.normals).sum(1, keepdims=True) < 0, -1, 1)
        good = ((weight.sum(1) >= MIN_ON_FACE) & ((normals * self.normals).sum(1) > SAME_FACE))[:, None]
        moved = self.points + ((middle - self.points) * normals).sum(1, keepdims=True) * normals
        out.points, out.normals = np.where(good, moved, self.points), np.where(good, normals, self.normals)
        out._tree = cKDTree(out.points)
        return out

    def depth(self, x: np.ndarray) -> np.ndarray:
        """Depths (k,) of points (k, 3) below the surface, negative outside."""
        out = self._coarse_depth(x)
        close = np.flatnonzero(np.abs(out) < 2 * self.h)
        out[close] = self._fine_depth(x[close], out[close])
        return out

    def _fine_depth(self, x: np.ndarray, coarse: np.ndarray) -> np.ndarray:
        """Depths (k,) of points (k, 3) for which samples are looked up, from their depths in the voxels."""
        out = coarse.copy()
        distance, row = self._tree.query(x, distance_upper_bound=2 * self.h)
        close = np.flatnonzero(distance < np.inf)
        row = row[close]
        height = ((self.points[row] - x[close]) * self.normals[row]).sum(1)
        beside = distance[close] ** 2 - height**2  # squared distance of its projection to the nearest sample
        known = close[beside < self.spacing**2]
        if len(known):
            x, coarse = x[known], coarse[known]
            row = np.minimum(self._tree.query(x, NEAREST)[1], len(self.points) - 1)
            normals = self.normals[row]
            agree = (normals * normals[:, :1]).sum(-1) > SAME_FACE
            each = ((self.points[row] - x[:, None]) * normals).sum(-1)
            out[known] = ((each * agree).sum(1) / agree.sum(1)).clip(coarse - self.h, coarse + self.h)
        return out

    def deeper_than(self, depth: float) -> np.ndarray:
        """Centres (k, 3) of the voxels at more than this depth."""
        return self.voxels[self._coarse_depth(self.voxels) > depth]

    def body_voxels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres (m, 3) of the voxels in and around the body, their depths (m,), and which (m,) make up the body.

        Those are the ones inside, and in sheets thinner than a voxel those of the coarse body.
        """
        near = surrounded(self._full)
        x = (np.argwhere(near) + self._low + 0.5) * self.h
        depth = self._depth_grid[near]
        inside = near & (self._depth_grid >= 0)
        inside |= self._full & ~surrounded(inside)
        return x, depth, inside[near]

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (s, 3) on the surface, one in each voxel that has any, and normals (s, 3), outwards."""
        cells = np.floor(self.points / self.h).astype(np.int64) - self._low
        _, first = np.unique(np.ravel_multi_index(tuple(cells.T), self._full.shape), return_index=True)
        points, normals = self.points[first], self.normals[first]
        return points + self.depth(points)[:, None] * normals, normals

    def depth_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Depths (x, y, z) below the surface at the centres of voxels in and around the body; the first centre."""
        return self._depth_grid, (self._low + 0.5) * self.h

    @cached_property
    def _depth_grid(self) -> np.ndarray:
        out = self._depth.copy()
        close = np.abs(out) < 2 * self.h
        out[close] = self._fine_depth((np.argwhere(close) + self._low + 0.5) * self.h, out[close])
        return out

    def _coarse_depth(self, x: np.ndarray) -> np.ndarray:
        return self._at(self._depth, x)

    def _at(self, grid: np.ndarray, x: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(grid, (x / self.h - self._low - 0.5).T, order=1, mode="nearest")


@cached_in_scene
def solid_surface(scene: Scene, object_id: int, seed: int = 0) -> SolidSurface:
    """The surface of an object. Raises InputError for one without any usable Gaussian."""
    voxels, h = filled_voxels(scene, object_id, _voxels_along(scene, object_id), seed)
    means = usable_means(scene, object_id)
    means = means[inliers(means)] if len(means) else means
    return SolidSurface(voxels.double().numpy(), h, means.double().numpy())


def _voxels_along(scene: Scene, object_id: int) -> int:
    """Number of voxels along an object: more where it is larger than the others and its Gaussians are as dense."""
    own, sizes = _means(scene, object_id), _sizes(scene)
    some = own[:: -(-max(len(own), 1) // 2000)]
    spacing = float(np.median(cKDTree(own).query(some, 2)[0][:, 1])) if len(own) > 1 else np.inf
    most = min(MOST_ALONG, sizes[object_id] / max(spacing, 1e-12))
    ratio = sizes[object_id] / float(np.median(list(sizes.values())))
    return round(max(VOXELS_ALONG, min(VOXELS_ALONG * ratio, most)))


@cached_in_scene
def _sizes(scene: Scene) -> dict[int, float]:
    """Longest side of each object without outliers, by its id."""
    sizes = {}
    for o in scene.objects:
        means = _means(scene, o.id)
        ends = np.quantile(means, [0.99, 0.01], axis=0) if len(means) else np.zeros((2, 3))
        sizes[o.id] = max(float((ends[0] - ends[1]).max()), 1e-12)
    return sizes


def _means(scene: Scene, object_id: int) -> np.ndarray:
    """Centres of an object's Gaussians (n, 3) that are finite."""
    x = scene.gaussians.means[scene.gaussians.object_id == object_id].cpu().double().numpy()
    return x[np.isfinite(x).all(1)]
