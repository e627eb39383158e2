"""Signed distance to the surface of an object's filled body, with sub-voxel accuracy.

The surface is represented by samples with normals: the object's Gaussians within one voxel of the voxel surface, with
normals from the gradient of the smoothed occupancy, and voxel faces where there are no Gaussians, as on undersides. The
signed distance of a point is the mean of its signed distances to the tangent planes of the nearest samples, if its
projection onto the nearest tangent plane lies close to that sample; elsewhere it is the distance to the voxel surface.
Source: Hoppe et al. 1992, "Surface reconstruction from unorganized points".
"""

from __future__ import annotations

import copy

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from stages.core.geometry.symmetric_matrices import PAIRS, least_directions
from stages.core.physics.morphology import surrounded
from stages.core.physics.particles import connected, filled_voxels, usable_means
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

VOXELS_ALONG = 48  # number of voxels along the side of a cube-shaped object
MIN_SLOPE = 0.12  # minimum occupancy gradient that defines a normal [1/voxel]; .4 at the face of a thick body
SLENDER = 16  # ratio of longest to shortest side above which voxels get no smaller
MOST_ALONG = 96  # maximum voxels along an object larger than the others: its accuracy matches theirs at contacts
BARE = 3.0  # distance from the nearest Gaussian above which a voxel face is a sample [voxels, at least 1/3 spacing]
NEAREST = 8  # nearest samples whose tangent planes are averaged for a distance
SAME_FACE = 0.8  # minimum cosine between the normals of two samples on the same face
NEIGHBOURS = 16  # nearest samples to which a tangent plane is fitted
MIN_ON_FACE = 6  # neighbours of similar normal below which a plane fit starts from all that face the same way
FITS = 4  # iterations of the reweighted plane fit
FLATNESS = 0.1  # lower bound of the residual scale in the plane fit's weights [sample spacing]
AT_EDGE = 0.2  # RMS distance of the neighbours from a sample's plane above which the sample is at an edge [spacing]
FLATTER = 0.5  # a sample at an edge takes a neighbour's plane whose RMS distance is below this fraction of its own
ON_PLANE = 0.2  # largest distance of a sample at an edge from the neighbour's plane that it takes [sample spacing]
ON_CUT = 0.25  # distance from the cut plane up to which samples count as lying on it [voxels]
OCTANTS = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
STEPS = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])


