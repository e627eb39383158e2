"""Patterns of the table that were taken for things lying on it."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.geometry.neighbours import knn
from stages.physics.sight import seen_from
from stages.physics.support import Support
from stages.scene.gaussians import Gaussians
from stages.scene.scene import Scene
from stages.segment.rims import LEVEL, MARGIN, SEEN

SHOWS = 0.1  # opacity from which a Gaussian counts
NEIGHBOURS = 8
PATTERN = 0.65  # share of a thing that is level with table close by, from which it is a part of the table


def without_scraps(scene: Scene, support: Support) -> Gaussians:
    """The scene's Gaussians, with things given back to the table that lie in it and among it.

    A thing that lies on the table is higher than the table seen next to it, or has an inside that is far from any.
    Stripes and threads of a cloth that differ from it in colour, and are an object to grouping, are neither.
    """
    g, level, margin = scene.gaussians, LEVEL * support.view.radius, MARGIN * support.view.radius
    shown = (g.opacities > SHOWS) & g.means.isfinite().all(1)
    if scene.cameras is not None and len(scene.cameras):
        shown &= seen_from(g, scene.cameras).norm(dim=1) > SEEN
    heights = torch.where(shown, support.heights(torch.where(shown[:, None], g.means, 0.0)), torch.inf)
    table = g.means[shown & (g.object_id == 0) & (heights.abs() < level)]
    if len(table) < NEIGHBOURS:
        return g
    ids = g.object_id.clone()
    for label in ids.unique().tolist():
        own = shown & (ids == label)
        if label > 0 and own.any() and _level(g.means[own], heights[own], table, support, margin, level) > PATTERN:
            ids[ids == label] = 0
    return replace(g, object_id=ids)


def _level(
    points: Float[Tensor, "m 3"], heights: Float[Tensor, "m"], table: Float[Tensor, "t 3"], support: Support,
    margin: float, level: float,
) -> Float[Tensor, ""]:  # fmt: skip
    """Share of the points with table close by, most of it as high as they are."""
    distance, index = knn(table, points, NEIGHBOURS)
    even = (heights[:, None] - support.heights(table)[index]).abs() < level
    return ((distance[:, 0] < margin) & (even.float().mean(1) > 0.5)).float().mean()
