"""Objects made whole: from the pieces that stood out to all Gaussians that belong to them."""

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

OTHER = 12.0  # colour difference (CIELAB) from which something is not the table
VIVID = 20.0  # difference in hue and chroma that no pattern of shade makes
STEPS = 12  # of `reach` that an object may grow along what lies low


def cielab_colours(g: Gaussians) -> Float[Tensor, "n 3"]:
    """Base colours in CIELAB."""
    rgb = (g.sh[:, 0] * C0 + 0.5).nan_to_num(0.5).clamp(0, 1).numpy().astype(np.float32)
    return torch.from_numpy(cv2.cvtColor(rgb[None], cv2.COLOR_RGB2LAB)[0].reshape(-1, 3))


def table_colour(g: Gaussians, support: Support) -> Float[Tensor, "bx by 3"]:
    """Usual colour of the table (CIELAB), in blocks of 3 x 3 cells."""
    on = (support.heights(g.means).abs() < support.tolerance) & (g.object_id == 0) & g.means.isfinite().all(1)
    return sliding_quantile(cell_medians(support, g.means[on], cielab_colours(g[on]), 3), reach=3)


def grow_objects(g: Gaussians, support: Support | None, reach: float) -> Gaussians:
    """Faint and stray Gaussians within objects, and what lies low beside them, take the nearest object's number.

    `reach` [scene units] is how near is near. Close to the plane a Gaussian is the object's when its colour is
    nearer to the object than to the table around; so an object grows along its flat parts.
    """
    finite = g.means.isfinite().all(1)
    large = g.scales.amax(1) >= 3 * reach
    start = torch.nonzero((g.object_id > 0) & finite)[:, 0]
    free = torch.nonzero((g.object_id == 0) & finite & ~large)[:, 0]
    if not len(start) or not len(free):
        return g
    ids = _grow(g, support, start, free, reach)
    rest = torch.nonzero((ids == 0) & finite & g.scales.isfinite().all(1) & g.quats.isfinite().all(1))[:, 0]
    if support is not None:
        rest = rest[support.heights(g.means[rest]) > support.tolerance]
    return replace(g, object_id=_fill_hulls(g, ids, rest, large, support))


def _grow(
    g: Gaussians, support: Support | None, front: Int[Tensor, "a"], free: Int[Tensor, "b"], reach: float
) -> Int[Tensor, "n"]:
    """Object numbers after the `front` has spread into what is `free`, step by step."""
    ids, lab = g.object_id.clone(), cielab_colours(g)
    source = lab.clone()  # colour of the object where its growth began: a step after a step must not drift
    level = torch.full((len(free),), torch.inf)  # height in tolerances
    to_table = torch.zeros(len(free))
    if support is not None:
        level = support.heights(g.means[free]) / support.tolerance
        around = table_colour(g, support)[tuple((support.cells(g.means[free]) // 3).T)]
        to_table = (lab[free] - around).norm(dim=1)
        vivid = (lab[free] - around)[:, 1:].norm(dim=1) > VIVID
        level = torch.where(vivid & (level.abs() < 0.5), 0.5, level)  # too flat to tell by height, but not by hue
    left = level > -0.5
    for _ in range(STEPS):
        free, level, to_table = free[left], level[left], to_table[left]
        if not len(front) or not len(free):
            break
        distance, nearest = knn(g.means[front], g.means[free], 1)
        nearest = front[nearest[:, 0]]
        mine = ((lab[free] - source[nearest]).norm(dim=1) < 0.7 * to_table) & (to_table > OTHER)
        take = (distance[:, 0] < reach) & (mine | (level > 1))
        front, nearest = free[take], nearest[take]
        ids[front], source[front] = ids[nearest], source[nearest]
        left = ~take & (level > 0.4) & (level < 1)  # farther off, high is another thing and flat is a pattern
    return ids


def _fill_hulls(
    g: Gaussians, ids: Int[Tensor, "n"], free: Int[Tensor, "m"], large: Bool[Tensor, "n"], support: Support | None
) -> Int[Tensor, "n"]:
    """Those of the `free` Gaussians inside one object's convex hull (down to the plane, if it stands on it) join it.

    Of a `large` one all within a deviation must be inside: a blur that photos of the surface do not tell from it.
    The smallest object goes first.
    """
    counts = torch.bincount(ids)
    for number in [i for i in counts.argsort().tolist() if i > 0 and counts[i] >= 8]:
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
        blurs = rest[large[rest]]
        axes = matrix(g.quats[blurs]) * g.scales[blurs][:, None]
        height[large[rest].numpy()] += np.linalg.norm(hull[:, :3] @ axes.double().numpy(), axis=2)
        ids[rest[torch.from_numpy(height.max(1, initial=-np.inf) < 1e-9)]] = number
    return ids
