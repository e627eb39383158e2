"""Group Gaussians into movable objects by position, colour and normals, without labels or networks."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.perception.object_limits import GroupingOptions
from stages.core.perception.object_naming import object_names
from stages.core.perception.region_growing import cielab_colours, grow_objects, table_colour
from stages.core.perception.region_merging import RegionMerger, Voxels, oversegment, voxel_edges
from stages.core.perception.support import (
    Support,
    ViewExtent,
    cell_medians,
    find_support,
    sliding_quantile,
    view_extent,
)
from stages.core.perception.visibility import summed_view_directions
from stages.core.perception.wall import find_wall, rotate_wall_to_floor
from stages.core.scene.gaussians import SURFACE_OPACITY, Gaussians
from stages.core.scene.scene import Scene, SceneObject

log = logging.getLogger(__name__)
MAX_VOXELS = 60_000
MIN_VOXEL_DENSITY = 0.3  # minimum Gaussians per voxel of an object [median near the focus]; sparser ones are floaters
MAX_BASE_HEIGHT = 0.4  # largest height above the table of an object's lowest point [camera distance]
MAX_BUMP_HEIGHT = 0.05  # height up to which a region of the table's colour is a bump of the table [camera distance]
MAX_TABLE_OBJECT = 0.4  # longest side of an object on a table [camera distance]
MAX_WALL_OBJECT = 0.9  # longest side of an object on a wall, which often fills the photos [camera distance]
MIN_GAUSSIANS_ABOVE = 20  # minimum number of Gaussians above the plane; with fewer there are no objects


def group_objects(scene: Scene, grouping: GroupingOptions = GroupingOptions()) -> Scene:  # noqa: B008 -- frozen
    """The scene with an object_id for every Gaussian (0 for the background) and its objects, largest first.

    The supporting plane is removed, the rest is oversegmented into small homogeneous regions, and these are merged by
    similarity. Objects that are mostly outside the table become background. In a scene with a wall and no floor,
    objects on the wall are found in the same way.
    """
    view = view_extent(scene)
    wall = find_wall(scene, view, grouping.seed)
    if wall is None:
        support = find_support(scene, view, grouping.seed)
        return name_objects(
            replace(scene, gaussians=_grouped(scene, view, support, grouping, MAX_TABLE_OBJECT)), support
        )
    laid = rotate_wall_to_floor(scene, wall)
    view = view_extent(laid)
    ids = _grouped(laid, view, find_support(laid, view, grouping.seed), grouping, MAX_WALL_OBJECT).object_id
    return name_objects(replace(scene, gaussians=replace(scene.gaussians, object_id=ids)), None)


def _grouped(
    scene: Scene, view: ViewExtent, support: Support | None, grouping: GroupingOptions, max_extent: float
) -> Gaussians:
    """The scene's Gaussians with object ids; objects larger than `max_extent` camera distances are penalised."""
    g = replace(scene.gaussians, object_id=torch.zeros(len(scene.gaussians), dtype=torch.int64))
    index = _candidates(g, view, support)
    index = index[_is_dense(g.means[index], view)]
    if len(index) < MIN_GAUSSIANS_ABOVE:
        log.info("there are no Gaussians above the supporting plane, and so no objects")
        return g
    seen = summed_view_directions(g, scene.cameras) if scene.cameras is not None and len(scene.cameras) else None
    voxels, owner = _voxels(g[index], view, None if seen is None else seen[index])
    edges = voxel_edges(voxels)
    min_voxels = max(4, int((grouping.min_size * view.radius / voxels.size) ** 2))
    regions = oversegment(voxels, edges)
    labels = RegionMerger(voxels, edges, regions, min_voxels, grouping.detail, max_extent * view.radius).run()
    count = np.bincount(owner[owner >= 0], minlength=len(voxels)) * _expected_sparsity(voxels, scene, view)
    if support is not None:
        labels = _remove_table_regions(voxels, labels, table_colour(g, support), support)
    labels = _objects(voxels, count, labels, view, support, grouping)
    g.object_id[index] = torch.from_numpy(np.where(owner >= 0, labels[owner], 0))
    return grow_objects(g, support, 2 * voxels.size)


def _candidates(g: Gaussians, view: ViewExtent, support: Support | None) -> Int[Tensor, "m"]:
    """Indices of opaque Gaussians near the focus that are not part of the supporting plane."""
    R = view.radius
    ok = g.means.isfinite().all(1) & g.quats.isfinite().all(1) & g.scales.isfinite().all(1)
    ok &= (g.opacities > SURFACE_OPACITY) & (g.scales.amax(1) < 0.1 * R)
    ok &= (g.means - view.focus).norm(dim=1) < 1.5 * R
    if support is None:
        return torch.nonzero(ok & ((g.means - view.focus).norm(dim=1) < 0.8 * R))[:, 0]
    h = support.heights(g.means)
    near = support.inside(g.means, 0.12 * R) & (h > -0.3 * R)
    over = (h > support.tolerance) | (h < -3 * support.tolerance)
    like, higher = _against_table(g, h, support)
    bump = like & (h < 2.5 * support.tolerance) & (_shortest(g)[:, 2].abs() > 0.8)
    return torch.nonzero(ok & near & ((over & ~bump) | (higher & ~like)))[:, 0]


