"""Patterns of the table that were taken for things lying on it."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.geometry.neighbours import knn
from stages.physics.support import Support
from stages.scene.gaussians import Gaussians
from stages.segment.rims import LEVEL, MARGIN

SHOWS = 0.1  # opacity from which a Gaussian counts
NEIGHBOURS = 8
NEAR_TABLE = 4.0  # the table is looked for this near its surface [levels]
PATTERN = 0.6  # share of a thing that is level with table close by, from which it is a part of the table


def without_scraps(g: Gaussians, support: Support) -> Gaussians:
    """The same Gaussians, with things given back to the table that lie in it and among it.

    A thing that lies on the table is higher than the table next to it, or has an inside that is far from any table.
    Stripes and threads of a cloth that differ from it in colour, and are an object to grouping, are neither.
    """
    level, margin = LEVEL * support.view.radius, MARGIN * support.view.radius
    shown = (g.opacities > SHOWS) & g.means.isfinite().all(1)
    heights = torch.where(shown, support.heights(torch.where(shown[:, None], g.means, 0.0)), torch.inf)
    table = g.means[(g.object_id == 0) & (heights.abs() < NEAR_TABLE * level)]
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
