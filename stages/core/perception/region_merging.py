"""Hierarchical segmentation of surface voxels: oversegmentation into regions, then pairwise merging into objects.

The merge criterion (`RegionMerger.separation`) has hand-set weights; a learned affinity is meant to replace it.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

TEXTURE_CONTRAST = 9.0  # colour difference of neighbouring voxels up to which it counts as texture [CIELAB]
MAX_SAMPLE_POINTS = 150  # maximum number of points of a region that are tested against convex hulls


@dataclass(frozen=True)
class Voxels:
    """Surface elements, one per voxel."""

    points: np.ndarray  # (m, 3) mean position
    lab: np.ndarray  # (m, 3) mean colour, CIELAB
    normals: np.ndarray  # (m, 3) unit, pointing outwards
    size: float  # side of a voxel

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class VoxelEdges:
    """Pairs of neighbouring voxels and their dissimilarity."""

    i: np.ndarray  # (e,)
    j: np.ndarray  # (e,)
    contrast: np.ndarray  # (e,) CIELAB distance
    bend: np.ndarray  # (e,) sine of the angle between the normals, positive where concave and at depth jumps


def voxel_edges(voxels: Voxels, radius: float = 2.2, k: int = 12) -> VoxelEdges:
    """Edges from each voxel to at most k nearest neighbours within `radius` voxel sides."""
    if len(voxels) < 2:
        none = np.zeros(0, np.int64)
        return VoxelEdges(none, none, none.astype(float), none.astype(float))
    distance, index = cKDTree(voxels.points).query(
        voxels.points, k=min(k + 1, len(voxels)), distance_upper_bound=radius * voxels.size, workers=-1
    )
    i = np.repeat(np.arange(len(voxels)), index.shape[1])[np.isfinite(distance).ravel()]
    j = index.ravel()[np.isfinite(distance).ravel()]
    low, high = np.minimum(i, j)[i != j], np.maximum(i, j)[i != j]
    i, j = np.unique(np.stack([low, high], 1), axis=0).T
    step = voxels.points[j] - voxels.points[i]
    step /= np.linalg.norm(step, axis=1, keepdims=True).clip(1e-12)
    slope_i, slope_j = (voxels.normals[i] * step).sum(1), (voxels.normals[j] * step).sum(1)
    jump = np.sqrt((slope_i * slope_j).clip(0))  # large if both normals point along the edge: a depth discontinuity
    bend = (slope_i - slope_j) / 2 + (jump - 0.3).clip(0)
    return VoxelEdges(i, j, np.linalg.norm(voxels.lab[i] - voxels.lab[j], axis=1), bend)


class DisjointSets:
    """Union-find with path halving."""

    def __init__(self, count: int):
        self.parent = list(range(count))

    def find(self, i: int) -> int:
        """Representative of the set of element i."""
        parent = self.parent
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i


def oversegment(
    voxels: Voxels, edges: VoxelEdges, k: float = 0.8, min_size: int = 6, max_size: int = 120
) -> np.ndarray:
    """Region number of each voxel: regions of homogeneous colour without concave edges.

    Regions below `min_size` voxels are merged with a neighbour. No region exceeds `max_size` voxels, because otherwise
    a single weak boundary edge would join two objects irreversibly. `k` sets the scale: a larger one gives larger
    regions.

    Source: Felzenszwalb and Huttenlocher 2004, "Efficient graph-based image segmentation".
    """
    weight = edges.contrast / 20 + 1.2 * edges.bend.clip(0)
    order = np.argsort(weight, kind="stable")
    forest, inner, size = DisjointSets(len(voxels)), [0.0] * len(voxels), [1] * len(voxels)
    pairs = list(zip(edges.i[order].tolist(), edges.j[order].tolist(), weight[order].tolist(), strict=True))
    for allow_small in (False, True):
        for i, j, w in pairs:
            a, b = forest.find(i), forest.find(j)
            if a == b or size[a] + size[b] > max_size:
                continue
            even = w <= min(inner[a] + k / size[a], inner[b] + k / size[b])
            if even or (allow_small and w < 1.5 and min(size[a], size[b]) < min_size):
                forest.parent[b] = a
                size[a] += size[b]
                inner[a] = max(inner[a], inner[b], w) if even else max(inner[a], inner[b])
    return np.unique([forest.find(i) for i in range(len(voxels))], return_inverse=True)[1]


@dataclass
class Region:
    """A region of voxels during merging."""

    members: np.ndarray  # (v,) indices of its voxels
    colours: np.ndarray  # (c,) histogram over the palette, sums to 1
    sample: np.ndarray  # (s, 3) subset of its points
    corners: np.ndarray  # (c, 3) vertices of its convex hull, or all its points without one
    hull: np.ndarray | None  # (f, 4) outward planes of its convex hull; None without volume
    depth: float  # sum of the sample points' depths below the hull


@dataclass
class Border:
    """Boundary between two regions, as sums over the edges across it."""

    count: int
    contrast: float
    bend: float

    def plus(self, other: Border) -> Border:
        """The union of two boundaries."""
        return Border(self.count + other.count, self.contrast + other.contrast, self.bend + other.bend)


class RegionMerger:
    """Greedy pairwise merging of regions, smallest separation first."""

    def __init__(
        self, voxels: Voxels, edges: VoxelEdges, labels: np.ndarray, min_voxels: int, limit: float, max_extent: float
    ):
        """`limit`: separation up to which regions merge; `max_extent`: longest side of an object [scene units]."""
        self.voxels, self.min_voxels, self.limit, self.max_extent = voxels, min_voxels, limit, max_extent
        self.palette = _palette(voxels.lab)
        soft = _soft_bins(voxels.lab, self.palette)
        order = np.argsort(labels, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
        self.regions = {n: self._region(members, soft[members].mean(0)) for n, members in enumerate(groups)}
        self.borders: dict[int, dict[int, Border]] = {n: {} for n in self.regions}
        self._add_borders(edges, labels)

    def _region(self, members: np.ndarray, colours: np.ndarray) -> Region:
        points = self.voxels.points[members]
        sample = points[:: max(1, len(points) // MAX_SAMPLE_POINTS)]
        hull = _hull(points)
        if hull is None:
            return Region(members, colours, sample, points, None, 0.0)
        planes = hull.equations
        return Region(members, colours, sample, points[hull.vertices], planes, _depth(sample, planes).sum())

    def _add_borders(self, edges: VoxelEdges, labels: np.ndarray) -> None:
        a, b = labels[edges.i], labels[edges.j]
        across = a != b
        pair = np.stack([np.minimum(a, b), np.maximum(a, b)], 1)[across]
        pairs, which, count = np.unique(pair, axis=0, return_inverse=True, return_counts=True)
        which = which.reshape(-1)
        contrast = np.bincount(which, edges.contrast[across], len(pairs))
        bend = np.bincount(which, edges.bend[across].clip(-0.5), len(pairs))
        for (x, y), n, c, v in zip(pairs.tolist(), count, contrast, bend, strict=True):
            self.borders[x][y] = self.borders[y][x] = Border(int(n), float(c), float(v))

    def separation(self, a: int, b: int) -> float:
        """Dissimilarity of two neighbouring regions; below `GroupingOptions.detail` they are merged.

        It is increased by a concave or narrow boundary, by a union that is less convex than its parts, and by different
        colours, which have less weight if the union is convex. It is decreased if one region lies in the convex hull of
        the other (the wheels of a car), and for regions smaller than `min_voxels`.

        If a lower bound without the terms that need convex hulls is already above the limit, that bound is returned.
        """
        one, two, border = self.regions[a], self.regions[b], self.borders[a][b]
        small = min(len(one.members), len(two.members))
        step = np.clip((border.contrast / border.count - TEXTURE_CONTRAST) / 25, 0, 1)
        colour_distance = 1 - np.minimum(one.colours, two.colours).sum()
        concave = np.clip(border.bend / border.count, -0.1, 0.5)
        neck = 1 - min(1.0, border.count / (6 * small**0.5))
        too_large = self._too_large(one, two)

        def value(within: float, hollow: float) -> float:
            colour = colour_distance * (0.35 + 0.1 * step) * min(0.6 + 20 * hollow, 1.4)
            shape = 1.5 * concave + 0.2 * neck + 3 * hollow
            total = colour + shape * (0.2 + 0.8 * colour_distance) - 0.5 * min(within, 1.0) + too_large
            return total - (0.5 if small < self.min_voxels else 0.0)

        if (bound := value(1.0, 0.0)) > self.limit:
            return bound
        within = _inside(one.sample, two.hull, self.voxels.size) + _inside(two.sample, one.hull, self.voxels.size)
        if (bound := value(within, 0.0)) > self.limit:
            return bound
        return value(within, self._hollow(one, two))

    def _too_large(self, one: Region, two: Region) -> float:
        """Penalty 0..1 for a union that exceeds `max_extent`."""
        corners = np.concatenate([one.corners, two.corners])
        return float(np.clip(np.ptp(corners, axis=0).max() / self.max_extent - 1, 0, 1))

    def _hollow(self, one: Region, two: Region) -> float:
        """Mean depth of points in the hull of the union minus that in their own hull, over the size of the smaller."""
        both = np.concatenate([one.sample, two.sample])
        hull = _hull(np.concatenate([one.corners, two.corners]))
        if hull is None:
            return 0.0
        deep = _depth(both, hull.equations).sum() - one.depth - two.depth
        size = min(np.linalg.norm(np.ptp(r.sample, axis=0)) for r in (one, two)) + self.voxels.size
        return float(np.clip(deep / len(both) / size, 0, 0.5))

    def run(self) -> np.ndarray:
        """Object number of each voxel, from 0, after merging all pairs up to the limit."""
        queue = [(self.separation(a, b), a, b) for a in self.borders for b in self.borders[a] if a < b]
        heapq.heapify(queue)
        merged = len(self.regions)
        while queue:
            value, a, b = heapq.heappop(queue)
            if value > self.limit:
                break
            if a not in self.regions or b not in self.regions:
                continue
            self._merge(a, b, merged)
            for other in self.borders[merged]:
                heapq.heappush(queue, (self.separation(merged, other), merged, other))
            merged += 1
        labels = np.zeros(len(self.voxels), np.int64)
        for n, region in enumerate(self.regions.values()):
            labels[region.members] = n
        return labels

    def _merge(self, a: int, b: int, merged: int) -> None:
        one, two = self.regions.pop(a), self.regions.pop(b)
        fraction = len(one.members) / (len(one.members) + len(two.members))
        members = np.concatenate([one.members, two.members])
        self.regions[merged] = self._region(members, fraction * one.colours + (1 - fraction) * two.colours)
        joined = self.borders.pop(a)
        joined.pop(b, None)
        for other, border in self.borders.pop(b).items():
            if other != a:
                joined[other] = joined[other].plus(border) if other in joined else border
        self.borders[merged] = joined
        for other, border in joined.items():
            self.borders[other].pop(a, None)
            self.borders[other].pop(b, None)
            self.borders[other][merged] = border


def _palette(lab: np.ndarray, count: int = 16) -> np.ndarray:
    """Palette (c, 3) of at most `count` colours, by farthest-point sampling of the colours present."""
    rows = lab[:: max(1, len(lab) // 2000)]
    chosen = [rows[np.argmin(np.linalg.norm(rows - np.median(rows, 0), axis=1))]]
    distance = np.linalg.norm(rows - chosen[0], axis=1)
    while len(chosen) < count and distance.max() > 12:
        chosen.append(rows[distance.argmax()])
        distance = np.minimum(distance, np.linalg.norm(rows - chosen[-1], axis=1))
    return np.array(chosen)


def _soft_bins(lab: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Soft assignment (m, c) of each voxel's colour to the palette; rows sum to 1."""
    distance = np.linalg.norm(lab[:, None] - palette[None], axis=2)
    weight = np.exp(-0.5 * ((distance - distance.min(1, keepdims=True)) / 8) ** 2)
    return weight / weight.sum(1, keepdims=True)


def _hull(points: np.ndarray) -> ConvexHull | None:
    """Convex hull of the points; None if they span no volume."""
    if len(points) < 8:
        return None
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):
        return None


def _inside(points: np.ndarray, hull: np.ndarray | None, margin: float) -> float:
    """Fraction of points inside a hull by more than a quarter of `margin`."""
    if hull is None or not len(points):
        return 0.0
    return float(((points @ hull[:, :3].T + hull[:, 3]).max(1) < -0.25 * margin).mean())


def _depth(points: np.ndarray, hull: np.ndarray) -> np.ndarray:
    """Depth of points below the surface of a hull; 0 outside."""
    return -(points @ hull[:, :3].T + hull[:, 3]).max(1).clip(max=0)
