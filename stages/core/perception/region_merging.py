"""Voxels of a surface gathered into regions, and regions into things, by colour, shape and how they meet."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

INNER_STEP = 9.0  # CIELAB steps between neighbours that are still texture
HULL_POINTS = 150


@dataclass(frozen=True)
class Voxels:
    """Pieces of surface, one a voxel."""

    points: np.ndarray  # (m, 3) mean position
    lab: np.ndarray  # (m, 3) mean colour, CIELAB
    normals: np.ndarray  # (m, 3) unit, to the outside
    size: float  # side of a voxel

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class VoxelEdges:
    """Pairs of neighbouring voxels and how different they are."""

    i: np.ndarray  # (e,)
    j: np.ndarray  # (e,)
    contrast: np.ndarray  # (e,) CIELAB distance
    bend: np.ndarray  # (e,) sine of the angle between the normals, above 0 in a valley and at a jump


def voxel_edges(voxels: Voxels, reach: float = 2.2, k: int = 12) -> VoxelEdges:
    """Neighbours within `reach` voxel sides, k at most for each."""
    if len(voxels) < 2:
        none = np.zeros(0, np.int64)
        return VoxelEdges(none, none, none.astype(float), none.astype(float))
    distance, index = cKDTree(voxels.points).query(
        voxels.points, k=min(k + 1, len(voxels)), distance_upper_bound=reach * voxels.size, workers=-1
    )
    i = np.repeat(np.arange(len(voxels)), index.shape[1])[np.isfinite(distance).ravel()]
    j = index.ravel()[np.isfinite(distance).ravel()]
    low, high = np.minimum(i, j)[i != j], np.maximum(i, j)[i != j]
    i, j = np.unique(np.stack([low, high], 1), axis=0).T
    step = voxels.points[j] - voxels.points[i]
    step /= np.linalg.norm(step, axis=1, keepdims=True).clip(1e-12)
    slope_i, slope_j = (voxels.normals[i] * step).sum(1), (voxels.normals[j] * step).sum(1)
    jump = np.sqrt((slope_i * slope_j).clip(0))  # both normals along the step: one surface behind the other
    bend = (slope_i - slope_j) / 2 + (jump - 0.3).clip(0)
    return VoxelEdges(i, j, np.linalg.norm(voxels.lab[i] - voxels.lab[j], axis=1), bend)


class DisjointSets:
    """Disjoint sets with path halving."""

    def __init__(self, count: int):
        self.parent = list(range(count))

    def find(self, i: int) -> int:
        parent = self.parent
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i


def oversegment(voxels: Voxels, edges: VoxelEdges, k: float = 0.8, least: int = 6, most: int = 120) -> np.ndarray:
    """Region number of each voxel: even in colour and without a valley, unless that is their texture.

    None grows over `most` voxels, since one weak place in a border would join two things for good.

    Source: Felzenszwalb and Huttenlocher 2004, "Efficient graph-based image segmentation".
    """
    weight = edges.contrast / 20 + 1.2 * edges.bend.clip(0)
    order = np.argsort(weight, kind="stable")
    forest, inner, size = DisjointSets(len(voxels)), [0.0] * len(voxels), [1] * len(voxels)
    pairs = list(zip(edges.i[order].tolist(), edges.j[order].tolist(), weight[order].tolist(), strict=True))
    for allow_small in (False, True):
        for i, j, w in pairs:
            a, b = forest.find(i), forest.find(j)
            if a == b or size[a] + size[b] > most:
                continue
            even = w <= min(inner[a] + k / size[a], inner[b] + k / size[b])
            if even or (allow_small and w < 1.5 and min(size[a], size[b]) < least):
                forest.parent[b] = a
                size[a] += size[b]
                inner[a] = max(inner[a], inner[b], w) if even else max(inner[a], inner[b])
    return np.unique([forest.find(i) for i in range(len(voxels))], return_inverse=True)[1]


@dataclass
class Region:
    """One growing part of a thing."""

    members: np.ndarray  # voxels
    colours: np.ndarray  # histogram over the palette, sums to 1
    sample: np.ndarray  # (s, 3) some of its points
    corners: np.ndarray  # (c, 3) of its convex hull
    hull: np.ndarray | None  # (f, 4) outward planes of its convex hull


@dataclass
class Border:
    """Where two regions meet, as sums over the edges across."""

    count: int
    contrast: float
    bend: float

    def plus(self, other: Border) -> Border:
        return Border(self.count + other.count, self.contrast + other.contrast, self.bend + other.bend)


class RegionMerger:
    """Regions merged two at a time, the two that most look like one thing first."""

    def __init__(self, voxels: Voxels, edges: VoxelEdges, labels: np.ndarray, least: int, limit: float, large: float):
        self.voxels, self.least, self.limit, self.large = voxels, least, limit, large
        self.palette = _palette(voxels.lab)
        soft = _soft_bins(voxels.lab, self.palette)
        order = np.argsort(labels, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
        self.regions = {n: self._region(members, soft[members].mean(0)) for n, members in enumerate(groups)}
        self.borders: dict[int, dict[int, Border]] = {n: {} for n in self.regions}
        self._meet(edges, labels)

    def _region(self, members: np.ndarray, colours: np.ndarray) -> Region:
        points = self.voxels.points[members]
        sample = points[:: max(1, len(points) // HULL_POINTS)]
        return Region(members, colours, sample, *_hull(points))

    def _meet(self, edges: VoxelEdges, labels: np.ndarray) -> None:
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
        """How little two neighbours look like one thing: well below a third they do, well above it they do not.

        Against: a valley between them, a union less convex than they are, a narrow neck, and, counting less
        where the union is convex, unlike colours. For: one lies within the convex hull of the other, as
        wheels do in a car.
        """
        one, two, border = self.regions[a], self.regions[b], self.borders[a][b]
        small = min(len(one.members), len(two.members))
        step = np.clip((border.contrast / border.count - INNER_STEP) / 25, 0, 1)
        unlike = 1 - np.minimum(one.colours, two.colours).sum()
        valley = np.clip(border.bend / border.count, -0.1, 0.5)
        neck = 1 - min(1.0, border.count / (6 * small**0.5))
        within = _inside(one.sample, two.hull, self.voxels.size) + _inside(two.sample, one.hull, self.voxels.size)
        hollow = self._hollow(one, two)
        colour = unlike * (0.35 + 0.1 * step) * min(0.6 + 20 * hollow, 1.4)
        shape = 1.5 * valley + 0.2 * neck + 3 * hollow
        value = colour + shape * (0.2 + 0.8 * unlike) - 0.5 * min(within, 1.0) + self._too_large(one, two)
        return value - (0.5 if small < self.least else 0.0)

    def _too_large(self, one: Region, two: Region) -> float:
        """Things that one picks up are not as large as what the cameras look at: from `large` on it speaks against."""
        corners = np.concatenate([one.corners, two.corners])
        return float(np.clip(np.ptp(corners, axis=0).max() / self.large - 1, 0, 1))

    def _hollow(self, one: Region, two: Region) -> float:
        """How much deeper their points lie in the hull of both than in their own, as a share of the smaller's size."""
        both = np.concatenate([one.sample, two.sample])
        _, hull = _hull(np.concatenate([one.corners, two.corners]))
        if hull is None:
            return 0.0
        deep = _depth(both, hull).sum() - _depth(one.sample, one.hull).sum() - _depth(two.sample, two.hull).sum()
        size = min(np.linalg.norm(np.ptp(r.sample, axis=0)) for r in (one, two)) + self.voxels.size
        return float(np.clip(deep / len(both) / size, 0, 0.5))

    def run(self) -> np.ndarray:
        """Thing number of each voxel, from 0."""
        queue = [(self.separation(a, b), a, b) for a in self.borders for b in self.borders[a] if a < b]
        heapq.heapify(queue)
        fresh = len(self.regions)
        while queue:
            value, a, b = heapq.heappop(queue)
            if value > self.limit:
                break
            if a not in self.regions or b not in self.regions:
                continue
            self._merge(a, b, fresh)
            for other in self.borders[fresh]:
                heapq.heappush(queue, (self.separation(fresh, other), fresh, other))
            fresh += 1
        labels = np.zeros(len(self.voxels), np.int64)
        for n, region in enumerate(self.regions.values()):
            labels[region.members] = n
        return labels

    def _merge(self, a: int, b: int, fresh: int) -> None:
        one, two = self.regions.pop(a), self.regions.pop(b)
        share = len(one.members) / (len(one.members) + len(two.members))
        members = np.concatenate([one.members, two.members])
        self.regions[fresh] = self._region(members, share * one.colours + (1 - share) * two.colours)
        joined = self.borders.pop(a)
        joined.pop(b, None)
        for other, border in self.borders.pop(b).items():
            if other != a:
                joined[other] = joined[other].plus(border) if other in joined else border
        self.borders[fresh] = joined
        for other, border in joined.items():
            self.borders[other].pop(a, None)
            self.borders[other].pop(b, None)
            self.borders[other][fresh] = border