def _against_table(g: Gaussians, h: Float[Tensor, "n"], support: Support) -> tuple[Tensor, Tensor]:
    """For Gaussians close to the table: whether they have its colour, and whether they belong to a flat object on it.

    A flat object differs from the surrounding table in colour and is slightly higher. A stain differs only in colour,
    a bump of the reconstruction only in height. `h` is the height above the table [scene units].
    """
    like, flat = torch.zeros(2, len(g), dtype=torch.bool)
    near = (h.abs() < 2.5 * support.tolerance) & (g.opacities > SURFACE_OPACITY) & support.inside(g.means)
    near = torch.nonzero(near)[:, 0]
    if len(near) < 50:
        return like, flat
    values = torch.cat([cielab_colours(g[near]), h[near, None]], 1)
    table = sliding_quantile(cell_medians(support, g.means[near], values, 3), radius=5)
    here = sliding_quantile(cell_medians(support, g.means[near], values), radius=1)
    cell = support.cells(g.means[near])
    around, mine = table[tuple((cell // 3).T)], here[tuple(cell.T)]
    like[near] = (values - around)[:, :3].norm(dim=1) < 10
    other = (mine - around)[:, :3].norm(dim=1) > 14
    higher = (mine - around)[:, 3] > max(0.35 * support.tolerance, 0.003 * support.view.radius)
    flat[near] = other & higher & (values[:, 3] > 0)
    return like, flat


def _shortest(g: Gaussians) -> Float[Tensor, "n 3"]:
    """Direction of each Gaussian's shortest axis, which is the surface normal of a flat Gaussian."""
    return matrix(g.quats)[torch.arange(len(g)), :, g.scales.argmin(1)]


def _is_dense(points: Float[Tensor, "m 3"], view: ViewExtent) -> Bool[Tensor, "m"]:
    """Mask of points whose neighbours are about as near as usual; the others are floaters."""
    if len(points) < MIN_GAUSSIANS_ABOVE:
        return torch.ones(len(points), dtype=torch.bool)
    distance = knn(points, points, 9)[0][:, -1]
    return distance < min(max(3.5 * float(distance.median()), 0.01 * view.radius), 0.06 * view.radius)


def _voxels(g: Gaussians, view: ViewExtent, seen: Tensor | None) -> tuple[Voxels, np.ndarray]:
    """Voxels about twice as coarse as the Gaussians' spacing, and the voxel of each Gaussian (-1: dropped as stray)."""
    spacing = float(knn(g.means, g.means, 4)[0][:, 1:].mean(1).median())
    size = min(max(2.0 * spacing, 0.007 * view.radius), 0.025 * view.radius)
    while True:
        cell = (g.means / size).floor().long()
        _, owner, count = cell.unique(dim=0, return_inverse=True, return_counts=True)
        if len(count) <= MAX_VOXELS:
            break
        size *= 1.3
    points, lab = _mean(g.means, owner, count), _mean(cielab_colours(g), owner, count)
    normals = _normals(g, points, owner, count, seen, view)
    neighbours = (knn(points, points, 5)[0][:, -1] < 2.2 * size) | (count > 3)
    number = torch.where(neighbours, neighbours.long().cumsum(0) - 1, -1)
    kept = (t[neighbours].double().numpy() for t in (points, lab, normals))
    return Voxels(*kept, size), number[owner].numpy()


def _mean(values: Float[Tensor, "n *v"], owner: Int[Tensor, "n"], count: Int[Tensor, "m"]) -> Float[Tensor, "m *v"]:
    total = torch.zeros(len(count), *values.shape[1:]).index_add_(0, owner, values.float())
    return total / count.reshape(-1, *[1] * (values.dim() - 1))


def _normals(
    g: Gaussians, points: Tensor, owner: Tensor, count: Tensor, seen: Tensor | None, view: ViewExtent
) -> Tensor:
    """Voxel normals from the shortest axes of the Gaussians and the planes through neighbours, facing the cameras."""
    lengths, axes = g.scales.sort(1).values, _shortest(g)
    flat = (1 - lengths[:, 0] / lengths[:, 1].clamp_min(1e-12)).clamp_min(0)
    axes = _mean(flat[:, None, None] * axes[:, :, None] * axes[:, None], owner, count)
    around = points[knn(points, points, 13)[1]]
    centred = around - around.mean(1, keepdim=True)
    spread = centred.mT @ centred
    spread = spread / spread.diagonal(dim1=1, dim2=2).sum(1).clamp_min(1e-20)[:, None, None]
    normals = torch.linalg.eigh(axes + torch.eye(3) - 2 * spread).eigenvectors[:, :, -1]
    wide = points[knn(points, points, 64)[1]].mean(1)
    toward = (
        points - wide + 1e-3 * view.radius * torch.tensor([0.0, 0, 1])
    )  # without cameras, outwards is away from the surrounding points
    if seen is not None:
        total = torch.zeros(len(count), 3).index_add_(0, owner, seen)
        toward = torch.where(total.norm(dim=1, keepdim=True) > 0, total, toward)
    return normals * torch.where((normals * toward).sum(1, keepdim=True) < 0, -1.0, 1.0)


def _expected_sparsity(voxels: Voxels, scene: Scene, view: ViewExtent) -> np.ndarray:
    """Expected sparsity of Gaussians in each voxel: squared distance from the nearest camera [camera distance^2].

    It is limited to 0.25 to 4, and 1 without cameras.
    """
    if scene.cameras is None or not len(scene.cameras):
        return np.ones(len(voxels))
    distance, _ = knn(centres(scene.cameras.viewmats), torch.from_numpy(voxels.points).float(), 1)
    return (distance[:, 0] / view.radius).clamp(0.5, 2).square().numpy()


def _remove_table_regions(
    voxels: Voxels, labels: np.ndarray, table: Float[Tensor, "bx by 3"], support: Support
) -> np.ndarray:
    """The labels, with -1 for low regions of the table's colour; beneath a larger region, a similar colour suffices."""
    points = torch.from_numpy(voxels.points).float()
    h = support.heights(points).numpy() / support.view.radius
    around = table[tuple((support.cells(points) // 3).T)].numpy()
    difference = np.linalg.norm(voxels.lab - around, axis=1)
    _, column = np.unique(np.floor(voxels.points[:, :2] / (4 * voxels.size)), axis=0, return_inverse=True)
    column, size = column.reshape(-1), np.bincount(labels[labels >= 0])
    out = labels.copy()
    for label in np.unique(labels[labels >= 0]):
        members = labels == label
        if np.percentile(h[members], 95) > MAX_BUMP_HEIGHT:
            continue
        above = np.isin(column, column[members]) & (labels >= 0) & (size[labels] > 3 * size[label])
        shaded = len(np.unique(column[above])) > 0.5 * len(np.unique(column[members]))
        if np.median(difference[members]) < (25 if shaded else 10):
            out[members] = -1
    return out


def _objects(
    voxels: Voxels,
    count: np.ndarray,
    labels: np.ndarray,
    view: ViewExtent,
    support: Support | None,
    grouping: GroupingOptions,
) -> np.ndarray:
    """Object number of each voxel, 1 for the largest; 0 for regions too small, too large, too sparse or off the table.

    `count` is the number of Gaussians in each voxel, scaled by the expected sparsity; it is low in clouds of floaters.
    """
    points = torch.from_numpy(voxels.points).float()
    off = np.zeros(len(voxels), bool)
    h = np.zeros(len(voxels))
    if support is not None:
        h = support.heights(points).numpy()
        off = ~support.inside(points).numpy() | (h < -2 * support.tolerance)
    near = np.linalg.norm(voxels.points - view.focus.numpy(), axis=1) < 0.3 * view.radius
    min_density = MIN_VOXEL_DENSITY * np.median(count[near]) if near.any() else 0.0
    min_size = grouping.min_size * view.radius
    found = []
    for label in np.unique(labels[labels >= 0]):
        members = labels == label
        low, high = np.percentile(voxels.points[members], (2, 98), axis=0)
        sized = min_size <= (high - low).max() < 1.2 * view.radius
        enough = members.sum() >= max(8, 0.35 * (min_size / voxels.size) ** 2)
        here = off[members].mean() < 0.4 and h[members].min() < MAX_BASE_HEIGHT * view.radius
        if sized and enough and here and count[members].mean() > min_density:
            found.append((int(members.sum()), label))
    out = np.zeros(len(voxels), np.int64)
    for number, (_, label) in enumerate(sorted(found, reverse=True)[: grouping.max_objects], start=1):
        out[labels == label] = number
    return out


def name_objects(scene: Scene, support: Support | None) -> Scene:
    """The scene with its objects renumbered by decreasing number of Gaussians, and with default names."""
    g = scene.gaussians
    counts = torch.bincount(g.object_id)
    order = [i for i in counts.argsort(descending=True, stable=True).tolist() if i > 0 and counts[i] > 0]
    number = torch.zeros(len(counts), dtype=torch.int64)
    number[order] = torch.arange(1, len(order) + 1)
    g = replace(g, object_id=number[g.object_id])
    names = object_names(g, support)
    objects = tuple(SceneObject(i, name) for i, name in enumerate(names, start=1))
    return replace(scene, gaussians=g, objects=objects)
