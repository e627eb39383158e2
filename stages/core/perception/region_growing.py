"""Region growing: extend the labels of objects to the remaining Gaussians that belong to them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.perception.support import Support, cell_medians, sliding_quantile
from stages.core.scene.gaussians import Gaussians

MIN_TABLE_DIFFERENCE = 12.0  # colour difference from the table above which a Gaussian is not table [CIELAB]
MIN_CHROMA_DIFFERENCE = 20.0  # difference in a and b above which shading cannot be the cause [CIELAB]
MAX_GROWTH_STEPS = 12  # maximum number of steps of `radius` by which an object grows along Gaussians near the table


def cielab_colours(g: Gaussians) -> Float[Tensor, "n 3"]:
    """Base colours (degree 0 of the spherical harmonics) in CIELAB."""
    rgb = (g.sh[:, 0] * C0 + 0.5).nan_to_num(0.5).clamp(0, 1).numpy().astype(np.float32)
    if not len(rgb):  # OpenCV rejects empty arrays
        return torch.zeros(0, 3)
    return torch.from_numpy(cv2.cvtColor(rgb[None], cv2.COLOR_RGB2LAB)[0].reshape(-1, 3))


def table_colour(g: Gaussians, support: Support) -> Float[Tensor, "bx by 3"]:
    """Median colour of the table around each block of 3 x 3 cells [CIELAB]."""
    on = (support.heights(g.means).abs() < support.tolerance) & (g.object_id == 0) & g.means.isfinite().all(1)
    return sliding_quantile(cell_medians(support, g.means[on], cielab_colours(g[on]), 3), radius=3)


def grow_objects(g: Gaussians, support: Support | None, radius: float) -> Gaussians:
    """Extend the labels of objects to neighbouring Gaussians, and to unlabelled Gaussians inside the objects.

    A Gaussian within `radius` [scene units] of an object takes its label; close to the table it does so only if its
    colour is nearer to the object's than to that of the surrounding table.
    """
    finite = g.means.isfinite().all(1)
    large = g.scales.amax(1) >= 3 * radius
    start = torch.nonzero((g.object_id > 0) & finite)[:, 0]
    free = torch.nonzero((g.object_id == 0) & finite & ~large)[:, 0]
    if not len(start) or not len(free):
        return g
    ids = _grow(g, support, start, free, radius)
    rest = torch.nonzero((ids == 0) & finite & g.scales.isfinite().all(1) & g.quats.isfinite().all(1))[:, 0]
    if support is not None:
        rest = rest[support.heights(g.means[rest]) > support.tolerance]
    return replace(g, object_id=_fill_hulls(g, ids, rest, large, support))


def _grow(
    g: Gaussians, support: Support | None, front: Int[Tensor, "a"], free: Int[Tensor, "b"], radius: float
) -> Int[Tensor, "n"]:
    """Object ids after the labels of `front` have spread, step by step, to the `free` Gaussians."""
    ids, lab = g.object_id.clone(), cielab_colours(g)
    source = lab.clone()  # object colour where the growth began, so that colours cannot drift over many steps
    level = torch.full((len(free),), torch.inf)  # height above the table [support tolerances]
    to_table = torch.zeros(len(free))
    if support is not None:
        level = support.heights(g.means[free]) / support.tolerance
        around = table_colour(g, support)[tuple((support.cells(g.means[free]) // 3).T)]
        to_table = (lab[free] - around).norm(dim=1)
        vivid = (lab[free] - around)[:, 1:].norm(dim=1) > MIN_CHROMA_DIFFERENCE
        level = torch.where(
            vivid & (level.abs() < 0.5), 0.5, level
        )  # too flat for the height to decide, so the hue does
    left = level > -0.5
    for _ in range(MAX_GROWTH_STEPS):
        free, level, to_table = free[left], level[left], to_table[left]
        if not len(front) or not len(free):
            break
        distance, nearest = knn(g.means[front], g.means[free], 1)
        nearest = front[nearest[:, 0]]
        matches = ((lab[free] - source[nearest]).norm(dim=1) < 0.7 * to_table) & (to_table > MIN_TABLE_DIFFERENCE)
        take = (distance[:, 0] < radius) & (matches | (level > 1))
        front, nearest = free[take], nearest[take]
        ids[front], source[front] = ids[nearest], source[nearest]
        left = (
            ~take & (level > 0.4) & (level < 1)
        )  # beyond the radius, high Gaussians belong to other objects and flat ones to the table's texture
    return ids


def _fill_hulls(
    g: Gaussians, ids: Int[Tensor, "n"], free: Int[Tensor, "m"], large: Bool[Tensor, "n"], support: Support | None
) -> Int[Tensor, "n"]:
    """Object ids after the `free` Gaussians inside an object's convex hull are added to it, smallest object first.

    The hull extends down to the support if the object stands on it. A `large` Gaussian must be inside up to one
    standard deviation in every direction.
    """
    counts = torch.bincount(ids)
    for number in [i for i in counts.argsort(stable=True).tolist() if i > 0 and counts[i] >= 8]:
        rest = free[ids[free] == 0]
        own = g.means[(ids == number) & g.means.isfinite().all(1)]
        if support is not None and float(support.heights(own).quantile(0.02)) < 3 * support.tolerance:
            foot = own[support.heights(own) < 6 * support.tolerance]
            own = torch.cat([own, torch.cat([foot[:, :2], support.surface(foot)[:, None]], 1)])
        rest = rest[((g.means[rest] > own.amin(0)) & (g.means[rest] < own.amax(0))).all(1)]
        try:
            hull = ConvexHull(own.double().numpy()).equations
        except (QhullError, ValueError):
            continue
        height = g.means[rest].double().numpy() @ hull[:, :3].T + hull[:, 3]
        blurred = rest[large[rest]]
        axes = matrix(g.quats[blurred]) * g.scales[blurred][:, None]
        height[large[rest].numpy()] += np.linalg.norm(hull[:, :3] @ axes.double().numpy(), axis=2)
        ids[rest[torch.from_numpy(height.max(1, initial=-np.inf) < 1e-9)]] = number
    return ids