def _palette(lab: np.ndarray, count: int = 16) -> np.ndarray:
    """Colours spread over those present: each next one is the farthest from all before."""
    rows = lab[:: max(1, len(lab) // 2000)]
    chosen = [rows[np.argmin(np.linalg.norm(rows - np.median(rows, 0), axis=1))]]
    distance = np.linalg.norm(rows - chosen[0], axis=1)
    while len(chosen) < count and distance.max() > 12:
        chosen.append(rows[distance.argmax()])
        distance = np.minimum(distance, np.linalg.norm(rows - chosen[-1], axis=1))
    return np.array(chosen)


def _soft_bins(lab: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Share of each palette colour in each voxel's colour."""
    distance = np.linalg.norm(lab[:, None] - palette[None], axis=2)
    weight = np.exp(-0.5 * ((distance - distance.min(1, keepdims=True)) / 8) ** 2)
    return weight / weight.sum(1, keepdims=True)


def _hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Corners and outward planes of the convex hull; all points and None where they span no volume."""
    if len(points) < 8:
        return points, None
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return points, None
    return points[hull.vertices], hull.equations


def _inside(points: np.ndarray, hull: np.ndarray | None, margin: float) -> float:
    """Share of points inside a hull by more than a voxel's noise."""
    if hull is None or not len(points):
        return 0.0
    return float(((points @ hull[:, :3].T + hull[:, 3]).max(1) < -0.25 * margin).mean())


def _depth(points: np.ndarray, hull: np.ndarray | None) -> np.ndarray:
    """Distance of points below the surface of a hull."""
    if hull is None:
        return np.zeros(1)
    return -(points @ hull[:, :3].T + hull[:, 3]).max(1).clip(max=0)