class SolidSurface:
    """Voxels, samples and signed distance of an object's body, in scene units."""

    def __init__(self, voxels: np.ndarray, h: float, points: np.ndarray):
        """`voxels` (m, 3) are the centres of voxels of edge `h`; `points` (n, 3) lie approximately on the surface."""
        self.voxels, self.h, self.seen = voxels, h, points
        # computed lazily; `cached_property` of Python 3.11 and older has one lock for all instances
        self._fitted: SolidSurface | None = None
        self._fine_grid: np.ndarray | None = None
        self._first = voxels.min(0) - 2 * h  # centre of the first voxel of the grid
        cells = self._cells(voxels)
        full = np.zeros(cells.max(0) + 3, bool)
        full[tuple(cells.T)] = True
        self._full = full
        inside, outside = (ndimage.distance_transform_edt(part) - 0.5 for part in (full, ~full))
        self._depth = h * np.where(full, inside, -outside)  # below the voxel faces
        near = points[np.abs(self._coarse_depth(points)) <= h]
        smooth = ndimage.gaussian_filter(full.astype(np.float32), 1.0)
        normals = -np.stack([self._at(slope, near) for slope in np.gradient(smooth)], 1)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        clear = length[:, 0] > MIN_SLOPE
        near, normals = near[clear], normals[clear] / length[clear]
        open_ = np.stack([~full[tuple((cells + step).T)] for step in STEPS], 1)
        row, side = np.nonzero(open_)
        faces, outward = voxels[row] + h / 2 * STEPS[side], STEPS[side].astype(float)
        if len(near):
            bare = cKDTree(near).query(faces, distance_upper_bound=BARE * h)[0] == np.inf
            faces, outward = faces[bare], outward[bare]
        self.points, self.normals = np.concatenate([near, faces]), np.concatenate([normals, outward])
        self._tree = cKDTree(self.points)
        apart = self._tree.query(self.points[:: -(-len(self.points) // 2000)], 2)[0][:, 1]
        self.spacing = max(h, float(np.median(apart)))  # of the samples; tangent planes are trusted up to this distance

    @property
    def fitted(self) -> SolidSurface:
        """The surface with one sample per voxel, moved onto a plane fitted to the neighbouring samples on its face.

        Iteratively reweighted least squares makes the plane of a sample at an edge fit one of the faces.
        """
        if self._fitted is None:
            self._fitted = self._fit()
        return self._fitted

    def _fit(self) -> SolidSurface:
        out = copy.copy(self)
        out._fine_grid = None  # it was computed from the original samples
        chosen = self.thinned()
        points, outward = self.points[chosen], self.normals[chosen]
        distance, row = self._tree.query(points, NEIGHBOURS + 1)
        distance, row = distance[:, :-1] / distance[:, -1:], np.minimum(row[:, :-1], len(self.points) - 1)
        along = (self.normals[row] * outward[:, None]).sum(-1)
        near = np.where(along > 0, (1 - distance**2).clip(1e-9), 0.0)  # falls to 0 at the first sample left out
        same_face = along > SAME_FACE
        weight = np.where((same_face.sum(1) >= MIN_ON_FACE)[:, None], near * same_face, near)
        around = self.points[row] - points[:, None]
        squares = around[..., PAIRS[0]] * around[..., PAIRS[1]]
        for _ in range(FITS):
            middle, normals = _planes(around, squares, weight)
            height = (around @ normals[..., None])[..., 0] - (middle * normals).sum(1, keepdims=True)
            spread = np.sqrt((weight * height**2).sum(1) / weight.sum(1)).clip(FLATNESS * self.spacing)
            weight = near * np.exp(-((height / spread[:, None]) ** 2))
        normals *= np.where((normals * outward).sum(1, keepdims=True) < 0, -1, 1)
        bent = np.sqrt((near * height**2).sum(1) / near.sum(1)) / self.spacing
        middle += points
        face = _face_beside(points, middle, normals, outward, bent, self.spacing)
        middle, normals = middle[face], normals[face]
        out.points = points + ((middle - points) * normals).sum(1, keepdims=True) * normals
        out.normals = normals
        out._tree = cKDTree(out.points)
        return out

    def depth(self, x: np.ndarray) -> np.ndarray:
        """Depth (k,) of points (k, 3) below the surface [scene units], negative outside."""
        out = self._coarse_depth(x)
        close = np.flatnonzero(np.abs(out) < 2 * self.h)
        out[close] = self._fine_depth(x[close], out[close])
        return out

    def _fine_depth(self, x: np.ndarray, coarse: np.ndarray) -> np.ndarray:
        """Depth (k,) of points (k, 3) by tangent planes, or their voxel depth `coarse` (k,) where none applies."""
        out = coarse.copy()
        distance, row = self._tree.query(x, distance_upper_bound=2 * self.h)
        close = np.flatnonzero(distance < np.inf)
        row = row[close]
        height = ((self.points[row] - x[close]) * self.normals[row]).sum(1)
        beside = distance[close] ** 2 - height**2  # squared distance of the projection from the nearest sample
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
        """Centres (k, 3) of the voxels deeper than `depth` [scene units]."""
        return self.voxels[self._coarse_depth(self.voxels) > depth]

    def body_voxels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres (m, 3) of the voxels in and around the body, a mask (m,) of the body, and their filled fraction (m,).

        The body consists of the voxels whose centre is inside the surface, and of the original voxels of sheets thinner
        than a voxel.
        """
        near = surrounded(self._full)
        x = self._centres(near)
        grid, _ = self.depth_grid()
        depth = grid[near]
        inside = near & (grid >= 0)
        inside |= self._full & ~surrounded(inside)
        share = (depth > 0).astype(float)
        cut = np.flatnonzero(np.abs(depth) < self.h)
        octants = x[cut, None] + self.h / 4 * OCTANTS
        share[cut] = (2 * self._at(grid, octants.reshape(-1, 3)) / self.h + 0.5).clip(0, 1).reshape(-1, 8).mean(1)
        return x, inside[near], share

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (s, 3) on the surface, one in each voxel that contains samples, and outward normals (s, 3)."""
        rows = self.thinned()
        points, normals = self.points[rows], self.normals[rows]
        return points + self.depth(points)[:, None] * normals, normals

    def samples_above(self, bottom: float) -> tuple[np.ndarray, np.ndarray]:
        """The `samples` of the body cut off at the height `bottom`, with one per voxel on the face of the cut."""
        points, normals = self.samples()
        kept = points[:, 2] > bottom - ON_CUT * self.h
        points, normals = np.maximum(points[kept], [-np.inf, -np.inf, bottom]), normals[kept]
        x, y = (self._first[a] + self.h * np.arange(self._full.shape[a]) for a in (0, 1))
        face = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), bottom)], -1).reshape(-1, 3)
        face = face[self._ends_at(face)]
        replaced = (normals[:, 2] < -SAME_FACE) & (points[:, 2] < bottom + ON_CUT * self.h)
        replaced[replaced] = self._ends_at(points[replaced] * [1, 1, 0] + [0, 0, bottom])
        down = np.tile([0.0, 0.0, -1.0], (len(face), 1))
        return np.concatenate([points[~replaced], face]), np.concatenate([normals[~replaced], down])

    def _ends_at(self, x: np.ndarray) -> np.ndarray:
        """Whether (k,) the body reaches down to the cut plane at points (k, 3) on it, and does not end above."""
        depth, _ = self.depth_grid()
        return self._at(depth, x + [0, 0, self.h / 2]) > (0.5 - ON_CUT) * self.h

    def thinned(self) -> np.ndarray:
        """Rows (s,) of the first sample in each voxel that contains samples."""
        index = np.ravel_multi_index(tuple(self._cells(self.points).T), self._full.shape)
        return np.unique(index, return_index=True)[1]

    def depth_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Depth (x, y, z) below the surface at the centres of a grid of voxels, and the centre (3,) of the first."""
        if self._fine_grid is None:
            grid = self._depth.copy()
            close = np.abs(grid) < 2 * self.h
            grid[close] = self._fine_depth(self._centres(close), grid[close])
            self._fine_grid = grid
        return self._fine_grid, self._first

    def _coarse_depth(self, x: np.ndarray) -> np.ndarray:
        inside = x.clip(self._first, self._first + self.h * (np.array(self._full.shape) - 1))
        return self._at(self._depth, inside) - np.linalg.norm(x - inside, axis=1)

    def _at(self, grid: np.ndarray, x: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(grid, ((x - self._first) / self.h).T, order=1, mode="nearest")

    def _cells(self, x: np.ndarray) -> np.ndarray:
        """Indices (k, 3) of the voxels that contain points (k, 3)."""
        return np.floor((x - self._first) / self.h + 0.5).astype(np.int64)

    def _centres(self, mask: np.ndarray) -> np.ndarray:
        """Centres (k, 3) of the voxels selected by a mask of the grid."""
        return self._first + self.h * np.argwhere(mask)


def _face_beside(
    points: np.ndarray, middle: np.ndarray, normals: np.ndarray, outward: np.ndarray, bent: np.ndarray, spacing: float
) -> np.ndarray:
    """Rows (n,) of the planes, through `middle` (n, 3), that the samples at `points` (n, 3) take.

    A sample takes its own plane or, at an edge, that of a neighbour on a flat face, if the sample lies on that plane.
    `bent` (n,) is the RMS distance of the neighbours from a sample's plane [spacing].
    """
    row = np.minimum(cKDTree(points).query(points, NEIGHBOURS)[1], len(points) - 1)
    off = np.abs(((points[:, None] - middle[row]) * normals[row]).sum(-1)) / spacing
    fits = (bent[row] < FLATTER * bent[:, None]) & ((normals[row] * outward[:, None]).sum(-1) > 0) & (off < ON_PLANE)
    best = np.where(fits, off, np.inf).argmin(1)
    return np.where((bent > AT_EDGE) & fits.any(1), row[np.arange(len(row)), best], np.arange(len(row)))


def _planes(points: np.ndarray, squares: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane to each row of points (n, k, 3) with weights (n, k): a point (n, 3) on it and its normal (n, 3).

    The points are relative to a sample; `squares` (n, k, 6) are the products of their coordinates in PAIRS.
    """
    total = weight.sum(1, keepdims=True)
    middle, second = ((weight[:, None] @ x)[:, 0] / total for x in (points, squares))
    return middle, least_directions(second - middle[:, PAIRS[0]] * middle[:, PAIRS[1]])


