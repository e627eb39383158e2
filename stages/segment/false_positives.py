"""Patterns of the table that were taken for things lying on it."""

from __future__ import annotations

from dataclasses import replace

import torch

from stages.core.geometry.neighbours import knn
from stages.core.perception.support import Support
from stages.core.perception.visibility import summed_view_directions
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.segment.boundary_refinement import BOUNDARY_WIDTH, HEIGHT_RESOLUTION, MIN_VISIBLE_WEIGHT

SHOWS = 0.1  # opacity from which a Gaussian counts
NEIGHBOURS = 8
PATTERN = 0.65  # share of a thing that is level with table close by, from which it is a part of the table


def remove_false_positives(scene: Scene, support: Support) -> Gaussians:
    """The scene's Gaussians, with things given back to the table that lie in it and among it.

    A thing that lies on the table is higher than the table seen next to it, or has an inside that is far from any.
    Stripes and threads of a cloth that differ from it in colour, and are an object to grouping, are neither.
    """
    g, level, margin = scene.gaussians, HEIGHT_RESOLUTION * support.view.radius, BOUNDARY_WIDTH * support.view.radius
    shown = (g.opacities > SHOWS) & g.means.isfinite().all(1)
    if scene.cameras is not None and len(scene.cameras):
        shown &= summed_view_directions(g, scene.cameras).norm(dim=1) > MIN_VISIBLE_WEIGHT
    heights = torch.where(shown, support.heights(torch.where(shown[:, None], g.means, 0.0)), torch.inf)
    bare = shown & (g.object_id == 0) & (heights.abs() < level)
    if int(bare.sum()) < NEIGHBOURS:
        return g
    ids = g.object_id.clone()
    for label in ids.unique().tolist():
        own = shown & (ids == label)
        if label == 0 or not own.any():
            continue
        distance, index = knn(g.means[bare], g.means[own], NEIGHBOURS)
        even = ((heights[own][:, None] - heights[bare][index]).abs() < level).float().mean(1) > 0.5
        if float((even & (distance[:, 0] < margin)).float().mean()) > PATTERN:
            ids[ids == label] = 0
    return replace(g, object_id=ids)