@cached_in_scene
def solid_surface(scene: Scene, object_id: int, seed: int = 0) -> SolidSurface:
    """The surface of an object. Raises InputError if none of its Gaussians is usable."""
    voxels, h = filled_voxels(scene, object_id, _voxels_along(scene, object_id), seed)
    means = usable_means(scene, object_id)
    means = means[connected(means)] if len(means) else means
    return SolidSurface(voxels.numpy(), h, means.double().numpy())


def _voxels_along(scene: Scene, object_id: int) -> int:
    """Number of voxels along the longest side of an object, so that its bounding box has about VOXELS_ALONG^3.

    Flat or long objects, and those larger than the other objects, get more, if their Gaussians are dense enough.
    """
    own, sides = _means(scene, object_id), _sides(scene)
    some = own[:: -(-max(len(own), 1) // 2000)]
    spacing = float(np.median(cKDTree(own).query(some, 2)[0][:, 1])) if len(own) > 1 else np.inf
    longest = {i: s.max() for i, s in sides.items()}
    mine = longest[object_id]
    usual = VOXELS_ALONG * mine / sides[object_id].clip(mine / SLENDER).prod() ** (1 / 3)
    larger = min(VOXELS_ALONG * mine / float(np.median(list(longest.values()))), MOST_ALONG)
    return round(max(VOXELS_ALONG, min(max(usual, larger), mine / max(spacing, 1e-12))))


@cached_in_scene
def _sides(scene: Scene) -> dict[int, np.ndarray]:
    """Sides (3,) of the bounding box of each object (1 to 99 % quantiles), by object id."""
    sides = {}
    for o in scene.objects:
        means = _means(scene, o.id)
        ends = np.quantile(means, [0.99, 0.01], axis=0) if len(means) else np.zeros((2, 3))
        sides[o.id] = (ends[0] - ends[1]).clip(1e-12)
    return sides


def _means(scene: Scene, object_id: int) -> np.ndarray:
    """Finite centres (n, 3) of an object's Gaussians."""
    x = scene.gaussians.means[scene.gaussians.object_id == object_id].cpu().double().numpy()
    return x[np.isfinite(x).all(1)]
